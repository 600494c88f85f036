"""Process between a table and a participant's file: what the file does to its parent ends this one alone.

    python keeper.py BYTES PROGRAM ARGUMENT...

It starts the program with at most so many bytes of memory for each process and ends as the program does. The
first SIGTERM is passed on to it, the second one kills it. It is run by its path and imports nothing of the
package, so that it costs no time.
"""

import os
import signal
import subprocess
import sys
from contextlib import suppress
from itertools import chain, repeat
from pathlib import Path

_MORE = 1000
"""Processes and threads that may be started beside those of the machine; root's are not limited."""


def main(memory: int, words: list[str]) -> None:
    """Run a program, and end as it does."""
    _limit(memory)
    program = subprocess.Popen(words)
    last = signal.SIGTERM if sys.platform == "win32" else signal.SIGKILL
    orders = chain([signal.SIGTERM], repeat(last))
    signal.signal(signal.SIGTERM, lambda number, frame: program.send_signal(next(orders)))
    code = program.wait()
    if code < 0:
        with suppress(OSError):  # SIGKILL has no handler
            signal.signal(-code, signal.SIG_DFL)
        os.kill(os.getpid(), -code)
    os._exit(code)


def _limit(memory: int) -> None:
    """Limit memory [bytes], dumps and processes; no limit is raised."""
    if sys.platform == "win32":
        return  # it has no such limits
    import resource

    limits = {resource.RLIMIT_DATA: memory, resource.RLIMIT_CORE: 0}
    with suppress(OSError):  # only Linux has the number of all there are
        n_now = int(Path("/proc/loadavg").read_text().split()[3].split("/")[1])
        limits[resource.RLIMIT_NPROC] = n_now + _MORE
    for which, most in limits.items():
        present = resource.getrlimit(which)
        soft, hard = (most if each == resource.RLIM_INFINITY else min(each, most) for each in present)
        resource.setrlimit(which, (soft, hard))


if __name__ == "__main__":
    main(int(sys.argv[1]), sys.argv[2:])
