"""Programs that were compiled for a robot's computer, run on this computer against a twin of the robot.

    world = World("arena4")
    program = RobotProgram(["./program", "argument"], Machine(world.robots[0], world))
    (code,) = run_programs([program])

The program is a native build of the unmodified source. A preload library (`assets/shim*.c`),
compiled once by the user's C compiler and loaded before the C library, answers the robot's device nodes and,
with a simulated clock, the functions that return the time or wait.
"""

import contextlib
import errno
import mmap
import os
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Generator, Sequence
from pathlib import Path
from types import FrameType
from typing import NamedTuple

from khep_twin.errors import KhepTwinError
from khep_twin.programs.computer import MEMORY_NODE, Computer, Machine
from khep_twin.programs.device_server import DeviceServer
from khep_twin.programs.executable import Executable, StartedPrograms, check_executable, check_preload
from khep_twin.programs.preload import ORPHANS_S, preload_library, watched_folder
from khep_twin.programs.scheduler import NEVER_NS

TERMINATE_S = 2.0
"""Time from SIGTERM to SIGKILL for programs, simulated or of the wall clock [s]."""


class RobotProgram(NamedTuple):
    """A program on a robot.

    Attributes:
        arguments: The program and its arguments.
        machine: Machine that answers its device nodes.
        robot_id: Number of the robot, for `Computer.files`.
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
    with watched_folder() as temporary, contextlib.ExitStack() as stack:
        paths = [Path(temporary, f"devices{index}") for index in range(len(programs))]
        machines = [program.machine for program in programs]
        offset_ns = machines[0].time_ns - time.monotonic_ns()
        clock = None if simulated else lambda: time.monotonic_ns() + offset_ns
        starts: list[StartedPrograms] = []
        server = DeviceServer(
            machines, paths, clock, on_wall_clock, lambda i, process, path: starts[i].check(process, path)
        )
        stack.enter_context(contextlib.closing(server))
        if simulated:
            stack.enter_context(_pin_to_one_processor())
        processes: list[subprocess.Popen[bytes]] = []
        stack.callback(_kill, processes)
        for program, executable, library, path in zip(programs, executables, libraries, paths, strict=True):
            link, folder = path.with_suffix(".so"), path.with_suffix(".files")
            link.symlink_to(library)
            environment = os.environ | {
                # Behind the user's libraries: a sanitizer's must come first.
                "LD_PRELOAD": ":".join(filter(None, (os.environ.get("LD_PRELOAD"), str(link)))),
                "KHEP_TWIN_SOCKET": str(path),
                "KHEP_TWIN_CLOCK": "simulated" if simulated else "real",
                "KHEP_TWIN_PATHS": _write_files(folder, program.machine.computer, program.robot_id),
                "KHEP_TWIN_FILES": str(folder),
            }
            if executable is not None:
                check_preload(program.arguments[0], executable.loader, link, environment)
            starts.append(StartedPrograms(executable, link, environment))
            try:
                processes.append(subprocess.Popen([*program.arguments], env=environment))
            except OSError as error:
                raise _start_error(program.arguments[0], error) from error
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


def _start_error(program: str, error: OSError) -> KhepTwinError:
    """Return the error of a program that cannot be started."""
    path = Path(program)
    expected = ""
    if path.is_dir():
        expected = "; expected a program, not a folder"
    elif path.is_file() and path.name == program and not shutil.which(program):
        expected = f"; expected ./{program}"
    elif isinstance(error, PermissionError) and path.is_file():
        expected = f"; expected a program that may be executed: compile it, or chmod +x {program}"
    elif error.errno == errno.ENOEXEC:
        expected = "; expected a compiled program, or a script that begins with #! and its interpreter"
    return KhepTwinError(f"{program}: cannot be started: {error.strerror}{expected}")


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


def _write_files(folder: Path, computer: Computer, robot_id: int) -> str:
    """Write files and memory of a computer; return the table of its paths for the preload library."""
    files, memory = {**computer.files(robot_id)}, computer.memory
    paths = [f"{Path(name).parent}{end}" for name in files for end in ("", "/*")]
    if memory:
        files[MEMORY_NODE] = ""
        paths.append(MEMORY_NODE)
    size = (max(memory, default=0) // mmap.PAGESIZE + 1) * mmap.PAGESIZE
    try:
        for name, text in files.items():
            path = Path(f"{folder}{name}")
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(text)
        if memory:
            with open(f"{folder}{MEMORY_NODE}", "r+b") as file:
                file.truncate(size)  # without room on the disk
                for address, word in memory.items():
                    file.seek(address)
                    file.write(word.to_bytes(4, "little"))
    except OSError as error:
        expected = f"a folder in TMPDIR, and a limit (ulimit -f), for a sparse file of {size} bytes"
        raise KhepTwinError(f"{folder}: {error.strerror}; expected {expected}") from error
    return ":".join(f"{node}{path}" for path, node in {**computer.nodes, **dict.fromkeys(paths, 0)}.items())


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
