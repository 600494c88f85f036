"""Start poses of robots: where there is room, and random ones, at spots or anywhere.

Random starts are drawn here alone: spots from the stream "spots", free poses from the stream "starts".
"""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from khep_twin.errors import PlaypenError
from khep_twin.playpen.checks import things
from khep_twin.playpen.footprint import Circle
from khep_twin.playpen.model import Playpen, place_robots
from khep_twin.playpen.overlap import Thing, placement_problems
from khep_twin.randomness import stream

TRIES = 1000
"""Number of poses tried for a robot before it is reported to have no room."""

Start = tuple[float, float, float]
"""x [mm], y [mm], heading [deg]."""


def at_spots(playpen: Playpen, seed: int) -> Playpen:
    """Return the playpen with its robots at their own poses, or at spots that the seed draws.

    Raises:
        PlaypenError: The spots do not suffice.
    """
    if not any(robot.spots for robot in playpen.robots):
        return playpen
    return place_robots(playpen, stream(seed, "spots"))


def own_starts(playpen: Playpen, robot: int) -> list[Start]:
    """Return the playpen's poses of a robot: its own, or each of its spots."""
    entry = playpen.robots[robot]
    spots = {spot.name: spot for spot in playpen.spots}
    positions = [spots[name] for name in entry.spots] or [entry]
    return [(position.x_mm, position.y_mm, position.heading_deg) for position in positions]


def anywhere(playpen: Playpen, seed: int) -> Playpen:
    """Return the playpen with its robots at free poses drawn by the seed.

    Raises:
        PlaypenError: No room was found.
    """
    rng = starts_rng(seed)
    standing = playpen.model_copy(update={"robots": ()})
    for index, robot in enumerate(playpen.robots):
        standing = standing.model_copy(update={"robots": (*standing.robots, robot)})
        start = free_pose(standing, index, rng)
        if start is None:
            raise PlaypenError(
                f"{playpen.name}: no room for robot {index + 1} was found in {TRIES} tries; "
                "expected fewer robots"
            )
        standing = at_start(standing, index, start)
    return standing


def starts_rng(seed: int) -> np.random.Generator:
    """Return the generator of free poses."""
    return stream(seed, "starts")


def free_pose(playpen: Playpen, robot: int, rng: np.random.Generator) -> Start | None:
    """Return a random pose at which a robot has room, to 0.1 mm and degrees; None if none was found."""
    (left, right), (low, high) = extent(playpen)
    for _ in range(TRIES):
        x_mm, y_mm, heading_deg = rng.uniform((left, low, 0), (right, high, 360)).round(1).tolist()
        if not no_room(playpen, robot, x_mm, y_mm):
            return x_mm, y_mm, heading_deg
    return None


def at_start(playpen: Playpen, robot: int, start: Start) -> Playpen:
    """Return the playpen with a robot at a start pose."""
    x_mm, y_mm, heading_deg = start
    place = {"x_mm": x_mm, "y_mm": y_mm, "heading_deg": heading_deg, "spots": ()}
    robots = list(playpen.robots)
    robots[robot] = robots[robot].model_copy(update=place)
    return playpen.model_copy(update={"robots": tuple(robots)})


def extent(playpen: Playpen) -> tuple[tuple[float, float], tuple[float, float]]:
    """Return the limits of the arena along x and y [mm]."""
    xs, ys = zip(*playpen.arena.corners, strict=True)
    return (min(xs), max(xs)), (min(ys), max(ys))


def no_room(playpen: Playpen, index: int, x_mm: float, y_mm: float) -> str:
    """Return the reason why a playpen's robot cannot stand at a position [mm]; empty if it can."""
    entry = playpen.robots[index].model_copy(update={"x_mm": x_mm, "y_mm": y_mm, "spots": ()})
    thing = Thing("robot", index + 1, entry.name, entry.footprint, 0, entry.body.height * 1e3, True)
    for problem in placement_problems([*near(playpen, index, entry.footprint), thing], playpen.arena):
        if problem.location[:2] == thing.place:
            return problem.text
    return ""


def near(playpen: Playpen, index: int, disc: Circle) -> Iterator[Thing]:
    """Yield the objects in reach of a disc, except one robot, spots, and lamps, which robots pass."""
    for thing in things(playpen):
        at = thing.footprint
        away = max(
            abs(at.x_mm - disc.x_mm) - at.reach((1.0, 0.0)), abs(at.y_mm - disc.y_mm) - at.reach((0.0, 1.0))
        )
        own = (thing.kind, thing.number) == ("robot", index + 1)
        if away <= disc.radius_mm and not own and thing.kind not in ("lamp", "spot"):
            yield replace(thing, free=False)
