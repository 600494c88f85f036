"""Start poses and lighting of a series of runs, by words of the command line."""

import math
import re
from collections.abc import Iterator, Sequence
from itertools import cycle, islice
from typing import NamedTuple, cast, get_args

from khep_twin.errors import PlaypenError
from khep_twin.playpen import Lamp, Playpen
from khep_twin.playpen.parts import LightingMode
from khep_twin.playpen.starts import (
    TRIES,
    defined_starts,
    draw_free_pose,
    extent,
    find_obstruction,
    starts_rng,
)
from khep_twin.renamed import renamed_arguments

LIGHTINGS = (*get_args(LightingMode), "off")
"""Lighting modes, and "off"."""

_MAX_GRID_CELLS = 1000


class StartPose(NamedTuple):
    """Pose of a robot at the start of a run.

    Attributes:
        x_mm: Position of the robot's centre along x [mm].
        y_mm: Position of the robot's centre along y [mm].
        heading_deg: Heading, counter-clockwise from x [degrees].
    """

    x_mm: float
    y_mm: float
    heading_deg: float

    def __str__(self) -> str:
        """Return the pose in the form of the command line."""
        return f"{self.x_mm:g},{self.y_mm:g},{self.heading_deg:g}"


@renamed_arguments(wishes="words")
def starts(words: Sequence[str], playpen: Playpen, robot: int, runs: int, seed: int) -> list[StartPose]:
    """Return the start poses that words of the command line describe; runs use them in turn.

    Args:
        words: X,Y,HEADING [mm, degrees]; grid:COLUMNSxROWS with an optional @HEADING; `random` for a new
            random pose in each turn; or `playpen` for the robot's spots in the playpen, or else its pose
            there.
        playpen: Playpen with room for them.
        robot: Index of the robot.
        runs: Number of runs.
        seed: Seed of the random poses.

    Raises:
        PlaypenError: A word is invalid, a pose has no room, or there is no such robot.
    """
    if not 0 <= robot < len(playpen.robots):
        text = f"robot = {robot}: not in playpen {playpen.name!r}"
        raise PlaypenError(text, key="robot", value=robot, expected=range(len(playpen.robots)))
    poses: list[StartPose | None] = []
    for word in words:
        if word == "playpen":
            poses += [StartPose(*start) for start in defined_starts(playpen, robot)]
        elif word == "random":
            poses.append(None)
        elif word.startswith("grid:"):
            poses += _parse_grid(word, playpen, robot)
        else:
            poses.append(_parse_pose(word, playpen, robot))
    given_poses = [pose for pose in poses if pose is not None]
    if len(given_poses) == len(poses):
        return given_poses
    random_poses = _random_poses(playpen, robot, seed)
    return [next(random_poses) if pose is None else pose for pose in islice(cycle(poses), runs)]


def with_lighting(playpen: Playpen, lighting: str | None) -> Playpen:
    """Return the playpen with a lighting mode, or without lamps for "off"; unchanged for None.

    Raises:
        PlaypenError: The lighting is unknown.
    """
    if lighting is None:
        return playpen
    if lighting not in LIGHTINGS:
        problem = f"lighting {lighting!r}: unknown"
        raise PlaypenError(problem, key="lighting", value=lighting, expected=LIGHTINGS)
    if lighting == "off":
        return playpen.model_copy(update={"lamps": ()})
    mode = cast(LightingMode, lighting)
    return playpen.model_copy(update={"lighting": playpen.lighting.model_copy(update={"mode": mode})})


def without_nearest_lamp(playpen: Playpen, x_mm: float, y_mm: float) -> Playpen:
    """Return the playpen without the lamp nearest to a point, the first of equally near ones."""
    nearest = nearest_lamp(playpen, x_mm, y_mm)
    return playpen.model_copy(update={"lamps": tuple(lamp for lamp in playpen.lamps if lamp is not nearest)})


def nearest_lamp(playpen: Playpen, x_mm: float, y_mm: float) -> Lamp:
    """Return the lamp nearest to a point, the first of equally near ones.

    Raises:
        PlaypenError: The playpen has no lamp.
    """
    if not playpen.lamps:
        raise PlaypenError(f"{playpen.name}: no lamp is left; expected one to take away or move")
    return min(playpen.lamps, key=lambda lamp: math.hypot(lamp.x_mm - x_mm, lamp.y_mm - y_mm))


def parse_numbers(text: str, count: int) -> list[float] | None:
    """Return `count` finite numbers separated by commas, None for anything else."""
    try:
        values = [float(part) for part in text.split(",")]
    except ValueError:
        return None
    return values if len(values) == count and all(map(math.isfinite, values)) else None


def _parse_pose(word: str, playpen: Playpen, robot: int) -> StartPose:
    values = parse_numbers(word, 3)
    if values is None:
        raise PlaypenError(
            f"start {word!r}; expected X,Y,HEADING in mm and degrees, such as 100,200,90, or "
            "grid:COLUMNSxROWS, random or playpen"
        )
    start = StartPose(*values)
    if reason := find_obstruction(playpen, robot, start.x_mm, start.y_mm):
        raise PlaypenError(f"start {word}: {reason}")
    return start


def _parse_grid(word: str, playpen: Playpen, robot: int) -> list[StartPose]:
    """Return the centres of a grid's cells with room, row by row from the lowest y."""
    match = re.fullmatch(r"grid:([0-9]{1,3})x([0-9]{1,3})(?:@(-?[0-9]{1,3}(?:\.[0-9]+)?))?", word)
    columns, rows = (int(match[1]), int(match[2])) if match else (0, 0)
    if match is None or not 1 <= columns * rows <= _MAX_GRID_CELLS:
        raise PlaypenError(
            f"start {word!r}; expected grid:COLUMNSxROWS or grid:COLUMNSxROWS@HEADING, such as "
            f"grid:3x2@90, of up to {_MAX_GRID_CELLS} places"
        )
    (left, right), (low, high) = extent(playpen)
    xs = [left + (right - left) * (column + 0.5) / columns for column in range(columns)]
    ys = [low + (high - low) * (row + 0.5) / rows for row in range(rows)]
    positions = [StartPose(x, y, float(match[3] or 0)) for y in ys for x in xs]
    free = [start for start in positions if not find_obstruction(playpen, robot, start.x_mm, start.y_mm)]
    if not free:
        raise PlaypenError(f"start {word}: none of the {len(positions)} places has room for the robot")
    return free


def _random_poses(playpen: Playpen, robot: int, seed: int) -> Iterator[StartPose]:
    rng = starts_rng(seed)
    while True:
        start = draw_free_pose(playpen, robot, rng)
        if start is None:
            raise PlaypenError(f"start random: no room for the robot was found in {TRIES} tries")
        yield StartPose(*start)
