"""Graceful shutdown on SIGINT (Ctrl-C), SIGTERM or SIGHUP.

`answered` surrounds a whole command. A first signal lets a section under `stopping` finish by itself, and
interrupts everything else by KeyboardInterrupt, once no module is being imported. A second signal, or
PATIENCE, interrupts in any case. A process that still runs LAST after that is ended by a second thread, which
first runs the clean-up registered by `clear_at_end`, such as completing a log.
"""

import _thread
import os
import select
import signal
import socket
import sys
import threading
import time
from collections.abc import Callable, Generator, Iterable
from contextlib import ExitStack, contextmanager, suppress
from functools import partial
from types import FrameType
from typing import NoReturn

from khep_twin.errors import KhepTwinError

_KNOWN = signal.Signals.__members__

SIGNALS = tuple(_KNOWN[name] for name in ("SIGINT", "SIGTERM", "SIGHUP") if name in _KNOWN)

GRACE = 0.3
"""Time after which the user is informed of what is awaited [s]."""

PATIENCE = 2.5
"""Time after which everything is interrupted, as by a second signal [s]."""

LAST = 0.5
"""Time from the interruption to the end of the process by the second thread [s]."""

FAREWELL = 0.7
"""Longest time for the clean-up then [s]."""

_NUDGE = _KNOWN.get("SIGURG", signal.SIGINT)
"""Signal that wakes the main thread; SIGURG is ignored by default and rarely used."""

_TURN = 0.05
"""Interval of wake-up signals [s]."""

_CALM, _END = 0, 255
"""Messages from the main to the watching thread, in the pipe that carries the numbers of signals."""

_writing = threading.RLock()


class Interrupted(KeyboardInterrupt):
    """Interruption by a signal; a plain KeyboardInterrupt in exec or eval would end Python as by SIGINT."""


def asked_by() -> int:
    """Return the number of the first signal that was handled, 0 without one."""
    return _ending.number


@contextmanager
def answered() -> Generator[None]:
    """Handle signals within this context, and run all registered clean-up at its end.

    An ignored SIGHUP, as by nohup, stays ignored. Outside the main thread, and when nested, this does
    nothing.
    """
    if _ending.watched or threading.current_thread() is not threading.main_thread():
        yield
        return
    with ExitStack() as stack:
        _ending.begin(stack)
        try:
            yield
        except KhepTwinError:
            raise
        except Exception as error:
            # Some libraries convert any exception to an error of their own; MuJoCo's does not even name it.
            if _ending.interrupted:
                raise Interrupted from error
            raise
        finally:
            _ending.held += 1
            for each in [*_leftovers.values()]:
                stack.callback(each)


def is_interruption(error: BaseException) -> bool:
    """Return whether an exception is an interruption by the user, and not a program's own."""
    cause: BaseException | None = error
    while cause is not None:
        if isinstance(cause, Interrupted):
            return True
        # Some libraries, such as pydantic, convert any exception to an error of their own.
        cause = cause.__cause__ or cause.__context__
    # Where signals are not handled, this is Python's own reaction to Ctrl-C.
    return isinstance(error, KeyboardInterrupt) and (bool(_ending.number) or not _ending.watched)


def leave(code: int) -> NoReturn:
    """End the process, after all its resources are closed.

    Args:
        code: Exit code.
    """
    others = [each for each in threading.enumerate() if each is not threading.main_thread()]
    if asked_by() and any(not each.daemon for each in others):
        # Python would wait for threads that are still busy.
        for stream in filter(None, (sys.stdout, sys.stderr)):
            stream.flush()
        os._exit(code)
    sys.exit(code)


@contextmanager
def stopping(
    awaited: str | None = "coming to an end", hold: Callable[[], None] | None = None
) -> Generator[Callable[[], bool]]:
    """Yield a function that returns True after a first signal, which does not interrupt the section.

    Args:
        awaited: Description of the wait, for the user; None for no message.
        hold: Function that stops motors, called in another thread if the wait is long.
    """
    with answered():
        wait = (awaited, hold)
        _ending.waits.append(wait)
        try:
            yield lambda: bool(_ending.number)
        finally:
            _ending.waits.remove(wait)
            if _ending.number:
                _ending.send(_CALM)


def clear_at_end(clear: Callable[[], object]) -> Callable[[], object]:
    """Register clean-up to run before the process ends, for any cause except SIGKILL.

    Where signals are not handled, nothing is registered.

    Args:
        clear: Clean-up function, safe to call in any thread and concurrently with its object.

    Returns:
        Function that cancels the registration.
    """
    key = object()
    if _ending.watched:
        _leftovers[key] = clear
    return partial(_leftovers.pop, key, None)


@contextmanager
def undisturbed() -> Generator[None]:
    """Block signals and other threads' writing: half a record would corrupt what follows."""
    with _writing:
        if threading.current_thread() is not threading.main_thread():
            yield
        elif _ending.watched:
            _ending.held += 1
            try:
                yield
            finally:
                _ending.held -= 1
                _ending.interrupt(None)
        else:
            with _held_back():
                yield


_leftovers: dict[object, Callable[[], object]] = {}


class _Ending:
    """State of the process's shutdown.

    Attributes:
        number: Number of the first signal, 0 before.
        waits: Sections under `stopping`, the innermost last: message, and function that stops the motors.
        held: Number of sections that block signals.
        watched: True if signals are handled.
        interrupted: True if the main thread has been interrupted.
    """

    def __init__(self) -> None:
        self.waits: list[tuple[str | None, Callable[[], None] | None]] = []
        self._leaves_forks = False
        self._reader: socket.socket | None = None
        self._writer: socket.socket | None = None
        self._mask: set[int] = set()
        self.number = 0
        self.reset()

    def reset(self) -> None:
        """Restore the initial state, except the number of the signal."""
        self.held = 0
        self.interrupted = self.watched = self._noticed = self._due = self._urgent = self._is_held = False
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
        stack.callback(self.send, _END)
        stack.callback(
            signal.set_wakeup_fd, signal.set_wakeup_fd(self._writer.fileno(), warn_on_full_buffer=False)
        )
        self.watched = True
        for number in (*SIGNALS, _NUDGE):
            if (handler := signal.getsignal(number)) is not signal.SIG_IGN or number != _KNOWN.get("SIGHUP"):
                stack.callback(signal.signal, number, handler or signal.SIG_DFL)
                signal.signal(number, self._handle)
        if sys.platform != "win32" and not self._leaves_forks:
            self._leaves_forks = True
            os.register_at_fork(before=self._fork, after_in_parent=self._forked, after_in_child=self._leave)

    def send(self, message: int) -> None:
        """Send a message to the watching thread, which a fork lacks."""
        if self.watched and self._writer is not None:
            self._writer.send(bytes([message]))

    def interrupt(self, frame: FrameType | None) -> None:
        """Raise `Interrupted` in the main thread if it is due and not blocked."""
        if self._due and not self.held and (self._urgent or not _is_importing(frame)):
            self._due = False
            self.interrupted = True
            raise Interrupted

    def _handle(self, number: int, frame: FrameType | None) -> None:
        if number in SIGNALS and not self._noticed:
            self._noticed, self.number = True, self.number or number
            self._due = not self.waits
        self.interrupt(frame)

    def _fork(self) -> None:
        """Block signals: those of a fork must not be taken for this process's."""
        if sys.platform != "win32":
            self._mask = signal.pthread_sigmask(signal.SIG_BLOCK, SIGNALS)

    def _forked(self) -> None:
        if sys.platform != "win32":
            signal.pthread_sigmask(signal.SIG_SETMASK, self._mask)

    def _leave(self) -> None:
        """Restore the default handling of signals in a fork."""
        if self.watched:
            self.watched = False
            signal.set_wakeup_fd(-1)
            for number in (*SIGNALS, _NUDGE):
                signal.signal(number, signal.SIG_DFL)
        self._forked()

    # The second thread ---------------------------------------------------------------------------------

    def _watch(self) -> None:
        while (first := self._next(None)) != _END:
            if first is None or first == _CALM:
                continue
            again = self._next(GRACE)
            self.number = self.number or first  # C code, or another handler, may come first
            if again is None:
                _beside([self._tell, self._hold])
                again = self._next(PATIENCE - GRACE)
            if again == _CALM:  # the awaited section has ended
                continue
            if again == _END:
                return
            _beside([self._hold])
            self._urgent = self._due = True
            deadline = time.monotonic() + LAST
            while (left := deadline - time.monotonic()) > 0:
                if self._next(left) == _END:
                    return
            _beside([*_leftovers.values()], FAREWELL)
            os._exit(128 + self.number)

    def _next(self, wait: float | None) -> int | None:
        """Return the next signal or message; None if there is none within `wait` [s]."""
        reader = self._reader
        assert reader is not None
        deadline = time.monotonic() + (threading.TIMEOUT_MAX if wait is None else wait)
        while (left := deadline - time.monotonic()) > 0:
            if select.select([reader], [], [], left if wait is None else min(left, _TURN))[0]:
                byte = reader.recv(1)[0]
                if byte in (*SIGNALS, _CALM, _END):
                    return byte
            elif self._due:
                _nudge()
        return None

    def _tell(self) -> None:
        awaited = self.waits[-1][0] if self.waits else "coming to an end"
        if awaited is not None:
            name = signal.Signals(self.number).name
            how = f"ends in {PATIENCE + LAST:.0f} s at most, or at another signal"
            print(f"khep-twin: {name}: {awaited}; {how}", file=sys.stderr, flush=True)

    def _hold(self) -> None:
        if self.waits and (hold := self.waits[-1][1]) is not None and not self._is_held:
            self._is_held = True
            hold()


_ending = _Ending()


def _beside(todo: Iterable[Callable[[], object]], wait: float = 0.0) -> None:
    """Call each function in its own thread, as any may hang, and wait for them for at most `wait` [s]."""

    def call(each: Callable[[], object]) -> None:
        # It may be done already, and a process that ends has no use for further errors.
        with suppress(Exception):
            each()

    threads = [threading.Thread(target=call, args=[each], daemon=True) for each in todo]
    for thread in threads:
        thread.start()
    deadline = time.monotonic() + wait
    for thread in threads:
        thread.join(max(deadline - time.monotonic(), 0))


def _nudge() -> None:
    """Wake the main thread; on Windows once its present call has ended."""
    if sys.platform == "win32":
        _thread.interrupt_main(_NUDGE)
    else:
        signal.pthread_kill(threading.main_thread().ident or 0, _NUDGE)


def _is_importing(frame: FrameType | None) -> bool:
    """Return whether a module is being imported; an interrupted import may raise or print anything."""
    while frame is not None and not frame.f_code.co_filename.startswith("<frozen importlib"):
        frame = frame.f_back
    return frame is not None


@contextmanager
def _held_back() -> Generator[None]:
    """Delay Ctrl-C in a program that handles it by itself."""
    handler = signal.getsignal(signal.SIGINT)
    if not callable(handler):
        yield
        return
    held: list[tuple[int, FrameType | None]] = []
    signal.signal(signal.SIGINT, lambda number, frame: held.append((number, frame)))
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, handler)
        if held:
            handler(*held[0])
