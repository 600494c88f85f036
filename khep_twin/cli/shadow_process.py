"""A shadow in a separate process, so that its work never delays the line that it listens to."""

import socket
import subprocess
import sys
from collections.abc import Callable, Generator, Sequence
from contextlib import contextmanager, suppress
from select import select

import typer

from khep_twin.cli.options import notify
from khep_twin.cli.shadow_run import EXIT_CODES
from khep_twin.errors import KhepTwinError
from khep_twin.process.signals import block_signals, register_cleanup
from khep_twin.shadow.line_pipe import LineSender

READY = b"\n"
"""Byte by which a shadow reports that it is ready."""

_POLL_S = 0.05
"""Interval between checks of the process [s]."""

_TERMINATION_S = 2.0
"""Time for a process to end after a signal [s]."""


class ShadowProcess:
    """Process that runs a shadow.

    Args:
        process: Process.
        connection: Socket to the process, for the bytes on the line and the exit code.

    Attributes:
        code: Exit code of the process; None until it is known.
    """

    def __init__(self, process: "subprocess.Popen[bytes]", connection: socket.socket) -> None:
        self._process = process
        self._connection = connection
        self._sender: LineSender | None = None
        self.code: int | None = None

    def make_listener(self, clock: Callable[[], int]) -> LineSender:
        """Return a listener that sends a line to the shadow, with times of this clock [ns]."""
        self._sender = LineSender(self._connection.fileno(), clock)
        return self._sender

    def has_ended_on_event(self) -> bool:
        """Return whether an event of --exit-on has ended it; print a line once if it has ended otherwise."""
        if self.code is None and self._sender is not None and self._sender.is_broken:
            self.code = self._read_code()
            if self.code not in EXIT_CODES.values():
                notify(f"the shadow has ended with code {self.code}; the relay continues without it")
        return self.code in EXIT_CODES.values()

    def finish(self) -> int:
        """Close the line and wait until the shadow has processed the rest; return the exit code."""
        if self._sender is not None:
            self._sender.close()
        if self.code is None:
            self._connection.shutdown(socket.SHUT_WR)
            self.code = self._read_code()
        return self.code

    def _read_code(self) -> int:
        """Wait for the exit code, but not for the process's cleanup."""
        self._connection.setblocking(True)
        try:
            code_byte = self._connection.recv(1)
        except ConnectionResetError:
            code_byte = b""
        return code_byte[0] if code_byte else self._process.wait() or 1


@contextmanager
def run_shadow(args: Sequence[str], stop: Callable[[], bool]) -> Generator[ShadowProcess]:
    """Run a shadow beside this process; it prints its alarms on the same standard output.

    Args:
        args: Arguments of `khep-twin shadow`.
        stop: Function that returns whether to end.
    """
    if sys.platform == "win32":
        raise KhepTwinError("a shadow beside a relay needs Unix; expected a log of the line")
    parent_socket, child_socket = socket.socketpair()
    command = [sys.executable, "-m", "khep_twin", "shadow", *args, "--line-fd", str(child_socket.fileno())]
    with block_signals():
        # Only the relay receives Ctrl-C; the shadow ends with its line, and completes its log.
        process = subprocess.Popen(command, pass_fds=[child_socket.fileno()], start_new_session=True)
        unregister = register_cleanup(lambda: _terminate(process))
        child_socket.close()
    shadow = ShadowProcess(process, parent_socket)
    with parent_socket:
        try:
            while not select([parent_socket], [], [], _POLL_S)[0] and not stop():
                pass
            if not stop() and parent_socket.recv(1) != READY:
                raise typer.Exit(process.wait() or 1)
            yield shadow
        finally:
            if shadow.code is None:
                _terminate(process)
            unregister()


def _terminate(process: "subprocess.Popen[bytes]") -> None:
    """End a process by SIGTERM or, if it continues, by SIGKILL."""
    for send_signal in (process.terminate, process.kill):
        with suppress(ProcessLookupError):
            if process.poll() is None:
                send_signal()
        with suppress(subprocess.TimeoutExpired):
            process.wait(timeout=_TERMINATION_S)
            return
