"""Programs that were compiled for a Khepera IV, run on this machine against a twin of it.

    machine = Machine(Dspic(), Wheels().turn)
    code = run_program(["./program", "argument"], machine)

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

from khep_twin.errors import KhepTwinError
from khep_twin.khepera4.device_server import DeviceServer
from khep_twin.khepera4.machine import Machine

COMPILERS = "cc", "gcc", "clang"
"""C compilers, of which the first one that is there is used; CC in the environment names another."""

SOURCES = Path(__file__).parents[1] / "assets" / "khepera4"
"""Folder of the preload library."""


def run_program(
    arguments: Sequence[str], machine: Machine, *, simulated: bool = True, robot_id: int = 1
) -> int:
    """Run a program on a machine; return its exit code, below 0 for the number of a signal that ended it.

    SIGINT, which a terminal sends to the program as well, is left to the program; SIGTERM is passed on.

    Args:
        arguments: The program and its arguments.
        machine: Machine that answers its device nodes.
        simulated: Whether its time is simulated; else the machine's time is that of this computer.
        robot_id: Number of the robot, in `/etc/khepera/robotid`.

    Raises:
        KhepTwinError: The program cannot be started, or there is no C compiler.
    """
    own = str(_library_for(arguments[0]))
    preloaded = f"{own}:{os.environ['LD_PRELOAD']}" if os.environ.get("LD_PRELOAD") else own
    with tempfile.TemporaryDirectory(prefix="khep-twin-") as folder:
        path, begun = Path(folder, "devices"), time.monotonic_ns()
        own_environment = {
            "LD_PRELOAD": preloaded,
            "KHEP_TWIN_SOCKET": str(path),
            "KHEP_TWIN_CLOCK": "simulated" if simulated else "real",
            "KHEP_TWIN_ETC": str(_files(Path(folder, "etc"), robot_id)),
        }
        server = DeviceServer(machine, path, None if simulated else lambda: time.monotonic_ns() - begun)
        with contextlib.closing(server), _one_processor() if simulated else contextlib.nullcontext():
            return _run(arguments, os.environ | own_environment, server)


def _library_for(program: str) -> Path:
    """Return the preload library that a program can load."""
    if bits(program) == 64:
        return library()
    try:
        return library(32)
    except KhepTwinError as error:
        raise KhepTwinError(f"{program}: a program of 32 bits, and {error}") from error


def _run(arguments: Sequence[str], environment: dict[str, str], server: DeviceServer) -> int:
    try:
        process = subprocess.Popen([*arguments], env=environment)
    except OSError as error:
        raise KhepTwinError(f"{arguments[0]}: cannot be started: {error.strerror}") from error
    try:
        with _signals_of(process):
            server.serve(process.pid, lambda: process.poll() is not None)
    finally:
        if process.poll() is None:
            process.kill()
        process.wait()
    return process.returncode


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
    return folder


@contextlib.contextmanager
def _signals_of(process: "subprocess.Popen[bytes]") -> Generator[None, None, None]:
    """Leave the signals that end this process to another one meanwhile."""

    def pass_on(number: int, frame: FrameType | None) -> None:
        if number == signal.SIGTERM:
            process.terminate()

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
