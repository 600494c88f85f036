"""Start poses and lighting of a series of runs."""

import math
import re
from collections.abc import Iterator, Sequence
from itertools import cycle, islice
from typing import NamedTuple, cast, get_args

from khep_twin.errors import PlaypenError
from khep_twin.playpen import Lamp, Playpen
from khep_twin.playpen.parts import LightingMode
from khep_twin.playpen.starts import TRIES, extent, free_pose, no_room, own_starts, starts_rng

LIGHTINGS = (*get_args(LightingMode), "off")
"""Lighting modes, and "off"."""

_GRID_LIMIT = 1000


class StartPose(NamedTuple):
    """Pose of a robot at the start of a run.

    Attributes:
        x_mm: Position of its centre along x [mm].
        y_mm: Position of its centre along y [mm].
        heading_deg: Heading, counter-clockwise from x [degrees].
    """

    x_mm: float
    y_mm: float
    heading_deg: float

    def __str__(self) -> str:
        """Return the pose as written on the command line."""
        return f"{self.x_mm:g},{self.y_mm:g},{self.heading_deg:g}"


def starts(wishes: Sequence[str], playpen: Playpen, robot: int, runs: int, seed: int) -> list[StartPose]:
    """Return the start poses that command-line words describe; runs use them in turn.

    Args:
        wishes: Words, each X,Y,HEADING [mm, degrees], or grid:COLUMNSxROWS with an optional @HEADING, or
            `random` for another random pose in each turn, or `playpen` for the playpen's own: all of its
            spots, if any.
        playpen: Playpen with room for them.
        robot: Index of the robot.
        runs: Number of runs.
        seed: Seed of the random poses.

    Raises:
        PlaypenError: A word is none of these, there is no room, or there is no such robot.
    """
    if not 0 <= robot < len(playpen.robots):
        text = f"robot = {robot}: not in playpen {playpen.name!r}"
        raise PlaypenError(text, key="robot", value=robot, expected=range(len(playpen.robots)))
    found: list[StartPose | None] = []
    for wanted in wishes:
        if wanted == "playpen":
            found += [StartPose(*start) for start in own_starts(playpen, robot)]
        elif wanted == "random":
            found.append(None)
        elif wanted.startswith("grid:"):
            found += _grid(wanted, playpen, robot)
        else:
            found.append(_single(wanted, playpen, robot))
    fixed = [each for each in found if each is not None]
    if len(fixed) == len(found):
        return fixed
    drawn = _drawn(playpen, robot, seed)
    return [next(drawn) if each is None else each for each in islice(cycle(found), runs)]


def lit(playpen: Playpen, lighting: str | None) -> Playpen:
    """Return the playpen with its lamps on all, at random, in sequence, or off; unchanged for None.

    Raises:
        PlaypenError: The lighting is unknown.
    """
    if lighting is None:
        return playpen
    if lighting not in LIGHTINGS:
        found = f"lighting {lighting!r}: unknown"
        raise PlaypenError(found, key="lighting", value=lighting, expected=LIGHTINGS)
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


def numbers(text: str, count: int) -> list[float] | None:
    """Return `count` finite numbers separated by commas, None for anything else."""
    try:
        values = [float(part) for part in text.split(",")]
    except ValueError:
        return None
    return values if len(values) == count and all(map(math.isfinite, values)) else None


def _single(wanted: str, playpen: Playpen, robot: int) -> StartPose:
    values = numbers(wanted, 3)
    if values is None:
        raise PlaypenError(
            f"start {wanted!r}; expected X,Y,HEADING in mm and degrees, such as 100,200,90, or "
            "grid:COLUMNSxROWS, random or playpen"
        )
    start = StartPose(*values)
    if reason := no_room(playpen, robot, start.x_mm, start.y_mm):
        raise PlaypenError(f"start {wanted}: {reason}")
    return start


def _grid(wanted: str, playpen: Playpen, robot: int) -> list[StartPose]:
    """Return the middles of a grid's cells, row by row from below; those without room are left out."""
    parts = re.fullmatch(r"grid:([0-9]{1,3})x([0-9]{1,3})(?:@(-?[0-9]{1,3}(?:\.[0-9]+)?))?", wanted)
    columns, rows = (int(parts[1]), int(parts[2])) if parts else (0, 0)
    if parts is None or not 1 <= columns * rows <= _GRID_LIMIT:
        raise PlaypenError(
            f"start {wanted!r}; expected grid:COLUMNSxROWS or grid:COLUMNSxROWS@HEADING, such as "
            f"grid:3x2@90, of up to {_GRID_LIMIT} places"
        )
    (left, right), (low, high) = extent(playpen)
    xs = [left + (right - left) * (column + 0.5) / columns for column in range(columns)]
    ys = [low + (high - low) * (row + 0.5) / rows for row in range(rows)]
    positions = [StartPose(x, y, float(parts[3] or 0)) for y in ys for x in xs]
    free = [start for start in positions if not no_room(playpen, robot, start.x_mm, start.y_mm)]
    if not free:
        raise PlaypenError(f"start {wanted}: none of the {len(positions)} places has room for the robot")
    return free


def _drawn(playpen: Playpen, robot: int, seed: int) -> Iterator[StartPose]:
    rng = starts_rng(seed)
    while True:
        start = free_pose(playpen, robot, rng)
        if start is None:
            raise PlaypenError(f"start random: no room for the robot was found in {TRIES} tries")
        yield StartPose(*start)
