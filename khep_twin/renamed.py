"""Old names of arguments and attributes, kept for one release with a warning."""

import functools
import warnings
from collections.abc import Callable
from typing import Any, TypeVar, cast

Target = TypeVar("Target", bound=Callable[..., object])


def renamed_arguments(**new_names: str) -> Callable[[Target], Target]:
    """Return a decorator by which a function also accepts old names of arguments (old=new)."""

    def decorate(target: Target) -> Target:
        @functools.wraps(target)
        def call(*args: object, **kwargs: object) -> object:
            for old in filter(kwargs.__contains__, new_names):
                new = new_names[old]
                _warn(old, new)
                if new in kwargs:
                    raise TypeError(f"{old!r} and {new!r} are one argument; expected {new!r} alone")
                kwargs[new] = kwargs.pop(old)
            return target(*args, **kwargs)

        return cast(Target, call)

    return decorate


def renamed_attribute(old: str, new: str) -> Any:
    """Return a property that reads an attribute by its old name."""

    def read(instance: object) -> object:
        _warn(old, new)
        return getattr(instance, new)

    return property(read, doc=f"Old name of `{new}`.")


def _warn(old: str, new: str) -> None:
    warnings.warn(f"{old!r} is an old name and will be removed; expected {new!r}", DeprecationWarning, 3)
