"""Programs that were compiled for a Khepera IV, run on this machine against a twin of it.

    world = World("arena4")
    program = RobotProgram(["./program", "argument"], Machine(world.robots[0].dspic, world))
    (code,) = run_programs([program])

The program is a native build of the unmodified source. A preload library (`assets/khepera4/shim*.c`),
compiled once by the user's C compiler, answers the robot's device nodes and, with a simulated clock, what
asks for the time or waits.
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
from collections.abc import Generator, Sequence
from pathlib import Path
from types import FrameType
from typing import NamedTuple

from khep_twin.errors import KhepTwinError
from khep_twin.khepera4.device_server import NEVER_NS, DeviceServer
from khep_twin.khepera4.machine import Machine

COMPILERS = "cc", "gcc", "clang"
"""C compilers, of which the first one that is there is used; CC in the environment names another."""

SOURCES = Path(__file__).parents[1] / "assets" / "khepera4"
"""Folder of the preload library."""


CONFIGURATION = "section Khepera4\ndevice dsPic i2c 0x30\n"
"""The robot's `/etc/libkhepera/khepera4.knc`, without which the library finds no dsPIC."""

LAST_S = 2.0
"""Time that programs have to end by themselves after SIGTERM, simulated or of the wall clock [s]."""

CHILDREN_S = 0.3
"""Time of the wall clock in which children that have lost their twin end, before they are killed [s]."""


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
    programs: Sequence[RobotProgram], *, simulated: bool = True, until_ns: int | None = None
) -> list[int]:
    """Run a program on each of some machines; return their exit codes.

    A code is below 0 for the number of a signal that ended a program. SIGINT, which a terminal sends to the
    programs as well, is left to them; SIGTERM is passed on. A program that ends leaves the others running.

    Args:
        programs: Programs, on machines that share one time.
        simulated: Whether their time is simulated; else it is that of this computer.
        until_ns: Time at which those that still run get SIGTERM, and after LAST_S are killed [ns].

    Raises:
        KhepTwinError: A program cannot be started, or there is no C compiler.
    """
    libraries = [_library_for(program.arguments[0]) for program in programs]
    # The loader splits its list of libraries at spaces and colons, and sockets have short paths.
    place = tempfile.gettempdir()
    place = "/tmp" if len(place) > 60 or set(place) & set(" :") else place
    with (
        tempfile.TemporaryDirectory(prefix="khep-twin-", dir=place) as folder,
        contextlib.ExitStack() as stack,
    ):
        begun = time.monotonic_ns()
        paths = [Path(folder, f"devices{index}") for index in range(len(programs))]
        machines = [program.machine for program in programs]
        first_ns = machines[0].time_ns
        clock = None if simulated else lambda: first_ns + time.monotonic_ns() - begun
        server = stack.enter_context(contextlib.closing(DeviceServer(machines, paths, clock)))
        if simulated:
            stack.enter_context(_one_processor())
        started: list[subprocess.Popen[bytes]] = []
        stack.callback(_kill, started)
        for program, library, path in zip(programs, libraries, paths, strict=True):
            linked = path.with_suffix(".so")
            linked.symlink_to(library)
            environment = {
                "LD_PRELOAD": ":".join(filter(None, (str(linked), os.environ.get("LD_PRELOAD")))),
                "KHEP_TWIN_SOCKET": str(path),
                "KHEP_TWIN_CLOCK": "simulated" if simulated else "real",
                "KHEP_TWIN_ETC": str(_files(path.with_suffix(".etc"), program.robot_id)),
            }
            try:
                started.append(subprocess.Popen([*program.arguments], env=os.environ | environment))
            except OSError as error:
                raise KhepTwinError(f"{program.arguments[0]}: cannot be started: {error.strerror}") from error
        stack.enter_context(_signals_of(started))
        numbers = [process.pid for process in started]
        end_ns = NEVER_NS if until_ns is None else until_ns
        there = server.serve(numbers, lambda: _are_over(started), end_ns)
        if any(process.poll() is None for process in started):
            _terminate(started)
            last, last_ns = time.monotonic() + LAST_S, machines[0].time_ns + round(LAST_S * 1e9)
            there |= server.serve(numbers, lambda: _are_over(started) or time.monotonic() > last, last_ns)
        _kill(started)
        server.close()
        _kill_others(there - {*numbers})
    return [process.returncode for process in started]


def _library_for(program: str) -> Path:
    """Return the preload library that a program can load."""
    if bits(program) == 64:
        return library()
    try:
        return library(32)
    except KhepTwinError as error:
        raise KhepTwinError(f"{program}: a program of 32 bits, and {error}") from error


def _are_over(started: Sequence["subprocess.Popen[bytes]"]) -> bool:
    """Return whether all programs have ended."""
    return all([process.poll() is not None for process in started])


def _terminate(started: Sequence["subprocess.Popen[bytes]"]) -> None:
    for process in started:
        if process.poll() is None:
            process.terminate()


def _kill(started: Sequence["subprocess.Popen[bytes]"]) -> None:
    for process in started:
        if process.poll() is None:
            process.kill()
        process.wait()


def _kill_others(processes: set[int]) -> None:
    """Kill processes that programs have left behind, after a while in which they end by themselves."""
    assert sys.platform == "linux"
    last = time.monotonic() + CHILDREN_S
    while processes and time.monotonic() < last:
        time.sleep(0.01)
        processes = {each for each in processes if Path(f"/proc/{each}").exists()}
    for each in processes:
        with contextlib.suppress(ProcessLookupError, PermissionError):
            os.kill(each, signal.SIGKILL)


def bits(program: str) -> int:
    """Return for how many bits a program was compiled, 64 where that is not to be found out."""
    for _ in range(5):  # a script, its interpreter's script and so on
        try:
            with open(shutil.which(program) or program, "rb") as file:
                head = file.read(256)
        except OSError:
            return 64
        if not head.startswith(b"#!"):
            return 32 if head[:5] == b"\x7fELF\x01" else 64
        words = head[2:].partition(b"\n")[0].decode(errors="replace").split()
        if len(words) > 1 and words[0].endswith("/env"):
            words = words[1:]
        program = words[0] if words else ""
    return 64


@contextlib.contextmanager
def _one_processor() -> Generator[None, None, None]:
    """Keep this thread and what it starts on one processor: they take turns, and going to another is slow."""
    assert sys.platform == "linux"
    before = os.sched_getaffinity(0)
    with contextlib.suppress(OSError):  # where that is not allowed, it is slower
        here = Path("/proc/thread-self/stat").read_text().rpartition(")")[2].split()[36]
        os.sched_setaffinity(0, {int(here)})
    try:
        yield
    finally:
        with contextlib.suppress(OSError):
            os.sched_setaffinity(0, before)


def _files(folder: Path, robot_id: int) -> Path:
    """Write what programs look for in the robot's /etc; return the folder."""
    for name in ("khepera", "libkhepera"):
        (folder / name).mkdir(parents=True)
    (folder / "khepera" / "robotid").write_text(f"{robot_id}\n")
    (folder / "libkhepera" / "khepera4.knc").write_text(CONFIGURATION)
    return folder


@contextlib.contextmanager
def _signals_of(started: Sequence["subprocess.Popen[bytes]"]) -> Generator[None, None, None]:
    """Leave the signals that end this process to others meanwhile."""

    def pass_on(number: int, frame: FrameType | None) -> None:
        if number == signal.SIGTERM:
            _terminate(started)

    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = [(number, signal.signal(number, pass_on)) for number in (signal.SIGINT, signal.SIGTERM)]
    try:
        yield
    finally:
        for number, handler in before:
            signal.signal(number, handler)


def library(bits: int = 64) -> Path:
    """Return the preload library, compiled in the user's cache unless it is there.

    Args:
        bits: 32 or 64, as the program has.

    Raises:
        KhepTwinError: This is not Linux, there is no C compiler, or it fails.
    """
    if sys.platform != "linux":
        raise KhepTwinError(f"programs of a Khepera IV on {sys.platform}; expected Linux")
    cache = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "khep_twin"
    sources = sorted(SOURCES.glob("shim*"))
    content = b"".join(source.read_bytes() for source in sources)
    made = cache / f"khepera4-{bits}-{hashlib.sha256(content).hexdigest()[:14]}.so"
    if made.exists():
        return made
    named = os.environ.get("CC")
    compiler = named or next(filter(None, map(shutil.which, COMPILERS)), None)
    if compiler is None:
        raise KhepTwinError("no C compiler is installed; expected cc, gcc or clang (Debian: apt install gcc)")
    try:
        cache.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=cache) as folder:
            part = Path(folder, made.name)
            named_c = [str(source) for source in sources if source.suffix == ".c"]
            flags = ["-O2", "-shared", "-fPIC", "-U_FORTIFY_SOURCE", *(["-m32"] if bits == 32 else [])]
            done = subprocess.run(
                [*compiler.split(), *flags, "-o", str(part), *named_c, "-ldl", "-lpthread"],
                capture_output=True,
                text=True,
            )
            if done.returncode and bits == 32:
                raise KhepTwinError(
                    f"{compiler} cannot compile for 32 bits; "
                    "expected gcc-multilib (Debian: apt install gcc-multilib)"
                )
            if done.returncode:
                first = (done.stderr.strip().splitlines() or ["it said nothing"])[0]
                raise KhepTwinError(f"{compiler}: cannot compile the preload library: {first}")
            os.replace(part, made)
    except OSError as error:
        raise KhepTwinError(
            f"{error.filename or compiler}: {error.strerror}; expected a C compiler, and a cache "
            "folder that can be written (XDG_CACHE_HOME)"
        ) from error
    return made
