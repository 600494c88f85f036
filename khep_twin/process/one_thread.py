"""Objects whose methods run in one thread at a time: a second thread gets an error immediately.

Threads may take turns in using an object.
"""

from collections.abc import Callable
from functools import wraps
from threading import RLock
from typing import Concatenate, ParamSpec, Protocol, TypeVar


class Guarded(Protocol):
    """Object with a lock, which its parts may share."""

    guard: RLock


Owner = TypeVar("Owner", bound=Guarded)
Arguments = ParamSpec("Arguments")
Result = TypeVar("Result")


def one_thread(
    method: Callable[Concatenate[Owner, Arguments], Result],
) -> Callable[Concatenate[Owner, Arguments], Result]:
    """Return a method that raises a `RuntimeError` while another thread runs a method of the same object."""

    @wraps(method)
    def guarded(self: Owner, /, *arguments: Arguments.args, **options: Arguments.kwargs) -> Result:
        guard = self.guard
        if not guard.acquire(False):
            raise second_thread_error(self, method.__name__)
        try:
            return method(self, *arguments, **options)
        finally:
            guard.release()

    return guarded


def second_thread_error(instance: object, method: str) -> RuntimeError:
    """Return the error of a second thread that calls a method of an object."""
    return RuntimeError(
        f"{method.lstrip('_')}: another thread is inside this {type(instance).__name__}; expected one thread "
        "at a time, or an object for each"
    )
