"""A shadow in a process of its own, so that its work never delays the line that it listens to."""

import os
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Generator, Sequence
from contextlib import contextmanager, suppress
from select import select

import typer

from khep_twin.cli.followed import ALARM_CODE
from khep_twin.cli.options import complain
from khep_twin.shadow.tap import Tap
from khep_twin.signals import clear_at_end, undisturbed

READY = b"\n"
"""Byte by which a shadow tells that it listens."""

_TURN_S = 0.05
"""Interval of checks of the process [s]."""

_PATIENCE_S = 2.0
"""Time for a process that was told to end [s]."""


class Beside:
    """A shadow's process.

    Args:
        process: Process, which listens.
        line: Its line.
    """

    def __init__(self, process: "subprocess.Popen[bytes]", line: socket.socket) -> None:
        self._process, self._line = process, line
        self._tap: Tap | None = None
        self._told = False

    def tap(self, now: Callable[[], int]) -> Tap:
        """Return the tap on a line with this clock [ns]."""
        self._tap = Tap(self._line.fileno(), now)
        return self._tap

    def raised(self) -> bool:
        """Return whether it has ended by an alarm; complain if it has ended otherwise."""
        if self._tap is None or not self._tap.broken or self._told:
            return False
        code = self._process.wait()
        if code == ALARM_CODE:
            return True
        self._told = True
        complain(f"the shadow has ended with code {code}; the relay goes on without it")
        return False

    def finish(self) -> int:
        """Close the line and wait until it has followed the rest; return the exit code."""
        if self._tap is not None:
            self._tap.close()
        self._line.close()
        while (code := self._process.poll()) is None:
            time.sleep(_TURN_S)
        return code


@contextmanager
def beside(words: Sequence[str], stop: Callable[[], bool]) -> Generator[Beside]:
    """Run a shadow beside this process; its alarms go to this one's standard output.

    Args:
        words: Arguments of `khep-twin shadow`.
        stop: Function that returns whether to end.
    """
    here, there = socket.socketpair()
    arguments = [sys.executable, "-m", "khep_twin", "shadow", *words, "--line-fd", str(there.fileno())]
    with here, undisturbed():
        # Ctrl-C is for the relay alone; the shadow ends with its line, and completes its log.
        process = subprocess.Popen(arguments, pass_fds=[there.fileno()], start_new_session=True)
        forget = clear_at_end(lambda: _end(process))
        there.close()
        try:
            while not select([here], [], [], _TURN_S)[0] and not stop():
                pass
            if not stop() and os.read(here.fileno(), 1) != READY:
                raise typer.Exit(process.wait() or 1)
            yield Beside(process, here)
        finally:
            _end(process)
            forget()


def _end(process: "subprocess.Popen[bytes]") -> None:
    for end in (process.terminate, process.kill):
        with suppress(ProcessLookupError):
            if process.poll() is None:
                end()
        with suppress(subprocess.TimeoutExpired):
            process.wait(timeout=_PATIENCE_S)
            return
