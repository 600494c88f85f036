"""Changes of a stand-in robot's world that are hidden from its twin; each waits until there is room for it.

Objects are named as in the MJCF model: "block4", "cylinder0", counted in the file's order from 0.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple, TypeVar

import mujoco
import numpy as np

from khep_twin.clock import NS_PER_S
from khep_twin.errors import PlaypenError
from khep_twin.interventions import move_robot, switching
from khep_twin.playpen import Block, Cylinder, Playpen
from khep_twin.playpen.starts import Start, at_start, extent, find_obstruction
from khep_twin.units import metres
from khep_twin.world import World

T = TypeVar("T", Block, Cylinder)

_AWAY_MM = -5000.0
"""Position of removed objects: out of reach of everything in the arena."""

_CLEARANCE_MM = 10.0
"""Least distance of a robot from a placed object (assumed)."""

_LIFT_MM = 100.0
"""Least distance of a lift, unless its new pose is given."""

_GRID_MM = 20.0
"""Grid spacing of the positions that are tested for reachability."""


class Lifted(NamedTuple):
    """The robot is lifted and placed elsewhere.

    Attributes:
        at_s: Time [s].
        to: New pose; by default drawn by the seed, at least 100 mm away.
    """

    at_s: float
    to: Start | None = None


class LampOff(NamedTuple):
    """A lamp is switched off at `at_s` [s]."""

    at_s: float
    lamp: int = 0


class LampMoved(NamedTuple):
    """A lamp is moved by `by_mm` at `at_s` [s]."""

    at_s: float
    lamp: int
    by_mm: tuple[float, float]


class Moved(NamedTuple):
    """A block or cylinder is moved by `by_mm`, and turned, at `at_s` [s]."""

    at_s: float
    thing: str
    by_mm: tuple[float, float]
    turned_deg: float = 0.0


class Removed(NamedTuple):
    """A block or cylinder is removed at `at_s` [s]."""

    at_s: float
    thing: str


class Added(NamedTuple):
    """A block or cylinder that the playpen does not have is added at `at_s` [s]."""

    at_s: float
    item: Block | Cylinder


Change = Lifted | LampOff | LampMoved | Moved | Removed | Added


def with_added(playpen: Playpen, changes: Sequence[Change]) -> Playpen:
    """Return the playpen with all added objects; names keep merged blocks apart."""
    blocks, cylinders = _named(playpen.blocks, "b"), _named(playpen.cylinders, "c")
    for change in changes:
        match change:
            case Added(item=Block() as item):
                blocks = _named((*blocks, item), "b")
            case Added(item=Cylinder() as item):
                cylinders = _named((*cylinders, item), "c")
            case _:
                pass
    return playpen.model_copy(update={"blocks": blocks, "cylinders": cylinders})


def hide_added(world: World, playpen: Playpen) -> None:
    """Remove all objects that the playpen does not have from a world of `with_added`."""
    for kind, items in world.playpen.objects.items():
        for index in range(len(playpen.objects[kind]), len(items)):
            _set_pose(world, kind, index, {"x_mm": _AWAY_MM, "y_mm": _AWAY_MM})


def apply(world: World, change: Change, added: int, rng: np.random.Generator) -> Change | None:
    """Apply a change; return it with its time and drawn values, None without room for it now.

    Args:
        world: World of the stand-in robot.
        change: Change.
        added: Index of an added object among those of its kind.
        rng: Stream of drawn poses.
    """
    now = change._replace(at_s=world.time_ns / NS_PER_S)
    match change:
        case Lifted(to=to):
            to = _lift(world, to, rng)
            return to and Lifted(now.at_s, to)
        case LampOff(lamp=lamp):
            switching.switch(world, lamp, False)
        case LampMoved(lamp=lamp, by_mm=(dx_mm, dy_mm)):
            lamps = list(world.playpen.lamps)
            at = {"x_mm": lamps[lamp].x_mm + dx_mm, "y_mm": lamps[lamp].y_mm + dy_mm}
            lamps[lamp] = lamps[lamp].model_copy(update=at)
            switching.set_lamps(world, lamps, world.playpen.lighting)
        case Moved(thing=thing, by_mm=(dx_mm, dy_mm), turned_deg=turned_deg):
            kind, index = _split(thing)
            item = world.playpen.objects[kind][index]
            at = {"x_mm": item.x_mm + dx_mm, "y_mm": item.y_mm + dy_mm}
            if kind == "block":
                at["angle_deg"] = item.angle_deg + turned_deg
            return now if _place_if_free(world, kind, index, at) else None
        case Removed(thing=thing):
            _set_pose(world, *_split(thing), {"x_mm": _AWAY_MM, "y_mm": _AWAY_MM})
        case Added(item=item):
            kind = "block" if isinstance(item, Block) else "cylinder"
            at = {"x_mm": item.x_mm, "y_mm": item.y_mm}
            return now if _place_if_free(world, kind, added, at) else None
    return now


def reachable(playpen: Playpen) -> list[tuple[float, float]]:
    """Return positions with room that a robot can drive to from its start [mm]."""
    (left, right), (low, high) = extent(playpen)
    start = (playpen.robots[0].x_mm, playpen.robots[0].y_mm)
    cells, todo = {(0, 0)}, [(0, 0)]
    while todo:
        column, row = todo.pop()
        for step in ((1, 0), (-1, 0), (0, 1), (0, -1)):
            cell = column + step[0], row + step[1]
            x_mm, y_mm = start[0] + cell[0] * _GRID_MM, start[1] + cell[1] * _GRID_MM
            inside = left <= x_mm <= right and low <= y_mm <= high
            if cell not in cells and inside and not find_obstruction(playpen, 0, x_mm, y_mm):
                cells.add(cell)
                todo.append(cell)
    return [(start[0] + column * _GRID_MM, start[1] + row * _GRID_MM) for column, row in sorted(cells)]


def _lift(world: World, to: Start | None, rng: np.random.Generator) -> Start | None:
    x, y, _ = world.robots[0].pose
    if to is None:
        places = reachable(at_start(world.playpen, 0, (x * 1e3, y * 1e3, 0.0)))
        far = [place for place in places if math.dist(place, (x * 1e3, y * 1e3)) >= _LIFT_MM]
        if not far:
            return None
        x_mm, y_mm = far[int(rng.integers(len(far)))]
        to = round(x_mm, 1), round(y_mm, 1), round(float(rng.uniform(-180, 180)), 1)
    try:
        move_robot.place_robot(world, 0, *to)
    except PlaypenError:
        return None
    return to


def _place_if_free(world: World, kind: str, index: int, at: dict[str, float]) -> bool:
    """Place an object, unless the robot is there; return whether it was placed."""
    grown = {
        key: getattr(world.playpen.objects[kind][index], key) + 2 * _CLEARANCE_MM
        for key in ("length_mm", "width_mm", "radius_mm")
        if hasattr(world.playpen.objects[kind][index], key)
    }
    x, y, _ = world.robots[0].pose
    if find_obstruction(_with_pose(world.playpen, kind, index, {**at, **grown}), 0, x * 1e3, y * 1e3):
        return False
    _set_pose(world, kind, index, at)
    return True


def _set_pose(world: World, kind: str, index: int, at: dict[str, float]) -> None:
    world.playpen = _with_pose(world.playpen, kind, index, at)
    item = world.playpen.objects[kind][index]
    geom, half = world.model.geom(f"{kind}{index}").id, math.radians(item.angle_deg) / 2
    world.model.geom_pos[geom, :2] = metres(item.x_mm), metres(item.y_mm)
    world.model.geom_quat[geom] = math.cos(half), 0, 0, math.sin(half)
    mujoco.mj_kinematics(world.model, world.data)
    world.refresh()


def _with_pose(playpen: Playpen, kind: str, index: int, at: dict[str, float]) -> Playpen:
    items = list(playpen.objects[kind])
    items[index] = items[index].model_copy(update=at)
    return playpen.model_copy(update={f"{kind}s": tuple(items)})


def _split(thing: str) -> tuple[str, int]:
    kind = thing.rstrip("0123456789")
    return kind, int(thing.removeprefix(kind))


def _named(items: Sequence[T], prefix: str) -> tuple[T, ...]:
    return tuple(
        item if item.name else item.model_copy(update={"name": f"{prefix}{index}"})
        for index, item in enumerate(items)
    )
