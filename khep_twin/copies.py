"""Copies, by `copy.deepcopy` or `pickle`, of objects around a scene of MuJoCo, which itself cannot be copied.

Some are made anew of their arguments, also in another process; of others only a snapshot or the seed repeats
the state, and a copy is refused with that advice.
"""

from typing import Any, ClassVar, NoReturn, Self


class MadeAnew:
    """An object whose copy is made of the same arguments, in its first state."""

    KEPT: ClassVar[tuple[str, ...]] = ()
    """Attributes that a copy takes over."""

    _arguments: tuple[tuple[object, ...], dict[str, object]]

    def __new__(cls, *arguments: Any, **options: Any) -> Self:
        """Note the arguments."""
        made = super().__new__(cls)
        made._arguments = arguments, options
        return made

    def __reduce__(self) -> tuple[object, ...]:
        kept = {name: value for name, value in vars(self).items() if name in self.KEPT}
        return _make, (type(self), *self._arguments), kept


class NotCopied:
    """An object that is not copied."""

    INSTEAD: ClassVar[str]
    """Advice what to do instead of a copy."""

    def __reduce_ex__(self, protocol: object) -> NoReturn:
        raise TypeError(f"{type(self).__name__}: cannot be copied or pickled; expected {self.INSTEAD}")


def _make(kind: Any, arguments: tuple[object, ...], options: dict[str, object]) -> object:
    return kind(*arguments, **options)
