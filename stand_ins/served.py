"""Serving commands of khep-twin in separate processes: twins and relays in place of a robot."""

import select
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

LONGEST_START_S = 120
"""Longest time until the first line, on a busy machine [s]."""


@contextmanager
def served(
    *words: str,
    program: Sequence[str] = ("-m", "khep_twin"),
    start: Callable[..., "subprocess.Popen[str]"] = subprocess.Popen,
    **popen_options: Any,
) -> Iterator[tuple["subprocess.Popen[str]", str]]:
    """Run a command that serves; yield its process and its first line, the path or URL for a host.

    Args:
        words: Command with its options.
        program: Options of Python before the command.
        start: Function that starts the process, as `subprocess.Popen` does.
        popen_options: Options of that function.
    """
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    process = start([sys.executable, *program, *words], **pipes | popen_options)
    try:
        assert process.stdout is not None
        assert select.select([process.stdout], [], [], LONGEST_START_S)[0], "nothing was served"
        yield process, process.stdout.readline().strip()
    finally:
        process.terminate()
        process.send_signal(signal.SIGCONT)  # a stopped one would not hear the first
        process.communicate(timeout=60)
