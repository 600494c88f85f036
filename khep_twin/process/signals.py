"""Graceful shutdown on SIGINT (Ctrl-C), SIGTERM or SIGHUP.

`handle_signals` surrounds a whole command. After a first signal a section under `stopping` finishes normally;
any other code is interrupted by KeyboardInterrupt, once no module is being imported. A second signal, or
`shutdown.INTERRUPTION_S`, interrupts in any case. A process that still runs `shutdown.EXIT_S` after that is
ended by a second thread, which first runs the clean-up registered by `register_cleanup`, for example to
complete a log.
"""

import os
import signal
import sys
import threading
from collections.abc import Callable, Generator
from contextlib import ExitStack, contextmanager
from functools import partial
from types import FrameType
from typing import NoReturn

from khep_twin.errors import KhepTwinError
from khep_twin.process.shutdown import Interrupted, shutdown

_write_lock = threading.RLock()


def first_signal() -> int:
    """Return the number of the first signal that was handled, 0 without one."""
    return shutdown.number


@contextmanager
def handle_signals() -> Generator[None]:
    """Handle signals within this context, and run all registered clean-up at its end.

    An ignored SIGHUP, as by nohup, stays ignored. Outside the main thread, and nested, it does nothing.
    """
    if shutdown.watched or threading.current_thread() is not threading.main_thread():
        yield
        return
    with ExitStack() as stack:
        shutdown.begin(stack)
        try:
            yield
        except KhepTwinError:
            raise
        except Exception as error:
            # Some libraries convert any exception to another error; MuJoCo's does not name the cause.
            if shutdown.interrupted:
                raise Interrupted from error
            raise
        finally:
            shutdown.n_blocking += 1
            for clean_up in [*shutdown.clean_ups.values()]:
                stack.callback(clean_up)


def is_interruption(error: BaseException) -> bool:
    """Return whether an exception is an interruption by the user, not one that a program raised."""
    cause: BaseException | None = error
    while cause is not None:
        if isinstance(cause, Interrupted):
            return True
        # Some libraries, such as pydantic, convert any exception to another error.
        cause = cause.__cause__ or cause.__context__
    # Where signals are not handled, this is Python's own reaction to Ctrl-C.
    return isinstance(error, KeyboardInterrupt) and (bool(shutdown.number) or not shutdown.watched)


def leave(code: int) -> NoReturn:
    """End the process with an exit code, after all its resources are closed."""
    threads = [thread for thread in threading.enumerate() if thread is not threading.main_thread()]
    if first_signal() and any(not thread.daemon for thread in threads):
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
    with handle_signals():
        section = (awaited, hold)
        shutdown.sections.append(section)
        try:
            yield lambda: bool(shutdown.number)
        finally:
            shutdown.end_section(section)


def register_cleanup(cleanup: Callable[[], object]) -> Callable[[], object]:
    """Register clean-up to run before the process ends, for any cause except SIGKILL.

    Where signals are not handled, nothing is registered.

    Args:
        cleanup: Clean-up function, safe to call in any thread and concurrently with its object.

    Returns:
        Function that cancels the registration.
    """
    key = object()
    if shutdown.watched:
        shutdown.clean_ups[key] = cleanup
    return partial(shutdown.clean_ups.pop, key, None)


@contextmanager
def block_signals() -> Generator[None]:
    """Block signals and other threads' writing: half a record would corrupt the records after it."""
    with _write_lock:
        if threading.current_thread() is not threading.main_thread():
            yield
        elif shutdown.watched:
            shutdown.n_blocking += 1
            try:
                yield
            finally:
                shutdown.n_blocking -= 1
                shutdown.interrupt(None)
        else:
            with _delay_interrupts():
                yield


@contextmanager
def _delay_interrupts() -> Generator[None]:
    """Delay Ctrl-C in a program that handles it without `handle_signals`."""
    handler = signal.getsignal(signal.SIGINT)
    if not callable(handler):
        yield
        return
    delayed_signals: list[tuple[int, FrameType | None]] = []
    signal.signal(signal.SIGINT, lambda number, frame: delayed_signals.append((number, frame)))
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, handler)
        if delayed_signals:
            handler(*delayed_signals[0])
