"""Options of `reset`, checked: start, lamps, playpen and seed of the next episodes."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, fields
from os import PathLike
from typing import Any, Self, cast

import numpy as np

from khep_twin.envs.arguments import check_mapping
from khep_twin.episodes.episode_options import as_integer
from khep_twin.errors import KhepTwinError, choices, value_text
from khep_twin.playpen import Lamp, Playpen, PlaypenLike
from khep_twin.playpen.starts import Start
from khep_twin.randomness import SEED_LIMIT


def is_list(value: object) -> bool:
    """Return whether this is a list, tuple or array."""
    return isinstance(value, list | tuple) or (isinstance(value, np.ndarray) and value.ndim > 0)


def is_nested(value: object) -> bool:
    """Return whether this is a list that contains lists."""
    return is_list(value) and any(is_list(item) for item in cast(Iterable[object], value))


_IS_LIST: Mapping[str, Callable[[Any], bool]] = {
    "seed": is_list,
    "start": is_nested,
    "lamps": is_nested,
    "playpen": is_list,
}
"""Functions that return whether an option's value is a list with one per environment."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ResetOptions:
    """Options of one episode, which replace its environment's if they are not None.

    Attributes:
        seed: Seed of the episode.
        start: Start x, y [mm] and heading [deg], or one for each robot.
        lamps: Lamps of the playpen.
        playpen: Playpen, or its name or path.
    """

    seed: int | None = None
    start: Start | Sequence[Start] | None = None
    lamps: Sequence[Lamp] | None = None
    playpen: PlaypenLike | None = None

    @classmethod
    def of(cls, options: Mapping[str, Any] | None) -> Self:
        """Return the options in a mapping.

        Raises:
            KhepTwinError: A name is unknown, or a value has another type.
            ValueError: The seed is no integer from 0 to 2**63-1.
        """
        values = {
            name: value for name, value in check_mapping("options", options).items() if value is not None
        }
        known_names = [field.name for field in fields(cls)]
        for name in values:
            if name not in known_names:
                raise KhepTwinError(f"options: {value_text(name)}: unknown; {choices(name, known_names)}")
        if "seed" in values:
            values["seed"] = validate_seed(values["seed"])
        if "lamps" in values:
            values["lamps"] = validate_lamps(values["lamps"])
        if "playpen" in values:
            values["playpen"] = validate_playpen(values["playpen"])
        return cls(**values)

    @classmethod
    def of_each(cls, options: Mapping[str, Any], count: int) -> list[Self]:
        """Return the options of `count` environments; a value may be a list with one per environment.

        Raises:
            KhepTwinError: As for `of`, or a list has another length.
            ValueError: A seed is no integer from 0 to 2**63-1.
        """
        options = check_mapping("options", options)
        lists = {name: _repeat(name, value, count) for name, value in options.items() if name in _IS_LIST}
        if not lists:
            return [cls.of(options)] * count
        shared = {name: value for name, value in options.items() if name not in lists}
        rows = (dict(zip(lists, values, strict=True)) for values in zip(*lists.values(), strict=True))
        return [cls.of({**shared, **row}) for row in rows]


def validate_seed(value: object, location: str = "options") -> int:
    """Return a seed; raise a `ValueError` unless it is an integer from 0 to 2**63-1."""
    if (seed := as_integer(value)) is not None and 0 <= seed < SEED_LIMIT:
        return seed
    raise ValueError(f"{location}: seed = {value_text(value)}; expected an integer from 0 to 2**63-1")


def validate_playpen(value: object) -> PlaypenLike:
    """Return a playpen, its name or its path; raise a `KhepTwinError` for other types."""
    if isinstance(value, Playpen | str | PathLike):
        return cast(PlaypenLike, value)
    raise KhepTwinError(
        f"playpen = {value_text(value)}; expected the name or path of a playpen, or a Playpen"
    )


def validate_lamps(value: object) -> Sequence[Lamp]:
    """Return a list of lamps; raise a `KhepTwinError` if the value is not one."""
    lamps = list(cast(Iterable[object], value)) if isinstance(value, list | tuple) else [None]
    if not all(isinstance(lamp, Lamp) for lamp in lamps):
        raise KhepTwinError(f"lamps = {value_text(cast(object, value))}; expected a list of khep_twin.Lamp")
    return cast(Sequence[Lamp], lamps)


def _repeat(name: str, value: Any, count: int) -> Sequence[Any]:
    """Return one value per environment; raise a `KhepTwinError` if a list has another length."""
    if not _IS_LIST[name](value):
        return [value] * count
    if len(value) != count:
        raise KhepTwinError(f"options: {len(value)} of {name}; expected one, or one for each of {count}")
    return list(value)
