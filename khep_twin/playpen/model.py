"""Model of a whole playpen: reading, checking and writing of playpen files."""

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
from khep_twin.playpen.checks import assigned, completed, following, playpen_problems
from khep_twin.playpen.tables import PlaypenTables

MANY_ROBOTS = 100
"""Number of robots above which a scene takes long to make: 100 take 1 s, 200 take 3 s, 500 a minute."""


class Playpen(PlaypenTables):
    """A whole playpen."""

    @classmethod
    def load(cls, playpen: "PlaypenLike") -> "Playpen":
        """Load a playpen by the bare name of a shipped one, or by path; a playpen is returned as it is.

        Raises:
            PlaypenError: The file does not exist or cannot be used; one line per problem.
        """
        if isinstance(playpen, Playpen):
            return playpen
        try:
            path = Path(playpen)
        except TypeError:
            found = reprlib.repr(playpen)
            raise PlaypenError(f"{found}: expected one playpen, its name or its path") from None
        text, source = toml_files.read("playpens", path, PlaypenError)
        return parse(text, source)

    @model_serializer(mode="wrap")
    def _without_empty_arrays(self, serialize: SerializerFunctionWrapHandler) -> dict[str, object]:
        # Keep `lamp = []` out of a file: TOML allows no [[lamp]] after it.
        return {key: value for key, value in serialize(self).items() if value not in ([], (), {})}

    @model_validator(mode="before")
    @classmethod
    def _robots_have_what_follows(cls, data: object) -> object:
        # Until the seed selects a spot, a robot stands at the first of its spots.
        return completed(data) if isinstance(data, dict) else data  # pyright: ignore

    @model_validator(mode="after")
    def _is_a_place(self, info: ValidationInfo) -> Self:
        context: Mapping[str, object] = info.context or {}
        found = playpen_problems(self, bool(context.get("recorded")), bool(context.get("placed", True)))
        problems = list(islice(found, PROBLEM_LIMIT + 1))
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
        recorded: True if a run took place in it already, so that walls too low for robots are accepted.

    Raises:
        PlaypenError: It cannot be used; one line per problem.
    """
    return toml_files.validate(Playpen, text, source, PlaypenError, {"recorded": recorded})


def dump(playpen: Playpen) -> str:
    """Return a playpen as the text of a file, the same for equal playpens; the inverse of `parse`."""
    return toml_files.dump(playpen)


def edited(text: str, playpen: Playpen) -> str:
    """Return a playpen file's text, changed to describe `playpen`; comments and all else are kept.

    Args:
        text: Text of a file that `parse` accepts.
        playpen: Playpen to describe.

    Raises:
        PlaypenError: The text is no playpen, or has a form that cannot be changed in place.
    """
    before = parse(text, "the file to be edited")
    changed = toml_files.edited(text, before, playpen, _with_what_follows, partial(_bare, playpen))
    try:
        if parse(changed, "the edited file") == playpen:
            return changed
    except PlaypenError:
        pass
    raise PlaypenError(f"{playpen.name}: this file cannot be changed in place; expected a new one, by `dump`")


def schema() -> Table:
    """Return the format as JSON schema, for editors that complete and check playpen files."""
    found = toml_files.schema(Playpen)
    robot, place = found["$defs"]["RobotEntry"], ["x_mm", "y_mm", "heading_deg"]
    robot["required"] = [key for key in robot["required"] if key not in place]
    robot["anyOf"] = [{"required": place}, {"required": ["spots"]}]
    return found


def _with_what_follows(before: Table, after: Table) -> Table:
    """Return a file's data without the keys of robots that follow from other keys which change."""
    robots = list(before.get("robot", []))
    for index, (old, new) in enumerate(zip(robots, after.get("robot", []), strict=False)):
        follows: list[str] = []
        if (old["spots"], before.get("spot")) != (new["spots"], after.get("spot")):
            follows += ["x_mm", "y_mm", "heading_deg"]
        if old["model"] != new["model"]:
            follows += ["calibration", "rom"]
        robots[index] = {key: value for key, value in old.items() if key not in follows}
    return {**before, "robot": robots} if robots else before


def _bare(playpen: Playpen, data: Table) -> Table:
    """Return the data of a playpen, without defaults and without keys of robots that follow from others."""
    spots = {spot.name: spot.model_dump() for spot in playpen.spots}
    robots: list[Table] = []
    for robot, found in zip(playpen.robots, data.get("robot", ()), strict=False):
        follows = following(robot.model, [spots[name] for name in robot.spots])
        own = {key: value for key in follows if (value := getattr(robot, key)) != follows[key]}
        robots.append({key: value for key, value in found.items() if key not in follows} | own)
    return {**data, "robot": robots} if robots else data


def place_robots(playpen: Playpen, rng: np.random.Generator) -> Playpen:
    """Return a playpen whose robots stand at randomly drawn spots.

    Raises:
        PlaypenError: The spots do not suffice.
    """
    if not any(robot.spots for robot in playpen.robots):
        return playpen
    robots = assigned(playpen, lambda spots: [spots[int(i)] for i in rng.permutation(len(spots))])
    if robots is None:
        raise PlaypenError(f"{playpen.name}: the robots do not fit on their spots; expected one spot more")
    return playpen.model_copy(
        update={"robots": tuple(robot.model_copy(update={"spots": ()}) for robot in robots)}
    )


def names() -> list[str]:
    """Return the names of the playpens that ship with the package."""
    return toml_files.names("playpens")
