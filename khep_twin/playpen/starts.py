"""Start poses of robots: defined in the playpen, or random, at spots or anywhere.

Only this module draws random starts: spots from the stream "spots", free poses from the stream "starts".
"""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from khep_twin.errors import PlaypenError
from khep_twin.playpen.checks import placed_parts
from khep_twin.playpen.footprint import Circle
from khep_twin.playpen.model import Playpen, place_robots
from khep_twin.playpen.overlap import PlacedPart, placement_problems
from khep_twin.randomness import stream

TRIES = 1000
"""Number of random poses that are tried for a robot."""

Start = tuple[float, float, float]
"""x [mm], y [mm], heading [deg]."""


def at_spots(playpen: Playpen, seed: int) -> Playpen:
    """Return the playpen with each robot that has spots at one drawn by the seed; others keep their poses.

    Raises:
        PlaypenError: There are not enough spots.
    """
    if not any(robot.spots for robot in playpen.robots):
        return playpen
    return place_robots(playpen, stream(seed, "spots"))


def defined_starts(playpen: Playpen, robot: int) -> list[Start]:
    """Return a robot's start poses in the playpen: its pose, or its spots."""
    entry = playpen.robots[robot]
    spots = {spot.name: spot for spot in playpen.spots}
    positions = [spots[name] for name in entry.spots] or [entry]
    return [(position.x_mm, position.y_mm, position.heading_deg) for position in positions]


def anywhere(playpen: Playpen, seed: int) -> Playpen:
    """Return the playpen with its robots at free poses drawn by the seed.

    Raises:
        PlaypenError: No free pose was found.
    """
    rng = starts_rng(seed)
    placed = playpen.model_copy(update={"robots": ()})
    for index, robot in enumerate(playpen.robots):
        placed = placed.model_copy(update={"robots": (*placed.robots, robot)})
        start = draw_free_pose(placed, index, rng)
        if start is None:
            raise PlaypenError(
                f"{playpen.name}: no room for robot {index + 1} was found in {TRIES} tries; "
                "expected fewer robots"
            )
        placed = at_start(placed, index, start)
    return placed


def starts_rng(seed: int) -> np.random.Generator:
    """Return the generator of free poses."""
    return stream(seed, "starts")


def draw_free_pose(playpen: Playpen, robot: int, rng: np.random.Generator) -> Start | None:
    """Return a random collision-free pose, rounded to 0.1 mm and degrees; None if none was found."""
    (left, right), (low, high) = extent(playpen)
    for _ in range(TRIES):
        x_mm, y_mm, heading_deg = rng.uniform((left, low, 0), (right, high, 360)).round(1).tolist()
        if not find_obstruction(playpen, robot, x_mm, y_mm):
            return x_mm, y_mm, heading_deg
    return None


def at_start(playpen: Playpen, robot: int, start: Start) -> Playpen:
    """Return the playpen with a robot at a start pose."""
    x_mm, y_mm, heading_deg = start
    pose = {"x_mm": x_mm, "y_mm": y_mm, "heading_deg": heading_deg, "spots": ()}
    robots = list(playpen.robots)
    robots[robot] = robots[robot].model_copy(update=pose)
    return playpen.model_copy(update={"robots": tuple(robots)})


def extent(playpen: Playpen) -> tuple[tuple[float, float], tuple[float, float]]:
    """Return the limits of the arena along x and y [mm]."""
    xs, ys = zip(*playpen.arena.corners, strict=True)
    return (min(xs), max(xs)), (min(ys), max(ys))


def find_obstruction(playpen: Playpen, index: int, x_mm: float, y_mm: float) -> str:
    """Return the reason why a robot cannot stand at a position [mm]; empty if it can."""
    entry = playpen.robots[index].model_copy(update={"x_mm": x_mm, "y_mm": y_mm, "spots": ()})
    robot = PlacedPart("robot", index + 1, entry.name, entry.footprint, 0, entry.body.height * 1e3, True)
    parts = [*find_neighbours(playpen, index, entry.footprint), robot]
    for problem in placement_problems(parts, playpen.arena):
        if problem.location[:2] == robot.location:
            return problem.text
    return ""


def find_neighbours(playpen: Playpen, index: int, disc: Circle) -> Iterator[PlacedPart]:
    """Yield the objects near a disc, except one robot, spots, and lamps, which robots pass through."""
    for part in placed_parts(playpen):
        if part.kind in ("lamp", "spot") or (part.kind, part.number) == ("robot", index + 1):
            continue
        shape = part.footprint
        x_gap_mm = abs(shape.x_mm - disc.x_mm) - shape.reach((1.0, 0.0))
        y_gap_mm = abs(shape.y_mm - disc.y_mm) - shape.reach((0.0, 1.0))
        if max(x_gap_mm, y_gap_mm) <= disc.radius_mm:
            yield replace(part, is_free=False)
