"""Model of a playpen, and reading, checking and writing of playpen files."""

import reprlib
from collections.abc import Mapping
from functools import partial
from itertools import islice
from pathlib import Path
from typing import Self

import numpy as np
from pydantic import SerializerFunctionWrapHandler, ValidationInfo, model_serializer, model_validator

from khep_twin.errors import PlaypenError
from khep_twin.files import toml_files
from khep_twin.files.paths import StrPath
from khep_twin.files.toml_files import PROBLEM_LIMIT, Problems, Table
from khep_twin.playpen.checks import assign_spots, complete_robots, default_keys, playpen_problems
from khep_twin.playpen.tables import PlaypenTables

MANY_ROBOTS = 100
"""Number of robots above which a scene takes long to compile: 1 s for 100, 3 s for 200, a minute for 500."""


class Playpen(PlaypenTables):
    """A complete playpen."""

    @classmethod
    def load(cls, playpen: "PlaypenLike") -> "Playpen":
        """Load a playpen by the bare name of a shipped one, or by path; return a `Playpen` unchanged.

        Raises:
            PlaypenError: The file does not exist or cannot be used; one line per problem.
        """
        if isinstance(playpen, Playpen):
            return playpen
        try:
            path = Path(playpen)
        except TypeError:
            value = reprlib.repr(playpen)
            raise PlaypenError(f"{value}: expected one playpen, its name or its path") from None
        text, source = toml_files.read("playpens", path, PlaypenError)
        return parse(text, source)

    @model_serializer(mode="wrap")
    def _without_empty_arrays(self, serialize: SerializerFunctionWrapHandler) -> dict[str, object]:
        # TOML allows no [[lamp]] after `lamp = []`.
        return {key: value for key, value in serialize(self).items() if value not in ([], (), {})}

    @model_validator(mode="before")
    @classmethod
    def _complete_robots(cls, data: object) -> object:
        # A robot stands at the first of its spots until the seed selects one.
        return complete_robots(data) if isinstance(data, dict) else data  # pyright: ignore

    @model_validator(mode="after")
    def _check_parts(self, info: ValidationInfo) -> Self:
        context: Mapping[str, object] = info.context or {}
        options = {"recorded": bool(context.get("recorded")), "placed": bool(context.get("placed", True))}
        problems = list(islice(playpen_problems(self, **options), PROBLEM_LIMIT + 1))
        if problems:
            raise Problems(problems)
        return self


PlaypenLike = Playpen | StrPath
"""A playpen, the bare name of a shipped one, or the path of a file."""


def parse(text: str, source: str, recorded: bool = False) -> Playpen:
    """Parse the text of a playpen file.

    Args:
        text: Text in TOML.
        source: Name of the file in messages.
        recorded: True for a playpen of a recorded run, whose walls may be lower than allowed for robots.

    Raises:
        PlaypenError: It is invalid; one line per problem.
    """
    return toml_files.validate(Playpen, text, source, PlaypenError, {"recorded": recorded})


def dump(playpen: Playpen) -> str:
    """Return a playpen as the text of a file, the inverse of `parse`; equal playpens give the same text."""
    return toml_files.dump(playpen)


def edited(text: str, playpen: Playpen) -> str:
    """Return a playpen file's text, changed to describe `playpen`; comments and other keys stay.

    Args:
        text: Text of a file that `parse` accepts.
        playpen: Playpen to describe.

    Raises:
        PlaypenError: The text is no playpen, or its form cannot be changed in place.
    """
    current = parse(text, "the file to be edited")
    changed = toml_files.edit(text, current, playpen, _drop_outdated, partial(_drop_defaults, playpen))
    try:
        if parse(changed, "the edited file") == playpen:
            return changed
    except PlaypenError:
        pass
    raise PlaypenError(f"{playpen.name}: this file cannot be changed in place; expected a new one, by `dump`")


def schema() -> Table:
    """Return the format as JSON schema, for editors that complete and check playpen files."""
    json_schema = toml_files.schema(Playpen)
    robot = json_schema["$defs"]["RobotEntry"]
    pose_keys = ["x_mm", "y_mm", "heading_deg"]
    robot["required"] = [key for key in robot["required"] if key not in pose_keys]
    robot["anyOf"] = [{"required": pose_keys}, {"required": ["spots"]}]
    return json_schema


def _drop_outdated(current: Table, new_data: Table) -> Table:
    """Return a file's data without the robots' keys that follow from changed keys."""
    robots = list(current.get("robot", []))
    for index, (old, new) in enumerate(zip(robots, new_data.get("robot", []), strict=False)):
        outdated: list[str] = []
        if (old["spots"], current.get("spot")) != (new["spots"], new_data.get("spot")):
            outdated += ["x_mm", "y_mm", "heading_deg"]
        if old["model"] != new["model"]:
            outdated += ["calibration", "rom"]
        robots[index] = {key: value for key, value in old.items() if key not in outdated}
    return {**current, "robot": robots} if robots else current


def _drop_defaults(playpen: Playpen, data: Table) -> Table:
    """Return the data of a playpen without the robots' keys that follow from others."""
    spots = {spot.name: spot.model_dump() for spot in playpen.spots}
    robots: list[Table] = []
    for robot, entry in zip(playpen.robots, data.get("robot", ()), strict=False):
        defaults = default_keys(robot.model, [spots[name] for name in robot.spots])
        overrides = {key: value for key in defaults if (value := getattr(robot, key)) != defaults[key]}
        robots.append({key: value for key, value in entry.items() if key not in defaults} | overrides)
    return {**data, "robot": robots} if robots else data


def place_robots(playpen: Playpen, rng: np.random.Generator) -> Playpen:
    """Return a playpen whose robots stand at random spots.

    Raises:
        PlaypenError: There are not enough spots.
    """
    if not any(robot.spots for robot in playpen.robots):
        return playpen
    robots = assign_spots(playpen, lambda spots: [spots[int(i)] for i in rng.permutation(len(spots))])
    if robots is None:
        raise PlaypenError(f"{playpen.name}: the robots do not fit on their spots; expected one spot more")
    return playpen.model_copy(
        update={"robots": tuple(robot.model_copy(update={"spots": ()}) for robot in robots)}
    )


def names() -> list[str]:
    """Return the names of the playpens that ship with the package."""
    return toml_files.names("playpens")
