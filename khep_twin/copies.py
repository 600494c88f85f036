"""Copies, by `copy.deepcopy` or `pickle`, of objects that contain a MuJoCo scene, which cannot be copied.

Some are constructed again from their arguments, also in another process. Others raise an error with advice,
as only a snapshot or the seed reproduces their state.
"""

from typing import Any, ClassVar, NoReturn, Self


class CopiedByArguments:
    """An object whose copy is constructed from the same arguments, in its initial state."""

    COPIED_ATTRIBUTES: ClassVar[tuple[str, ...]] = ()
    """Attributes that are copied."""

    _arguments: tuple[tuple[object, ...], dict[str, object]]

    def __new__(cls, *arguments: Any, **options: Any) -> Self:
        """Store the arguments."""
        instance = super().__new__(cls)
        instance._arguments = arguments, options
        return instance

    def __reduce__(self) -> tuple[object, ...]:
        state = {name: value for name, value in vars(self).items() if name in self.COPIED_ATTRIBUTES}
        return _construct, (type(self), *self._arguments), state


class NotCopied:
    """An object that cannot be copied."""

    COPY_ADVICE: ClassVar[str]
    """Alternative to a copy, for the error message."""

    def __reduce_ex__(self, protocol: object) -> NoReturn:
        raise TypeError(f"{type(self).__name__}: cannot be copied or pickled; expected {self.COPY_ADVICE}")


def _construct(kind: Any, arguments: tuple[object, ...], options: dict[str, object]) -> object:
    return kind(*arguments, **options)
