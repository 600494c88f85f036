"""Challenges as TOML files: a playpen, a time limit, a metric and its interpretation as a score.

    version = 1
    name = "cover"
    title = "Cover the floor"
    description = "Drive over as much of the floor as you can, without touching anything."
    playpen = "obstacles"
    seconds = 60
    metric = "coverage"
    better = "higher"

The models define the format: their attributes are the file's keys, except the tuples of `[[goal]]` and
`[[penalty]]`. Beside NAME.toml are NAME.py, a reference solution, and NAME.png, a picture. A playpen that
does not ship with the package is a path relative to the file.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from khep_twin import playpen as playpens
from khep_twin.errors import ChallengeError, PlaypenError, Problem, choices
from khep_twin.files import toml_files
from khep_twin.files.toml_files import Name, Problems, TomlTable
from khep_twin.files.toml_lines import LineNumbers
from khep_twin.lab.challenge.task_metrics import UNITS
from khep_twin.lab.experiment.start_poses import StartPose, starts
from khep_twin.playpen import Playpen
from khep_twin.playpen.starts import extent
from khep_twin.randomness import SEED_LIMIT
from khep_twin.renamed import renamed_attribute

KIND = "challenges"
"""Folder of the shipped challenges in the assets."""

RUNS_LIMIT = 1000
"""Most runs of a score."""

Text = Annotated[str, Field(min_length=1, max_length=2000)]
Metric = Annotated[str, Field(description=f"one of {', '.join(UNITS)}")]


class Goal(TomlTable):
    """A `[[goal]]`: a circle that the robot's centre must reach after the previous goals.

    Attributes:
        lamp: Lamp of the playpen; the goal counts only in runs that start with it on. None for all runs.
    """

    x_mm: float
    y_mm: float
    radius_mm: Annotated[float, Field(gt=0)]
    lamp: Annotated[str | None, Field(description="the name of a lamp")] = None


class Penalty(TomlTable):
    """A `[[penalty]]`: another metric, and the cost of each unit of it (`each`) in units of the score."""

    metric: Metric
    each: Annotated[float, Field(gt=0)]


class Challenge(TomlTable):
    """Content of a challenge's file."""

    version: Annotated[int, Field(ge=1, le=1, description="1")]
    name: Name
    title: Annotated[str, Field(min_length=1, max_length=60)]
    description: Text
    playpen: Annotated[str, Field(min_length=1)]
    starts: Annotated[tuple[str, ...], Field(min_length=1)] = ("playpen",)
    seconds: Annotated[float, Field(gt=0, le=3600)]
    runs: Annotated[int, Field(ge=1, le=RUNS_LIMIT)] = 1
    seed: Annotated[int, Field(ge=0, lt=SEED_LIMIT - RUNS_LIMIT)] = 1
    metric: Metric
    better: Literal["higher", "lower"]
    reference: Annotated[float | None, Field(description="the score of the reference solution")] = None
    threshold: Annotated[float | None, Field(description="the score that passes")] = None
    object: Annotated[str | None, Field(description="the name of a movable object")] = None
    goals: Annotated[tuple[Goal, ...], Field(alias="goal")] = ()
    penalties: Annotated[tuple[Penalty, ...], Field(alias="penalty")] = ()

    @model_validator(mode="after")
    def _check_consistency(self) -> Self:
        if problems := list(self._find_problems()):
            raise Problems(problems)
        return self

    def _find_problems(self) -> Iterator[Problem]:
        metrics = [(("metric",), self.metric)]
        metrics += [(("penalty", i, "metric"), penalty.metric) for i, penalty in enumerate(self.penalties)]
        for location, metric in metrics:
            prefix = f"penalty {int(location[1]) + 1}: " if len(location) > 1 else ""
            if metric not in UNITS:
                yield Problem.of(location, f'{prefix}metric = "{metric}": unknown', tuple(UNITS), metric)
            if metric in ("goals", "goal_s", "goal_share", "object_mm") and not self.goals:
                yield Problem.of(location, f'{prefix}metric = "{metric}": there is no goal', "a [[goal]]")
            if metric == "object_mm" and self.object is None:
                yield Problem.of(
                    location, f'{prefix}metric = "object_mm": there is no object', "object = NAME"
                )

    @property
    def unit(self) -> str:
        """Unit of the score."""
        return UNITS[self.metric]

    @property
    def reading(self) -> str:
        """Metric of the score, its unit, and whether higher or lower scores are better."""
        return f"{self.metric}{f' [{self.unit}]' if self.unit else ''}, {self.better} is better"

    @property
    def length(self) -> str:
        """Number of runs and their simulated time."""
        return f"{self.runs} run{'s' if self.runs > 1 else ''} of {self.seconds:g} s"

    wanted = renamed_attribute("wanted", "passing_scores")

    @property
    def passing_scores(self) -> str:
        """Passing scores, in words; empty without a threshold."""
        if self.threshold is None:
            return ""
        return f"at {'least' if self.better == 'higher' else 'most'} {self.value(self.threshold)}"

    def passes(self, score: float) -> bool | None:
        """Return whether a score passes; None without a threshold."""
        if self.threshold is None:
            return None
        return score >= self.threshold if self.better == "higher" else score <= self.threshold

    def value(self, score: float) -> str:
        """Return a score with its unit."""
        return f"{score:.4g} {self.unit}".rstrip()


@dataclass(frozen=True, slots=True)
class ChallengeFile:
    """A challenge read from a file.

    Attributes:
        challenge: Content of the challenge.
        playpen: Its playpen.
        name: Name by which it was loaded: that of a shipped challenge, or a path.
        path: Path of the file.
    """

    challenge: Challenge
    playpen: Playpen
    name: str
    path: Path

    @property
    def solution(self) -> Path:
        """Reference solution."""
        return self.path.with_suffix(".py")

    @property
    def picture(self) -> Path:
        """Picture of the playpen."""
        return self.path.with_suffix(".png")

    def start_poses(self, runs: int, seed: int) -> list[StartPose]:
        """Return the start poses, which the runs use in turn."""
        return starts(self.challenge.starts, self.playpen, 0, runs, seed)


def names() -> list[str]:
    """Return the names of the challenges that ship with the package."""
    return toml_files.names(KIND)


def load(name: str) -> ChallengeFile:
    """Load a challenge by the name of a shipped one, or by path.

    Raises:
        ChallengeError: It does not exist or cannot be used; the message has one line per problem.
        PlaypenError: Its playpen cannot be used.
    """
    text, source = toml_files.read(KIND, name, ChallengeError)
    challenge = toml_files.validate(Challenge, text, source, ChallengeError)
    path = toml_files.folder(KIND) / f"{name}.toml" if name in names() else Path(name)
    is_shipped = challenge.playpen in playpens.names()

    def make_error(
        location: tuple[str | int, ...], message: str, expected: str | tuple[object, ...], value: object
    ) -> ChallengeError:
        line = LineNumbers(text).find(location)
        plain = Problem.of(location, message, expected, value, source)
        return ChallengeError(problems=[Problem(plain.location, plain.text, value, expected, source, line)])

    playpen_path = challenge.playpen if is_shipped else path.parent / challenge.playpen
    if not is_shipped and not Path(playpen_path).exists():
        message = f'playpen = "{challenge.playpen}": no such file'
        expected = f"the path of a file or a shipped name; {choices(challenge.playpen, playpens.names())}"
        raise make_error(("playpen",), message, expected, challenge.playpen)
    playpen = Playpen.load(playpen_path)
    if not playpen.robots:
        raise make_error(("playpen",), f"{challenge.playpen} has no robot", "one", challenge.playpen)
    movable = tuple(item.name for item in movable_objects(playpen) if item.name)
    if challenge.object is not None and challenge.object not in movable:
        raise make_error(("object",), f'object = "{challenge.object}": unknown', movable, challenge.object)
    for index, goal in enumerate(challenge.goals):
        for key, message, expected, value in _goal_problems(goal, playpen):
            raise make_error(("goal", index, key), f"goal {index + 1}: {message}", expected, value)
    file = ChallengeFile(challenge, playpen, name, path)
    try:
        file.start_poses(1, challenge.seed)
    except PlaypenError as error:
        raise make_error(("starts",), error.plain, "", challenge.starts) from error
    return file


def _goal_problems(goal: Goal, playpen: Playpen) -> Iterator[tuple[str, str, str | tuple[str, ...], object]]:
    """Yield the conflicts of a goal with its playpen: key, text, expected values, and value."""
    for key, value, (low, high) in zip(
        ("x_mm", "y_mm"), (goal.x_mm, goal.y_mm), extent(playpen), strict=True
    ):
        if not low <= value <= high:
            yield key, f"{key} = {value:g}", f"a place in the arena, {low:g} to {high:g}", value
    lamps = tuple(lamp.name for lamp in playpen.lamps if lamp.name)
    if goal.lamp is not None and goal.lamp not in lamps:
        yield "lamp", f'lamp = "{goal.lamp}": unknown', lamps, goal.lamp


def movable_objects(playpen: Playpen) -> list[playpens.Block | playpens.Cylinder]:
    """Return the movable objects, in the order of `World.objects`."""
    return [item for items in playpen.objects.values() for item in items if item.movable]
