"""Objects that one thread at a time may be inside of: a second one gets an error, at once.

An object may pass from thread to thread between calls.
"""

from collections.abc import Callable
from functools import wraps
from threading import RLock
from typing import Concatenate, ParamSpec, Protocol, TypeVar


class Guarded(Protocol):
    """Object with a lock, which it may share with objects that it consists of."""

    guard: RLock


Own = TypeVar("Own", bound=Guarded)
Given = ParamSpec("Given")
Result = TypeVar("Result")


def one_thread(
    method: Callable[Concatenate[Own, Given], Result],
) -> Callable[Concatenate[Own, Given], Result]:
    """Return a method that raises a `RuntimeError` while another thread is inside of its object."""

    @wraps(method)
    def guarded(self: Own, /, *given: Given.args, **options: Given.kwargs) -> Result:
        guard = self.guard
        if not guard.acquire(False):
            raise entered_twice(self, method.__name__)
        try:
            return method(self, *given, **options)
        finally:
            guard.release()

    return guarded


def entered_twice(entered: object, method: str) -> RuntimeError:
    """Return the error about a second thread in a method of an object."""
    return RuntimeError(
        f"{method.lstrip('_')}: another thread is inside this {type(entered).__name__}; expected one thread "
        "at a time, or an object for each"
    )
