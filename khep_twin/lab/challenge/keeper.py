"""Parent process of a participant's file: protects the table's process if the file kills its parent.

    python keeper.py BYTES PROGRAM ARGUMENT...

It starts the program with a memory limit of BYTES for each process, and exits with the program's exit code or
signal. It forwards the first SIGTERM to the program; the second one kills the program. It is run by its path
and imports nothing from the package, so that it starts fast.
"""

import os
import signal
import subprocess
import sys
from contextlib import suppress
from itertools import chain, repeat
from pathlib import Path

_MAX_PROCESSES = 1000
"""Limit of processes and threads in addition to those of the machine; root's are not limited."""


def main(memory_bytes: int, arguments: list[str]) -> None:
    """Run a program, and exit with its exit code or signal."""
    _limit_resources(memory_bytes)
    program = subprocess.Popen(arguments)
    kill_signal = signal.SIGTERM if sys.platform == "win32" else signal.SIGKILL
    kill_signals = chain([signal.SIGTERM], repeat(kill_signal))
    signal.signal(signal.SIGTERM, lambda number, frame: program.send_signal(next(kill_signals)))
    code = program.wait()
    if code < 0:
        with suppress(OSError):  # SIGKILL has no handler
            signal.signal(-code, signal.SIG_DFL)
        os.kill(os.getpid(), -code)
    os._exit(code)


def _limit_resources(memory_bytes: int) -> None:
    """Limit memory [bytes], core dumps and processes; lower limits stay."""
    if sys.platform == "win32":
        return  # Windows has no such limits
    import resource

    limits = {resource.RLIMIT_DATA: memory_bytes, resource.RLIMIT_CORE: 0}
    with suppress(OSError):  # only Linux reports the number of all processes and threads
        n_running = int(Path("/proc/loadavg").read_text().split()[3].split("/")[1])
        limits[resource.RLIMIT_NPROC] = n_running + _MAX_PROCESSES
    for resource_id, limit in limits.items():
        current = resource.getrlimit(resource_id)
        soft, hard = (limit if value == resource.RLIM_INFINITY else min(value, limit) for value in current)
        resource.setrlimit(resource_id, (soft, hard))


if __name__ == "__main__":
    main(int(sys.argv[1]), sys.argv[2:])
