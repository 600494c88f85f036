"""Options of `reset`, checked: start, lamps and playpen of the episodes that begin, and their seeds."""

import operator
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, fields
from os import PathLike
from typing import Any, Self, SupportsIndex, cast

import numpy as np

from khep_twin.errors import KhepTwinError, choices
from khep_twin.playpen import Lamp, Playpen, PlaypenLike
from khep_twin.playpen.starts import Start
from khep_twin.randomness import SEED_LIMIT

_PLAYPEN = "the name or path of a playpen, or a Playpen"


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ResetOptions:
    """Options of one episode, in place of its environment's own where they are not None.

    Attributes:
        seed: Seed of the episode.
        start: Start x, y [mm] and heading [deg], or one for each robot.
        lamps: Lamps.
        playpen: Playpen.
    """

    seed: int | None = None
    start: Start | Sequence[Start] | None = None
    lamps: Sequence[Lamp] | None = None
    playpen: PlaypenLike | None = None

    @classmethod
    def of(cls, options: Mapping[str, Any] | None) -> Self:
        """Return the options that a mapping has.

        Raises:
            KhepTwinError: A name is unknown, or a value is of another kind.
            ValueError: The seed is no integer from 0 to 2**63-1.
        """
        given = {name: value for name, value in (options or {}).items() if value is not None}
        known = [field.name for field in fields(cls)]
        for name in given:
            if name not in known:
                raise KhepTwinError(f"options: {name!r}: unknown; {choices(name, known)}")
        if "seed" in given:
            given["seed"] = checked_seed(given["seed"])
        if "lamps" in given:
            given["lamps"] = checked_lamps(given["lamps"])
        if "playpen" in given:
            given["playpen"] = checked_playpen(given["playpen"])
        return cls(**given)

    @classmethod
    def of_each(cls, options: Mapping[str, Any], count: int) -> list[Self]:
        """Return the options of each of `count` environments, where a value may be a list with one for each.

        Raises:
            KhepTwinError: As for `of`, or a list has another length.
            ValueError: A seed is no integer from 0 to 2**63-1.
        """
        each = {name: _each(name, value, count) for name, value in options.items() if name in _IS_LIST}
        if not each:
            return [cls.of(options)] * count
        shared = {name: value for name, value in options.items() if name not in each}
        rows = (dict(zip(each, values, strict=True)) for values in zip(*each.values(), strict=True))
        return [cls.of({**shared, **row}) for row in rows]


def checked_seed(given: object) -> int:
    """Return a seed; raise a `ValueError` unless it is an integer from 0 to 2**63-1."""
    if isinstance(given, SupportsIndex) and 0 <= (seed := operator.index(given)) < SEED_LIMIT:
        return seed
    raise ValueError(f"options: seed = {given!r}; expected an integer from 0 to 2**63-1")


def checked_playpen(given: object) -> PlaypenLike:
    """Return what names or is a playpen; raise a `KhepTwinError` if it is anything else."""
    if isinstance(given, Playpen | str | PathLike):
        return cast(PlaypenLike, given)
    raise KhepTwinError(f"playpen = {given!r}; expected {_PLAYPEN}")


def checked_lamps(given: object) -> Sequence[Lamp]:
    """Return lamps; raise a `KhepTwinError` if they are no list of them."""
    lamps = list(cast(Iterable[object], given)) if isinstance(given, list | tuple) else [None]
    if not all(isinstance(lamp, Lamp) for lamp in lamps):
        raise KhepTwinError(f"lamps = {given!r}; expected a list of khep_twin.Lamp")
    return cast(Sequence[Lamp], lamps)


def is_list(given: object) -> bool:
    """Return whether this is a list, also as a tuple or array."""
    return isinstance(given, list | tuple | np.ndarray)


def is_nested(given: object) -> bool:
    """Return whether this is a list with lists in it."""
    return is_list(given) and any(is_list(each) for each in cast(Iterable[object], given))


_IS_LIST: Mapping[str, Callable[[Any], bool]] = {
    "seed": is_list,
    "start": is_nested,
    "lamps": is_nested,
    "playpen": is_list,
}
"""Functions that tell whether the value of an option is a list with one for each environment."""


def _each(name: str, given: Any, count: int) -> Sequence[Any]:
    """Return the value of each of `count` environments; raise a `KhepTwinError` if the number is wrong."""
    if not _IS_LIST[name](given):
        return [given] * count
    if len(given) != count:
        raise KhepTwinError(f"options: {len(given)} of {name}; expected one, or one for each of {count}")
    return list(given)
