"""The end of a process that is asked to end, by SIGINT (Ctrl-C), SIGTERM or SIGHUP.

`answered` surrounds a whole command. A first signal leaves what is `stopping` to come to its end by itself,
and interrupts everything else by KeyboardInterrupt, once no module is being imported. A second signal, or
PATIENCE, interrupts in any case. What goes on LAST after that is ended by a thread beside it: that thread
clears up what has been noted by `clear_at_end`, such as a log to complete, and ends the process.
"""

import os
import select
import signal
import sys
import threading
import time
from collections.abc import Callable, Generator, Iterable
from contextlib import ExitStack, contextmanager, suppress
from functools import partial
from types import FrameType
from typing import NoReturn

from khep_twin.errors import KhepTwinError

SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)

GRACE = 0.3
"""After so much time without an end the user is told what is waited for [s]."""

PATIENCE = 2.5
"""After so much time everything is interrupted, as by a second signal [s]."""

LAST = 0.5
"""After so much time since then the process is ended from beside [s]."""

FAREWELL = 0.7
"""Longest time that clearing up may take then [s]."""

_NUDGE = signal.SIGURG
"""Sent to the main thread to have it look; by default this signal is ignored, and hardly anybody sends it."""

_TURN = 0.05
"""Interval of nudges [s]."""

_CALM, _END = 0, 255
"""What the main thread tells the watching thread, by the pipe that carries the numbers of signals."""

_writing = threading.RLock()


class Interrupted(KeyboardInterrupt):
    """A signal; after a plain KeyboardInterrupt out of exec or eval Python would end as if by SIGINT."""


def asked_by() -> int:
    """Return the number of the first signal that was answered, 0 without one."""
    return _ending.number


@contextmanager
def answered() -> Generator[None]:
    """Answer signals for as long as this goes on, and leave nothing behind of what was noted meanwhile.

    A hang-up that is ignored, as by nohup, stays ignored. In another than the main thread, and within
    itself, it does nothing.
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
            # Some libraries make an error of their own of any exception; MuJoCo's tells not even of which.
            if _ending.interrupted:
                raise Interrupted from error
            raise
        finally:
            _ending.held += 1
            for each in [*_leftovers.values()]:
                stack.callback(each)


def is_interruption(error: BaseException) -> bool:
    """Return whether an exception is an end that somebody has asked for, and not a program's own doing."""
    cause: BaseException | None = error
    while cause is not None:
        if isinstance(cause, Interrupted):
            return True
        # Some libraries, as pydantic, make an error of their own of any exception.
        cause = cause.__cause__ or cause.__context__
    # Where signals are not answered, Python's own answer to Ctrl-C is just this.
    return isinstance(error, KeyboardInterrupt) and (bool(_ending.number) or not _ending.watched)


def leave(code: int) -> NoReturn:
    """End the process, of which nothing is open any more.

    Args:
        code: Exit code.
    """
    others = [each for each in threading.enumerate() if each is not threading.main_thread()]
    if asked_by() and any(not each.daemon for each in others):
        # Python would wait for threads that are amid something.
        for stream in filter(None, (sys.stdout, sys.stderr)):
            stream.flush()
        os._exit(code)
    sys.exit(code)


@contextmanager
def stopping(
    awaited: str | None = "coming to an end", hold: Callable[[], None] | None = None
) -> Generator[Callable[[], bool]]:
    """Yield a function that says whether the process was asked to end; a first signal does no more than that.

    Args:
        awaited: What is under way then, for the user; None to tell nothing.
        hold: Is called in another thread if that takes a while, to stop motors.
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
    """Note what has to be done before the process ends, whatever ends it but SIGKILL.

    Where no signals are answered, nothing is noted.

    Args:
        clear: May be called in any thread, and beside what it clears up.

    Returns:
        A function that takes the note back.
    """
    key = object()
    if _ending.watched:
        _leftovers[key] = clear
    return partial(_leftovers.pop, key, None)


@contextmanager
def undisturbed() -> Generator[None]:
    """Hold signals back for a moment, and other threads' writing: half a record would spoil what follows."""
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
    """The process's end.

    Attributes:
        number: Of the first signal, 0 before.
        waits: What is stopping, the innermost last: what to tell of it, and what stops the motors.
        held: How many sections are not to be disturbed.
        watched: Whether signals are answered.
        interrupted: Whether the main thread has been interrupted.
    """

    def __init__(self) -> None:
        self.waits: list[tuple[str | None, Callable[[], None] | None]] = []
        self._leaves_forks = False
        self._mask: set[int] = set()
        self.number = 0
        self.reset()

    def reset(self) -> None:
        """Be as before anything was answered, but for the signal that it was asked by."""
        self.held = 0
        self.interrupted = self.watched = self._noticed = self._due = self._urgent = self._is_held = False
        self._reader = self._writer = -1

    def begin(self, stack: ExitStack) -> None:
        """Set the handlers, and begin to watch; `stack` undoes it."""
        self.number = 0
        self._reader, self._writer = os.pipe()
        stack.callback(os.close, self._reader)
        stack.callback(os.close, self._writer)
        os.set_blocking(self._writer, False)
        watch = threading.Thread(target=self._watch, name="signals", daemon=True)
        watch.start()
        stack.callback(self.reset)
        stack.callback(watch.join)
        stack.callback(self.send, _END)
        stack.callback(signal.set_wakeup_fd, signal.set_wakeup_fd(self._writer, warn_on_full_buffer=False))
        self.watched = True
        for number in (*SIGNALS, _NUDGE):
            if (handler := signal.getsignal(number)) is not signal.SIG_IGN or number != signal.SIGHUP:
                stack.callback(signal.signal, number, handler or signal.SIG_DFL)
                signal.signal(number, self._handle)
        if not self._leaves_forks:
            self._leaves_forks = True
            os.register_at_fork(before=self._fork, after_in_parent=self._forked, after_in_child=self._leave)

    def send(self, message: int) -> None:
        """Tell the watching thread, which a fork has not."""
        if self.watched:
            os.write(self._writer, bytes([message]))

    def interrupt(self, frame: FrameType | None) -> None:
        """Raise KeyboardInterrupt in the main thread if it is due, and nothing stands against it."""
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
        """Hold signals back: those of a fork are not to be taken for this process's."""
        self._mask = signal.pthread_sigmask(signal.SIG_BLOCK, SIGNALS)

    def _forked(self) -> None:
        signal.pthread_sigmask(signal.SIG_SETMASK, self._mask)

    def _leave(self) -> None:
        """Have a fork take signals as any other process."""
        if self.watched:
            self.watched = False
            signal.set_wakeup_fd(-1)
            for number in (*SIGNALS, _NUDGE):
                signal.signal(number, signal.SIG_DFL)
        self._forked()

    # The thread beside ---------------------------------------------------------------------------------

    def _watch(self) -> None:
        while (first := self._next(None)) != _END:
            if first is None or first == _CALM:
                continue
            again = self._next(GRACE)
            self.number = self.number or first  # a call of C, or a handler of somebody else's, comes before
            if again is None:
                _beside([self._tell, self._hold])
                again = self._next(PATIENCE - GRACE)
            if again == _CALM:  # what was waited for has come to its end
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
        """Return the next signal or message; None if there is none for so long [s]."""
        deadline = time.monotonic() + (threading.TIMEOUT_MAX if wait is None else wait)
        while (left := deadline - time.monotonic()) > 0:
            if select.select([self._reader], [], [], left if wait is None else min(left, _TURN))[0]:
                byte = os.read(self._reader, 1)[0]
                if byte in (*SIGNALS, _CALM, _END):
                    return byte
            elif self._due:
                signal.pthread_kill(threading.main_thread().ident or 0, _NUDGE)
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
    """Call each in a thread of its own, as any of them may hang, and wait for them for a while [s]."""

    def call(each: Callable[[], object]) -> None:
        # It may be done already; and what is being ended has nobody to tell of more.
        with suppress(Exception):
            each()

    threads = [threading.Thread(target=call, args=[each], daemon=True) for each in todo]
    for thread in threads:
        thread.start()
    deadline = time.monotonic() + wait
    for thread in threads:
        thread.join(max(deadline - time.monotonic(), 0))


def _is_importing(frame: FrameType | None) -> bool:
    """Whether a module is being imported: one that is broken off there may raise or print anything."""
    while frame is not None and not frame.f_code.co_filename.startswith("<frozen importlib"):
        frame = frame.f_back
    return frame is not None


@contextmanager
def _held_back() -> Generator[None]:
    """Hold Ctrl-C back in a program that answers it by itself."""
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
