"""Domain randomization: what differs from episode to episode, drawn by the episode's seed.

    randomize = Randomization(starts=(50, 180), lamps=(2, 100), robots=True, noise=0.5, blocks_mm=80)
    environment = khep_twin.make("khep_twin/LightSeeking-v0", randomize=randomize)

Each kind has a random stream of its own, so that one more changes nothing about the others. Playpens with
other places of their obstacles are scenes to compile, some 10 ms each: they are drawn once, by `seed`, and
each episode takes one of them.
"""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any, Literal, Self, TypeVar

import numpy as np

from khep_twin.clock import NS_PER_S
from khep_twin.episodes.episode_options import checked_count
from khep_twin.episodes.line import MeasuredCycle
from khep_twin.errors import KhepTwinError, choices
from khep_twin.playpen import BULB_RADIUS_MM, Block, Cylinder, Lamp, Playpen
from khep_twin.playpen.checks import things
from khep_twin.playpen.overlap import Thing, placement_problems
from khep_twin.playpen.starts import Start, anywhere, at_spots, at_start, extent, no_room
from khep_twin.randomness import stream

TRIES = 100
"""Number of places tried for a thing before it stays where it is."""

POWER_LIMIT_W = 1000.0
"""Largest power of a lamp in a playpen file [W]."""

Moved = TypeVar("Moved", Block, Cylinder, Lamp)
Draw = tuple[float, float]


@dataclass(frozen=True, slots=True, kw_only=True)
class Randomization:
    """Domain randomization of episodes.

    Attributes:
        starts: "anywhere" there is room, or the largest distances from the start along x and y [mm] and in
            heading [deg]; None for the task's own starts.
        lamps: Largest factor of a lamp's power, up or down, and largest distance along x and y [mm].
        robots: Whether each episode has another robot of the same make, as by `vary`.
        noise: Probability that sensors are noisy; None for the environment's own `noise`.
        delay: Least and largest time from a reading to the effect of the speeds decided on it [s], up to a
            control period; None for the environment's own `line`.
        blocks_mm: Largest distance along x and y by which blocks and cylinders are moved that stand clear of
            all else [mm].
        playpens: Number of playpens with moved blocks, of which each episode takes one.
        seed: Seed of these playpens.

    Raises:
        KhepTwinError: A value is out of range.
    """

    starts: Literal["anywhere"] | Draw | None = None
    lamps: Draw | None = None
    robots: bool = False
    noise: float | None = None
    delay: Draw | None = None
    blocks_mm: float = 0.0
    playpens: int = 8
    seed: int = 0

    def __post_init__(self) -> None:
        """Check the values."""
        if self.starts not in (None, "anywhere"):
            _check("starts", self.starts, 'two numbers from 0, [mm] and [deg], or "anywhere"', (0, 0))
        if self.lamps is not None:
            _check("lamps", self.lamps, "a factor from 1 and a distance from 0 [mm]", (1, 0))
        if self.noise is not None and not 0 <= self.noise <= 1:
            raise _error("noise", self.noise, "a probability, 0 to 1")
        if self.delay is not None:
            _check("delay", self.delay, "two times [s], the second not below the first", (0, 0))
            if self.delay[1] < self.delay[0]:
                raise _error("delay", self.delay, "two times [s], the second not below the first")
        if not 0 <= self.blocks_mm < math.inf:
            raise _error("blocks_mm", self.blocks_mm, "a distance from 0 [mm]")
        checked_count(self.playpens, "playpens")

    @classmethod
    def of(cls, given: Self | Mapping[str, Any] | None) -> Self | None:
        """Return a randomization that may be given as a mapping of its attributes.

        Raises:
            KhepTwinError: It is neither, or a name or value is unknown.
        """
        if given is None or isinstance(given, cls):
            return given
        if not isinstance(given, Mapping):
            raise KhepTwinError(key="randomize", value=given, expected="a Randomization, or its attributes")
        known = [field.name for field in fields(cls)]
        for name in given:
            if name not in known:
                raise KhepTwinError(f"randomize: {name!r}: unknown; {choices(name, known)}")
        return cls(**given)

    def pool(self, playpen: Playpen) -> tuple[Playpen, ...]:
        """Return the playpens with moved blocks and cylinders."""
        return tuple(self._with_moved_blocks(playpen, number) for number in range(self.playpens))

    def chosen(self, seed: int) -> int:
        """Return the number of an episode's playpen in the pool."""
        return int(stream(seed, "randomization", "playpen").integers(self.playpens))

    def placed(self, playpen: Playpen, seed: int, start: Sequence[Start] | None) -> Sequence[Start]:
        """Return the robots' starts, drawn around those given or the playpen's."""
        if self.starts == "anywhere":
            return starts_of(anywhere(playpen, seed))
        standing = at_spots(playpen, seed) if start is None else placed_at(playpen, start)
        if self.starts is None:
            return starts_of(standing)
        rng, (far, turn) = stream(seed, "randomization", "starts"), self.starts
        for index, (x_mm, y_mm, heading_deg) in enumerate(starts_of(standing)):
            for _ in range(TRIES):
                dx, dy, turned = (rng.uniform(-1, 1, 3) * (far, far, turn)).round(1).tolist()
                if not no_room(standing, index, x_mm + dx, y_mm + dy):
                    standing = at_start(standing, index, (x_mm + dx, y_mm + dy, heading_deg + turned))
                    break
        return starts_of(standing)

    def relit(self, playpen: Playpen, seed: int) -> Sequence[Lamp]:
        """Return the lamps of a playpen with other powers and places."""
        if self.lamps is None:
            return playpen.lamps
        rng, (factor, far) = stream(seed, "randomization", "lamps"), self.lamps
        factors: list[float] = (factor ** rng.uniform(-1, 1, len(playpen.lamps))).tolist()
        lamps = list(playpen.lamps)
        for index, lamp in enumerate(lamps):
            power_w = min(lamp.power_w * factors[index], POWER_LIMIT_W)
            others = playpen.model_copy(update={"lamps": (*lamps[:index], *lamps[index + 1 :])})
            lamps[index] = _moved(others, "lamp", lamp.model_copy(update={"power_w": power_w}), far, rng)
        return lamps

    def is_noisy(self, seed: int, otherwise: bool) -> bool:
        """Return whether the sensors of an episode are noisy."""
        if self.noise is None:
            return otherwise
        return bool(stream(seed, "randomization", "noise").uniform() < self.noise)

    def line(self, seed: int, period_ns: int) -> MeasuredCycle | None:
        """Return the times of an episode's cycle, one control period [ns] long; None without a delay."""
        if self.delay is None:
            return None
        delay = float(stream(seed, "randomization", "delay").uniform(*self.delay))
        return MeasuredCycle(delay, period_ns / NS_PER_S)

    def _with_moved_blocks(self, playpen: Playpen, number: int) -> Playpen:
        rng = stream(self.seed, "randomization", "blocks", number)
        for name, kind in (("blocks", "block"), ("cylinders", "cylinder")):
            items: list[Any] = list(getattr(playpen, name))
            for index, item in enumerate(items):
                others = playpen.model_copy(update={name: (*items[:index], *items[index + 1 :])})
                items[index] = _moved(others, kind, item, self.blocks_mm, rng)
            playpen = playpen.model_copy(update={name: tuple(items)})
        return playpen


def starts_of(playpen: Playpen) -> list[Start]:
    """Return where a playpen's robots stand."""
    return [(robot.x_mm, robot.y_mm, robot.heading_deg) for robot in playpen.robots]


def placed_at(playpen: Playpen, starts: Iterable[Start]) -> Playpen:
    """Return a playpen with its robots at these starts.

    Raises:
        KhepTwinError: There is no room for a robot.
    """
    starts = list(starts)
    for index, start in enumerate(starts):
        playpen = at_start(playpen, index, start)
    for index, start in enumerate(starts):
        if problem := no_room(playpen, index, *start[:2]):
            raise KhepTwinError(f"start = {start}: {playpen.name}: {problem}")
    return playpen


def _moved(others: Playpen, kind: str, item: Moved, far_mm: float, rng: np.random.Generator) -> Moved:
    """Return a thing at a random place near its own where it overlaps no other; its own if none is found.

    What overlaps others at its own place, such as the parts of a maze, stays there.
    """
    fixed = [replace(thing, free=False) for thing in things(others)]
    bottom_mm, top_mm = 0.0, 0.0
    if isinstance(item, Lamp):
        bottom_mm, top_mm = item.z_mm - BULB_RADIUS_MM, item.z_mm + BULB_RADIUS_MM
    else:
        top_mm = item.height_mm

    def is_clear(there: Moved) -> bool:
        thing = Thing(kind, 0, item.name, there.footprint, bottom_mm, top_mm, True)
        problems = placement_problems([*fixed, thing], others.arena)
        return all(problem.location[:2] != thing.place for problem in problems)

    if far_mm and is_clear(item):
        (left, right), (low, high) = extent(others)
        for _ in range(TRIES):
            dx, dy = (rng.uniform(-far_mm, far_mm, 2)).round(1).tolist()
            there = item.model_copy(update={"x_mm": item.x_mm + dx, "y_mm": item.y_mm + dy})
            if left <= there.x_mm <= right and low <= there.y_mm <= high and is_clear(there):
                return there
    return item


def _check(name: str, given: Any, expected: str, lowest: Draw) -> None:
    """Raise an error unless these are two numbers from the lowest ones on."""
    try:
        fits = all(low <= number < math.inf for number, low in zip(given, lowest, strict=True))
    except (TypeError, ValueError):
        fits = False
    if not fits:
        raise _error(name, given, expected)


def _error(name: str, given: object, expected: str) -> KhepTwinError:
    return KhepTwinError(f"randomize: {name} = {given!r}; expected {expected}")
