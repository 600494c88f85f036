"""Domain randomization: properties that vary from episode to episode, drawn by the episode's seed.

    randomize = Randomization(starts=(50, 180), lamps=(2, 100), robots=True, noise=0.5, blocks_mm=80)
    environment = khep_twin.make("khep_twin/LightSeeking-v0", randomize=randomize)

Each property has a separate random stream, so that another one does not change the rest. Playpens with moved
obstacles must be compiled by MuJoCo, in some 10 ms each: a pool of them is drawn once, by `seed`, and each
episode uses one of them.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any, Literal, Self, TypeVar, cast

import numpy as np

from khep_twin.clock import NS_PER_S
from khep_twin.envs.arguments import check_mapping, check_switch, is_number
from khep_twin.envs.reset_options import validate_seed
from khep_twin.episodes.episode_options import check_count
from khep_twin.episodes.line import MeasuredCycle
from khep_twin.errors import KhepTwinError, choices, value_text
from khep_twin.playpen import BULB_RADIUS_MM, Block, Cylinder, Lamp, Playpen
from khep_twin.playpen.checks import placed_parts
from khep_twin.playpen.overlap import PlacedPart, placement_problems
from khep_twin.playpen.starts import Start, anywhere, at_spots, at_start, extent, find_obstruction
from khep_twin.randomness import stream

TRIES = 100
"""Number of positions tried for an object before it stays in place."""

POWER_LIMIT_W = 1000.0
"""Largest power of a lamp in a playpen file [W]."""

Item = TypeVar("Item", Block, Cylinder, Lamp)
NumberPair = tuple[float, float]


@dataclass(frozen=True, slots=True, kw_only=True)
class Randomization:
    """Domain randomization of episodes.

    Attributes:
        starts: "anywhere" for any free position, or the largest offsets from the start along x and y [mm] and
            in heading [deg]; None for the task's starts.
        lamps: Largest factor on a lamp's power, up or down, and largest offset along x and y [mm].
        robots: Whether each episode has another robot of the same model, like `vary`.
        noise: Probability that sensors are noisy; None for the environment's `noise`.
        delay: Smallest and largest time from a reading to the effect of the resulting speeds [s], up to a
            control period; None for the environment's `line`.
        blocks_mm: Largest offset along x and y of blocks and cylinders that overlap nothing [mm].
        playpens: Number of playpens with moved blocks; each episode uses one.
        seed: Seed of these playpens.

    Raises:
        KhepTwinError: A value is out of range.
    """

    starts: Literal["anywhere"] | NumberPair | None = None
    lamps: NumberPair | None = None
    robots: bool = False
    noise: float | None = None
    delay: NumberPair | None = None
    blocks_mm: float = 0.0
    playpens: int = 8
    seed: int = 0

    def __post_init__(self) -> None:
        """Check the values."""
        if not (self.starts is None or (isinstance(self.starts, str) and self.starts == "anywhere")):
            _check_pair("starts", self.starts, 'two numbers from 0, [mm] and [deg], or "anywhere"', (0, 0))
        if self.lamps is not None:
            _check_pair("lamps", self.lamps, "a factor from 1 and a distance from 0 [mm]", (1, 0))
        if self.noise is not None and not is_number(self.noise, 0, 1):
            raise _make_error("noise", self.noise, "a probability, 0 to 1")
        if self.delay is not None:
            _check_pair("delay", self.delay, "two times [s], the second not below the first", (0, 0))
            if self.delay[1] < self.delay[0]:
                raise _make_error("delay", self.delay, "two times [s], the second not below the first")
        if not is_number(self.blocks_mm):
            raise _make_error("blocks_mm", self.blocks_mm, "a distance from 0 [mm]")
        check_switch("randomize: robots", self.robots)
        check_count(self.playpens, "playpens")
        validate_seed(self.seed, "randomize")

    @classmethod
    def of(cls, value: Self | Mapping[str, Any] | None) -> Self | None:
        """Return a randomization, which may also be a mapping of its attributes.

        Raises:
            KhepTwinError: It is neither, or a name or value is unknown.
        """
        if value is None or isinstance(value, cls):
            return value
        if not isinstance(value, Mapping):
            expected = "a Randomization, or its attributes"
            raise KhepTwinError(key="randomize", value=value, expected=expected)
        value = check_mapping("randomize", value)
        known_names = [field.name for field in fields(cls)]
        for name in value:
            if name not in known_names:
                raise KhepTwinError(f"randomize: {value_text(name)}: unknown; {choices(name, known_names)}")
        return cls(**value)

    def pool(self, playpen: Playpen) -> tuple[Playpen, ...]:
        """Return the playpens with moved blocks and cylinders."""
        return tuple(self._with_moved_blocks(playpen, number) for number in range(self.playpens))

    def playpen_index(self, seed: int) -> int:
        """Return the number of an episode's playpen in the pool."""
        return int(stream(seed, "randomization", "playpen").integers(self.playpens))

    def draw_starts(self, playpen: Playpen, seed: int, start: Sequence[Start] | None) -> Sequence[Start]:
        """Return the robots' starts, drawn around `start` or the playpen's.

        Raises:
            KhepTwinError: There is no room for a robot.
        """
        if self.starts == "anywhere":
            return starts_of(anywhere(playpen, seed))
        playpen = at_spots(playpen, seed) if start is None else place_robots(playpen, start)
        if self.starts is None:
            return starts_of(playpen)
        rng, (max_mm, max_deg) = stream(seed, "randomization", "starts"), self.starts
        for index, (x_mm, y_mm, heading_deg) in enumerate(starts_of(playpen)):
            for _ in range(TRIES):
                dx, dy, turn_deg = (rng.uniform(-1, 1, 3) * (max_mm, max_mm, max_deg)).round(1).tolist()
                if not find_obstruction(playpen, index, x_mm + dx, y_mm + dy):
                    playpen = at_start(playpen, index, (x_mm + dx, y_mm + dy, heading_deg + turn_deg))
                    break
        return starts_of(place_robots(playpen, starts_of(playpen)))

    def draw_lamps(self, playpen: Playpen, seed: int) -> Sequence[Lamp]:
        """Return the lamps of a playpen with randomized powers and positions."""
        if self.lamps is None:
            return playpen.lamps
        rng, (factor, max_mm) = stream(seed, "randomization", "lamps"), self.lamps
        factors: list[float] = (factor ** rng.uniform(-1, 1, len(playpen.lamps))).tolist()
        lamps = list(playpen.lamps)
        for index, lamp in enumerate(lamps):
            power_w = min(lamp.power_w * factors[index], POWER_LIMIT_W)
            surroundings = playpen.model_copy(update={"lamps": (*lamps[:index], *lamps[index + 1 :])})
            lamps[index] = _move_item(
                surroundings, "lamp", lamp.model_copy(update={"power_w": power_w}), max_mm, rng
            )
        return lamps

    def is_noisy(self, seed: int, default: bool) -> bool:
        """Return whether the sensors of an episode are noisy."""
        if self.noise is None:
            return default
        return bool(stream(seed, "randomization", "noise").uniform() < self.noise)

    def line(self, seed: int, period_ns: int) -> MeasuredCycle | None:
        """Return an episode's cycle with a drawn delay, one control period [ns] long; None without one."""
        if self.delay is None:
            return None
        delay = float(stream(seed, "randomization", "delay").uniform(*self.delay))
        return MeasuredCycle(delay, period_ns / NS_PER_S)

    def _with_moved_blocks(self, playpen: Playpen, number: int) -> Playpen:
        rng = stream(self.seed, "randomization", "blocks", number)
        for name, kind in (("blocks", "block"), ("cylinders", "cylinder")):
            items: list[Any] = list(getattr(playpen, name))
            for index, item in enumerate(items):
                surroundings = playpen.model_copy(update={name: (*items[:index], *items[index + 1 :])})
                items[index] = _move_item(surroundings, kind, item, self.blocks_mm, rng)
            playpen = playpen.model_copy(update={name: tuple(items)})
        return playpen


def starts_of(playpen: Playpen) -> list[Start]:
    """Return the poses of a playpen's robots."""
    return [(robot.x_mm, robot.y_mm, robot.heading_deg) for robot in playpen.robots]


def place_robots(playpen: Playpen, starts: Iterable[Start]) -> Playpen:
    """Return a playpen with its robots at these starts.

    Raises:
        KhepTwinError: There is no room for a robot.
    """
    starts = list(starts)
    for index, start in enumerate(starts):
        playpen = at_start(playpen, index, start)
    for index, start in enumerate(starts):
        if problem := find_obstruction(playpen, index, *start[:2]):
            raise KhepTwinError(f"start = {start}: {playpen.name}: {problem}")
    return playpen


def _move_item(surroundings: Playpen, kind: str, item: Item, max_mm: float, rng: np.random.Generator) -> Item:
    """Return an object moved by up to `max_mm` without an overlap; unchanged if no such position is found.

    An object that already overlaps others, e.g. a part of a maze, is not moved.
    """
    other_parts = [replace(part, is_free=False) for part in placed_parts(surroundings)]
    if isinstance(item, Lamp):
        bottom_mm, top_mm = item.z_mm - BULB_RADIUS_MM, item.z_mm + BULB_RADIUS_MM
    else:
        bottom_mm, top_mm = 0.0, item.height_mm

    def is_clear(candidate: Item) -> bool:
        part = PlacedPart(kind, 0, item.name, candidate.footprint, bottom_mm, top_mm, True)
        problems = placement_problems([*other_parts, part], surroundings.arena)
        return all(problem.location[:2] != part.location for problem in problems)

    if max_mm and is_clear(item):
        (left, right), (low, high) = extent(surroundings)
        for _ in range(TRIES):
            dx, dy = (rng.uniform(-max_mm, max_mm, 2)).round(1).tolist()
            moved = item.model_copy(update={"x_mm": item.x_mm + dx, "y_mm": item.y_mm + dy})
            if left <= moved.x_mm <= right and low <= moved.y_mm <= high and is_clear(moved):
                return moved
    return item


def _check_pair(name: str, values: object, expected: str, minimum: NumberPair) -> None:
    """Raise an error unless these are two finite numbers, not below the minimum."""
    pair = list(cast(Any, values)) if isinstance(values, list | tuple) else []
    is_valid = len(pair) == 2 and all(map(is_number, pair, minimum))
    if not is_valid:
        raise _make_error(name, cast(object, values), expected)


def _make_error(name: str, value: object, expected: str) -> KhepTwinError:
    return KhepTwinError(f"randomize: {name} = {value_text(value)}; expected {expected}")
