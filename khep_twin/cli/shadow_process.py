"""A shadow in its own process, so that its work never delays the line that it listens to."""

import socket
import subprocess
import sys
from collections.abc import Callable, Generator, Sequence
from contextlib import contextmanager, suppress
from select import select

import typer

from khep_twin.cli.options import complain
from khep_twin.cli.shadow_run import EXIT_CODES
from khep_twin.errors import KhepTwinError
from khep_twin.shadow.line_pipe import LineSender
from khep_twin.signals import clear_at_end, undisturbed

READY = b"\n"
"""Byte by which a shadow tells that it listens."""

_TURN_S = 0.05
"""Interval of checks of the process [s]."""

_TERMINATION_S = 2.0
"""Time for a process that was told to end [s]."""


class ShadowProcess:
    """Process that runs a shadow.

    Args:
        process: Process.
        line: Its line.

    Attributes:
        code: Its exit code, once it has told that; None before.
    """

    def __init__(self, process: "subprocess.Popen[bytes]", line: socket.socket) -> None:
        self._process, self._line = process, line
        self._sender: LineSender | None = None
        self.code: int | None = None

    def listener(self, now: Callable[[], int]) -> LineSender:
        """Return a listener that passes a line on to the shadow, with times of this clock [ns]."""
        self._sender = LineSender(self._line.fileno(), now)
        return self._sender

    def ended_as_asked(self) -> bool:
        """Return whether it has ended by an event of --exit-on; complain once if it has ended otherwise."""
        if self.code is None and self._sender is not None and self._sender.broken:
            self.code = self._read_code()
            if self.code not in EXIT_CODES.values():
                complain(f"the shadow has ended with code {self.code}; the relay goes on without it")
        return self.code in EXIT_CODES.values()

    def finish(self) -> int:
        """End the line and wait until the shadow has followed the rest; return the exit code."""
        if self._sender is not None:
            self._sender.close()
        if self.code is None:
            self._line.shutdown(socket.SHUT_WR)
            self.code = self._read_code()
        return self.code

    def _read_code(self) -> int:
        """Wait for the exit code; what the process still has to clear up nobody waits for."""
        self._line.setblocking(True)
        try:
            told = self._line.recv(1)
        except ConnectionResetError:
            told = b""
        return told[0] if told else self._process.wait() or 1


@contextmanager
def run_shadow(words: Sequence[str], stop: Callable[[], bool]) -> Generator[ShadowProcess]:
    """Run a shadow beside this process; its alarms go to this one's standard output.

    Args:
        words: Arguments of `khep-twin shadow`.
        stop: Function that returns whether to end.
    """
    if sys.platform == "win32":
        raise KhepTwinError("a shadow beside a relay needs a system of Unix; expected a log of the line")
    here, there = socket.socketpair()
    arguments = [sys.executable, "-m", "khep_twin", "shadow", *words, "--line-fd", str(there.fileno())]
    with undisturbed():
        # Ctrl-C is for the relay alone; the shadow ends with its line, and completes its log.
        process = subprocess.Popen(arguments, pass_fds=[there.fileno()], start_new_session=True)
        forget = clear_at_end(lambda: _end(process))
        there.close()
    shadow = ShadowProcess(process, here)
    with here:
        try:
            while not select([here], [], [], _TURN_S)[0] and not stop():
                pass
            if not stop() and here.recv(1) != READY:
                raise typer.Exit(process.wait() or 1)
            yield shadow
        finally:
            if shadow.code is None:
                _end(process)
            forget()


def _end(process: "subprocess.Popen[bytes]") -> None:
    for end in (process.terminate, process.kill):
        with suppress(ProcessLookupError):
            if process.poll() is None:
                end()
        with suppress(subprocess.TimeoutExpired):
            process.wait(timeout=_TERMINATION_S)
            return
