"""Programs that were compiled for a Khepera IV, run on this machine against a twin of it.

    machine = Machine(Dspic(), Wheels().turn)
    code = run_program(["./program", "argument"], machine)

The program is a native build of the unmodified source. A preload library (`assets/khepera4/shim.c`), compiled
once by the user's C compiler, answers the robot's device nodes and, with a simulated clock, asks it the time.
"""

import hashlib
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

from khep_twin.errors import KhepTwinError
from khep_twin.khepera4.device_server import DeviceServer
from khep_twin.khepera4.machine import Machine

COMPILERS = "cc", "gcc", "clang"
"""C compilers, of which the first one that is there is used; CC in the environment names another."""

SOURCE = Path(__file__).parents[1] / "assets" / "khepera4" / "shim.c"


def run_program(arguments: Sequence[str], machine: Machine, *, simulated: bool = True) -> int:
    """Run a program on a machine; return its exit code, below 0 for the number of a signal that ended it.

    Args:
        arguments: The program and its arguments.
        machine: Machine that answers its device nodes.
        simulated: Whether its time is simulated; else the machine's time is that of this computer.

    Raises:
        KhepTwinError: The program cannot be started, or there is no C compiler.
    """
    preloaded = f"{library()}:{os.environ['LD_PRELOAD']}" if os.environ.get("LD_PRELOAD") else str(library())
    with tempfile.TemporaryDirectory(prefix="khep-twin-") as folder:
        path, begun = Path(folder, "devices"), time.monotonic_ns()
        server = DeviceServer(machine, path, None if simulated else lambda: time.monotonic_ns() - begun)
        clock = "simulated" if simulated else "real"
        own = {"LD_PRELOAD": preloaded, "KHEP_TWIN_SOCKET": str(path), "KHEP_TWIN_CLOCK": clock}
        try:
            process = subprocess.Popen([*arguments], env=os.environ | own)
        except OSError as error:
            server.close()
            raise KhepTwinError(f"{arguments[0]}: cannot be started: {error.strerror}") from error
        try:
            server.serve(process.pid, lambda: process.poll() is not None)
        finally:
            server.close()  # a program that asks on ends by itself
            if process.poll() is None:
                process.kill()
            process.wait()
    return process.returncode


def library() -> Path:
    """Return the preload library, compiled in the user's cache unless it is there.

    Raises:
        KhepTwinError: This is not Linux, there is no C compiler, or it fails.
    """
    if sys.platform != "linux":
        raise KhepTwinError(f"programs of a Khepera IV on {sys.platform}; expected Linux")
    cache = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "khep_twin"
    made = cache / f"khepera4-{hashlib.sha256(SOURCE.read_bytes()).hexdigest()[:14]}.so"
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
            flags = ("-O2", "-shared", "-fPIC", "-o", str(part), str(SOURCE), "-ldl", "-lpthread")
            done = subprocess.run([*compiler.split(), *flags], capture_output=True, text=True)
            if done.returncode:
                first = (done.stderr.strip().splitlines() or ["it said nothing"])[0]
                raise KhepTwinError(f"{compiler}: cannot compile {SOURCE.name}: {first}")
            os.replace(part, made)
    except OSError as error:
        raise KhepTwinError(
            f"{error.filename or compiler}: {error.strerror}; expected a C compiler, and a cache "
            "folder that can be written (XDG_CACHE_HOME)"
        ) from error
    return made
