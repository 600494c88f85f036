"""State of a process's shutdown by a signal, and the thread that watches it.

The main thread handles the signals. A second thread interrupts it after `INTERRUPTION_S`, and ends the
process `EXIT_S` later. A section is code under `stopping`, which finishes normally after a first signal.

    running --signal--> noticed --NOTICE_S--> announced --INTERRUPTION_S--> interrupted --EXIT_S--> ended
                           |                      |
                           +----------------------+---- section ended --> running

A second signal leads to "interrupted" immediately, as does a first one outside of all sections.
"""

import _thread
import os
import select
import signal
import socket
import sys
import threading
import time
from collections.abc import Callable, Iterable
from contextlib import ExitStack, suppress
from types import FrameType

_MEMBERS = signal.Signals.__members__

SIGNALS = tuple(_MEMBERS[name] for name in ("SIGINT", "SIGTERM", "SIGHUP") if name in _MEMBERS)

NOTICE_S = 0.3
"""Time after which a message names the awaited work; shorter waits are not noticed [s]."""

INTERRUPTION_S = 2.5
"""Time after which everything is interrupted, as by a second signal; cycles of programs are shorter [s]."""

EXIT_S = 0.5
"""Time from the interruption to the end of the process by the second thread; with it users wait 3 s [s]."""

_CLEAN_UP_S = 0.7
"""Longest time for the registered clean-up then, mostly the last chunks of a log on a slow disk [s]."""

_WAKE_UP = _MEMBERS.get("SIGURG", signal.SIGINT)
"""Signal that wakes the main thread; SIGURG is ignored by default and rarely used."""

_WAKE_UP_INTERVAL_S = 0.05
"""Interval of wake-up signals: one may come just before a system call that it should interrupt [s]."""

_SECTION_ENDED, _SHUTDOWN_ENDED = 0, 255
"""Messages from the main to the watching thread, in the pipe that carries the numbers of signals."""


class Interrupted(KeyboardInterrupt):
    """Interruption by a signal; a plain KeyboardInterrupt in exec or eval would end Python as by SIGINT."""


class Shutdown:
    """State of a process's shutdown.

    Attributes:
        number: Number of the first signal, 0 before.
        sections: Sections under `stopping`, the innermost last: message, and function that stops the motors.
        n_blocking: Number of sections that block signals.
        watched: True if signals are handled.
        interrupted: True if the main thread has been interrupted.
        clean_ups: Functions to call before the process ends, by a key each.
    """

    def __init__(self) -> None:
        self.sections: list[tuple[str | None, Callable[[], None] | None]] = []
        self.clean_ups: dict[object, Callable[[], object]] = {}
        self._has_fork_handlers = False
        self._reader: socket.socket | None = None
        self._writer: socket.socket | None = None
        self._mask: set[int] = set()
        self.number = 0
        self.reset()

    def reset(self) -> None:
        """Restore the initial state, except the number of the signal."""
        self.n_blocking = 0
        self.interrupted = self.watched = self._are_motors_stopped = False
        self._has_signal = self._is_interrupt_due = self._is_urgent = False
        self._reader = self._writer = None

    def begin(self, stack: ExitStack) -> None:
        """Set the handlers and start the watching thread; `stack` undoes it."""
        self.number = 0
        # Windows waits for sockets alone, and wakes no other.
        self._reader, self._writer = socket.socketpair()
        stack.callback(self._reader.close)
        stack.callback(self._writer.close)
        self._writer.setblocking(False)
        watch = threading.Thread(target=self._watch, name="signals", daemon=True)
        watch.start()
        stack.callback(self.reset)
        stack.callback(watch.join)
        stack.callback(self._send, _SHUTDOWN_ENDED)
        stack.callback(
            signal.set_wakeup_fd, signal.set_wakeup_fd(self._writer.fileno(), warn_on_full_buffer=False)
        )
        self.watched = True
        for number in (*SIGNALS, _WAKE_UP):
            if (handler := signal.getsignal(number)) is not signal.SIG_IGN or number != _MEMBERS.get(
                "SIGHUP"
            ):
                stack.callback(signal.signal, number, handler or signal.SIG_DFL)
                signal.signal(number, self._handle)
        if sys.platform != "win32" and not self._has_fork_handlers:
            self._has_fork_handlers = True
            os.register_at_fork(
                before=self._before_fork,
                after_in_parent=self._after_fork,
                after_in_child=self._restore_in_fork,
            )

    def end_section(self, section: tuple[str | None, Callable[[], None] | None]) -> None:
        """Notify the watching thread that an awaited section has ended."""
        self.sections.remove(section)
        if self.number:
            self._send(_SECTION_ENDED)

    def _send(self, message: int) -> None:
        """Send a message to the watching thread, which a fork lacks."""
        if self.watched and self._writer is not None:
            self._writer.send(bytes([message]))

    def interrupt(self, frame: FrameType | None) -> None:
        """Raise `Interrupted` in the main thread if it is due and not blocked."""
        if self._is_interrupt_due and not self.n_blocking and (self._is_urgent or not _is_importing(frame)):
            self._is_interrupt_due = False
            self.interrupted = True
            raise Interrupted

    def _handle(self, number: int, frame: FrameType | None) -> None:
        if number in SIGNALS and not self._has_signal:
            self._has_signal, self.number = True, self.number or number
            self._is_interrupt_due = not self.sections
        self.interrupt(frame)

    def _before_fork(self) -> None:
        """Block signals: those of a fork must not be taken for this process's."""
        if sys.platform != "win32":
            self._mask = signal.pthread_sigmask(signal.SIG_BLOCK, SIGNALS)

    def _after_fork(self) -> None:
        if sys.platform != "win32":
            signal.pthread_sigmask(signal.SIG_SETMASK, self._mask)

    def _restore_in_fork(self) -> None:
        """Restore the default handling of signals in a fork."""
        if self.watched:
            self.watched = False
            signal.set_wakeup_fd(-1)
            for number in (*SIGNALS, _WAKE_UP):
                signal.signal(number, signal.SIG_DFL)
        self._after_fork()

    # The second thread ---------------------------------------------------------------------------------

    def _watch(self) -> None:
        """Report a signal, interrupt the main thread and end the process when their times are over."""
        while (first_message := self._next_message(None)) != _SHUTDOWN_ENDED:
            if first_message is None or first_message == _SECTION_ENDED:
                continue
            next_message = self._next_message(NOTICE_S)
            self.number = self.number or first_message  # C code, or another handler, may come first
            if next_message is None:
                _run_in_threads([self._report_wait, self._stop_motors])
                next_message = self._next_message(INTERRUPTION_S - NOTICE_S)
            if next_message == _SECTION_ENDED:  # the awaited section has ended
                continue
            if next_message == _SHUTDOWN_ENDED:
                return
            _run_in_threads([self._stop_motors])
            self._is_urgent = self._is_interrupt_due = True
            deadline = time.monotonic() + EXIT_S
            while (remaining_s := deadline - time.monotonic()) > 0:
                if self._next_message(remaining_s) == _SHUTDOWN_ENDED:
                    return
            _run_in_threads([*self.clean_ups.values()], _CLEAN_UP_S)
            os._exit(128 + self.number)

    def _next_message(self, wait: float | None) -> int | None:
        """Return the next signal or message; None if there is none within `wait` [s]."""
        reader = self._reader
        assert reader is not None
        deadline = time.monotonic() + (threading.TIMEOUT_MAX if wait is None else wait)
        while (left := deadline - time.monotonic()) > 0:
            if select.select([reader], [], [], left if wait is None else min(left, _WAKE_UP_INTERVAL_S))[0]:
                byte = reader.recv(1)[0]
                if byte in (*SIGNALS, _SECTION_ENDED, _SHUTDOWN_ENDED):
                    return byte
            elif self._is_interrupt_due:
                _wake_main_thread()
        return None

    def _report_wait(self) -> None:
        awaited = self.sections[-1][0] if self.sections else "coming to an end"
        if awaited is not None:
            name = signal.Signals(self.number).name
            end_text = f"ends in {INTERRUPTION_S + EXIT_S:.0f} s at most, or at another signal"
            print(f"khep-twin: {name}: {awaited}; {end_text}", file=sys.stderr, flush=True)

    def _stop_motors(self) -> None:
        if self.sections and (hold := self.sections[-1][1]) is not None and not self._are_motors_stopped:
            self._are_motors_stopped = True
            hold()


shutdown = Shutdown()
"""Shutdown of this process."""


def _run_in_threads(functions: Iterable[Callable[[], object]], timeout_s: float = 0.0) -> None:
    """Call each function in a separate thread, as any may hang; wait for them for at most `timeout_s`."""

    def call(function: Callable[[], object]) -> None:
        # It may have run already, and a process that ends reports no further errors.
        with suppress(Exception):
            function()

    threads = [threading.Thread(target=call, args=[function], daemon=True) for function in functions]
    for thread in threads:
        thread.start()
    deadline = time.monotonic() + timeout_s
    for thread in threads:
        thread.join(max(deadline - time.monotonic(), 0))


def _wake_main_thread() -> None:
    """Wake the main thread; on Windows once its present call has ended."""
    if sys.platform == "win32":
        _thread.interrupt_main(_WAKE_UP)
    else:
        signal.pthread_kill(threading.main_thread().ident or 0, _WAKE_UP)


def _is_importing(frame: FrameType | None) -> bool:
    """Return whether a module is being imported; an interrupted import may raise or print anything."""
    while frame is not None and not frame.f_code.co_filename.startswith("<frozen importlib"):
        frame = frame.f_back
    return frame is not None
