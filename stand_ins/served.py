"""Commands of khep-twin that serve, each in its own process: twins and relays in the place of a robot."""

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
    **ways: Any,
) -> Iterator[tuple["subprocess.Popen[str]", str]]:
    """Run a command that serves; yield its process and its first line, which is what a host opens.

    Args:
        words: Command with its options.
        program: Options of Python that come before.
        start: Function that starts the process, as `subprocess.Popen` does.
        ways: Options of that function.
    """
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    process = start([sys.executable, *program, *words], **pipes | ways)
    try:
        assert process.stdout is not None
        assert select.select([process.stdout], [], [], LONGEST_START_S)[0], "nothing was served"
        yield process, process.stdout.readline().strip()
    finally:
        process.terminate()
        process.send_signal(signal.SIGCONT)  # a stopped one would not hear the first
        process.communicate(timeout=60)
