"""Programs that were compiled for a Khepera IV, run on this machine against a twin of it.

    world = World("arena4")
    program = RobotProgram(["./program", "argument"], Machine(world.robots[0].dspic, world))
    (code,) = run_programs([program])

The program is a native build of the unmodified source. A preload library (`assets/khepera4/shim*.c`),
compiled once by the user's C compiler and loaded before the C library, answers the robot's device nodes and,
with a simulated clock, the functions that return the time or wait.
"""

import contextlib
import hashlib
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Generator, Sequence
from pathlib import Path
from types import FrameType
from typing import NamedTuple

from khep_twin.errors import KhepTwinError
from khep_twin.khepera4.device_server import DeviceServer
from khep_twin.khepera4.executable import Executable, check_executable, check_preload
from khep_twin.khepera4.machine import Machine
from khep_twin.khepera4.scheduler import NEVER_NS

COMPILERS = "cc", "gcc", "clang"
"""C compilers; the first that is installed is used. CC in the environment names another."""

SOURCES = Path(__file__).parents[1] / "assets" / "khepera4"
"""Folder of the preload library."""

CONFIGURATION = "section Khepera4\ndevice dsPic i2c 0x30\n"
"""The robot's `/etc/libkhepera/khepera4.knc`, by which K-Team's library finds the dsPIC."""

TERMINATE_S = 2.0
"""Time from SIGTERM to SIGKILL for programs, simulated or of the wall clock [s]."""

ORPHANS_S = 0.3
"""Time of the wall clock until children without a twin are killed [s]; most end on their own."""


class RobotProgram(NamedTuple):
    """A program on a robot.

    Attributes:
        arguments: The program and its arguments.
        machine: Machine that answers its device nodes.
        robot_id: Number of the robot, in `/etc/khepera/robotid`.
    """

    arguments: Sequence[str]
    machine: Machine
    robot_id: int = 1


def run_programs(
    programs: Sequence[RobotProgram],
    *,
    simulated: bool = True,
    until_ns: int | None = None,
    on_wall_clock: Callable[[], None] = lambda: None,
) -> list[int]:
    """Run programs, each on its machine; return their exit codes.

    The code of a program that was killed by a signal is minus the signal's number. SIGINT is ignored here, as
    a terminal also sends it to the programs; SIGTERM is forwarded. A program that ends leaves the others
    running.

    Args:
        programs: Programs, on machines that share one time.
        simulated: Whether their time is simulated; otherwise it is the time of this computer.
        until_ns: Time at which running programs get SIGTERM, and SIGKILL `TERMINATE_S` later [ns].
        on_wall_clock: Function that is called when simulated time first passes with the wall clock, as all
            threads wait for another program or a key.

    Raises:
        KhepTwinError: A program cannot be started, or there is no C compiler.
    """
    executables = [check_executable(program.arguments[0]) for program in programs]
    libraries = [
        _find_preload_library(program.arguments[0], executable)
        for program, executable in zip(programs, executables, strict=True)
    ]
    # The loader splits its list of libraries at spaces and colons, and sockets have short paths.
    parent_folder = tempfile.gettempdir()
    parent_folder = "/tmp" if len(parent_folder) > 60 or set(parent_folder) & set(" :") else parent_folder
    with (
        tempfile.TemporaryDirectory(prefix="khep-twin-", dir=parent_folder) as folder,
        contextlib.ExitStack() as stack,
    ):
        paths = [Path(folder, f"devices{index}") for index in range(len(programs))]
        machines = [program.machine for program in programs]
        offset_ns = machines[0].time_ns - time.monotonic_ns()
        clock = None if simulated else lambda: time.monotonic_ns() + offset_ns
        server = stack.enter_context(contextlib.closing(DeviceServer(machines, paths, clock, on_wall_clock)))
        if simulated:
            stack.enter_context(_pin_to_one_processor())
        processes: list[subprocess.Popen[bytes]] = []
        stack.callback(_kill, processes)
        for program, executable, library, path in zip(programs, executables, libraries, paths, strict=True):
            link = path.with_suffix(".so")
            link.symlink_to(library)
            environment = {
                # Behind the user's libraries: a sanitizer's must come first.
                "LD_PRELOAD": ":".join(filter(None, (os.environ.get("LD_PRELOAD"), str(link)))),
                "KHEP_TWIN_SOCKET": str(path),
                "KHEP_TWIN_CLOCK": "simulated" if simulated else "real",
                "KHEP_TWIN_ETC": str(_write_configuration(path.with_suffix(".etc"), program.robot_id)),
            }
            if executable is not None:
                check_preload(program.arguments[0], executable.loader, link, os.environ | environment)
            try:
                processes.append(subprocess.Popen([*program.arguments], env=os.environ | environment))
            except OSError as error:
                raise KhepTwinError(f"{program.arguments[0]}: cannot be started: {error.strerror}") from error
        stack.enter_context(_forward_signals(processes))
        process_ids = [process.pid for process in processes]
        end_ns = NEVER_NS if until_ns is None else until_ns
        live_ids = server.serve(process_ids, lambda: _have_ended(processes), end_ns)
        if any(process.poll() is None for process in processes):
            _terminate(processes)
            deadline = time.monotonic() + TERMINATE_S
            end_ns = machines[0].time_ns + round(TERMINATE_S * 1e9)
            live_ids |= server.serve(
                process_ids, lambda: _have_ended(processes) or time.monotonic() > deadline, end_ns
            )
        _kill(processes)
        server.close()
        _kill_orphans(live_ids - {*process_ids})
        for program, process in zip(programs, processes, strict=True):
            if process.returncode >= 0 and process.pid not in server.clients:
                raise KhepTwinError(
                    f"{program.arguments[0]}: ended with code {process.returncode} and never loaded the "
                    "preload library; expected a program that loads it"
                )
    return [process.returncode for process in processes]


def _find_preload_library(program: str, executable: Executable | None) -> Path:
    """Return the preload library for a program's word size."""
    if executable is None or executable.bits == 64:
        return preload_library()
    try:
        return preload_library(32)
    except KhepTwinError as error:
        raise KhepTwinError(f"{program}: a program of 32 bits, and {error}") from error


def _have_ended(processes: Sequence["subprocess.Popen[bytes]"]) -> bool:
    """Return whether all programs have ended."""
    return all([process.poll() is not None for process in processes])


def _terminate(processes: Sequence["subprocess.Popen[bytes]"]) -> None:
    for process in processes:
        process.terminate()  # without effect after its end


def _kill(processes: Sequence["subprocess.Popen[bytes]"]) -> None:
    for process in processes:
        process.kill()
        process.wait()


def _kill_orphans(process_ids: set[int]) -> None:
    """Kill processes that programs have left behind, unless they end within `ORPHANS_S`."""
    assert sys.platform == "linux"
    deadline = time.monotonic() + ORPHANS_S
    while process_ids and time.monotonic() < deadline:
        time.sleep(0.01)
        process_ids = {process_id for process_id in process_ids if Path(f"/proc/{process_id}").exists()}
    for orphan in process_ids:
        with contextlib.suppress(ProcessLookupError, PermissionError):
            os.kill(orphan, signal.SIGKILL)


@contextlib.contextmanager
def _pin_to_one_processor() -> Generator[None, None, None]:
    """Keep this thread and its programs on one processor: they run in turn, and migration is slow."""
    assert sys.platform == "linux"
    affinity = os.sched_getaffinity(0)
    with contextlib.suppress(OSError):  # not allowed everywhere, and only faster
        processor = Path("/proc/thread-self/stat").read_text().rpartition(")")[2].split()[36]
        os.sched_setaffinity(0, {int(processor)})
    try:
        yield
    finally:
        with contextlib.suppress(OSError):
            os.sched_setaffinity(0, affinity)


def _write_configuration(folder: Path, robot_id: int) -> Path:
    """Write the files of the robot's /etc that programs read; return the folder."""
    for name in ("khepera", "libkhepera"):
        (folder / name).mkdir(parents=True)
    (folder / "khepera" / "robotid").write_text(f"{robot_id}\n")
    (folder / "libkhepera" / "khepera4.knc").write_text(CONFIGURATION)
    return folder


@contextlib.contextmanager
def _forward_signals(processes: Sequence["subprocess.Popen[bytes]"]) -> Generator[None, None, None]:
    """Ignore SIGINT and forward SIGTERM to the programs."""

    def forward(number: int, frame: FrameType | None) -> None:
        if number == signal.SIGTERM:
            _terminate(processes)

    if threading.current_thread() is not threading.main_thread():
        yield
        return
    handlers = [(number, signal.signal(number, forward)) for number in (signal.SIGINT, signal.SIGTERM)]
    try:
        yield
    finally:
        for number, handler in handlers:
            signal.signal(number, handler)


def preload_library(bits: int = 64) -> Path:
    """Return the preload library of a word size, 32 or 64 bits, compiled into the user's cache if missing.

    Raises:
        KhepTwinError: This is not Linux, there is no C compiler, or it fails.
    """
    if sys.platform != "linux":
        raise KhepTwinError(f"programs of a Khepera IV on {sys.platform}; expected Linux")
    try:
        cache = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache").absolute() / "khep_twin"
    except RuntimeError:
        raise KhepTwinError(
            "the preload library: this user has no home folder; expected a cache folder in XDG_CACHE_HOME"
        ) from None
    sources = sorted(SOURCES.glob("shim*"))
    content = b"".join(source.read_bytes() for source in sources)
    library_path = cache / f"khepera4-{bits}-{hashlib.sha256(content).hexdigest()[:14]}.so"
    if library_path.exists():
        return library_path
    chosen_compiler = os.environ.get("CC")
    compiler = chosen_compiler or next(filter(None, map(shutil.which, COMPILERS)), None)
    if compiler is None:
        raise KhepTwinError("no C compiler is installed; expected cc, gcc or clang (Debian: apt install gcc)")
    try:
        cache.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=cache) as folder:
            temporary_path = Path(folder, library_path.name)
            c_files = [str(source) for source in sources if source.suffix == ".c"]
            flags = ["-O2", "-shared", "-fPIC", "-U_FORTIFY_SOURCE", *(["-m32"] if bits == 32 else [])]
            compilation = subprocess.run(
                [*compiler.split(), *flags, "-o", str(temporary_path), *c_files, "-ldl", "-lpthread"],
                capture_output=True,
                text=True,
            )
            if compilation.returncode and bits == 32:
                raise KhepTwinError(
                    f"{compiler} cannot compile for 32 bits; "
                    "expected gcc-multilib (Debian: apt install gcc-multilib)"
                )
            if compilation.returncode:
                message = (compilation.stderr.strip().splitlines() or ["no message"])[0]
                raise KhepTwinError(f"{compiler}: cannot compile the preload library: {message}")
            os.replace(temporary_path, library_path)
    except OSError as error:
        raise KhepTwinError(
            f"{error.filename or compiler}: {error.strerror}; expected a C compiler, and a cache "
            "folder that can be written (XDG_CACHE_HOME)"
        ) from error
    return library_path
