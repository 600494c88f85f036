"""Moves of a robot by the user in a running world.

The robot then stands upright and at rest. Its board keeps counters, registers and motors, unless it is also
reset. A move is an action like those of the host, so that a log repeats it.
"""

import math
import struct
from collections.abc import Iterable

import mujoco

from khep_twin.board.uart import HostEvent, HostEventKind
from khep_twin.errors import PlaypenError
from khep_twin.playpen import Block, Cylinder, Playpen
from khep_twin.playpen.starts import find_obstruction
from khep_twin.world import World

_POSE = struct.Struct("<3d")
_RESET = b"\1"


def place_robot(
    world: World, index: int, x_mm: float, y_mm: float, heading_deg: float, *, reset: bool = False
) -> None:
    """Move a robot.

    Args:
        world: World of the robot.
        index: Index of the robot.
        x_mm: Position of its centre, from the arena's lower left inner corner [mm].
        y_mm: Position of its centre, from the same corner [mm].
        heading_deg: Heading, counter-clockwise from x [deg].
        reset: True to reset its board as well: counters, setpoints, controllers and LEDs.

    Raises:
        PlaypenError: There is no room for it; it stays where it was.
    """
    if not all(map(math.isfinite, (x_mm, y_mm, heading_deg))):
        raise PlaypenError(
            f"a robot cannot be put to ({x_mm}, {y_mm}), {heading_deg} degrees; expected finite numbers"
        )
    if reason := find_obstruction(current_playpen(world), index, x_mm, y_mm):
        raise PlaypenError(reason)
    event_data = _POSE.pack(x_mm, y_mm, heading_deg) + (_RESET if reset else b"")
    world.observers.on_host_event(index, HostEvent(HostEventKind.MOVE_ROBOT, world.time_ns, None, event_data))
    model, data = world.model, world.data
    robot, half = world.robots[index].indices, math.radians(heading_deg) / 2
    start = robot.pose
    data.qpos[start : start + 3] = x_mm / 1e3, y_mm / 1e3, model.qpos0[start + 2]
    data.qpos[start + 3 : start + 7] = math.cos(half), 0, 0, math.sin(half)
    data.qvel[model.body_rootid[model.dof_bodyid] == robot.base] = 0
    # Update the positions that the robots are read from.
    mujoco.mj_kinematics(model, data)
    if reset:
        world.robots[index].reset_motion()
    world.observers.on_event(index, f"put to ({x_mm:g}, {y_mm:g}), {heading_deg:g} degrees")


def repeat_move(world: World, index: int, event: HostEvent) -> None:
    """Move a robot as recorded in a log."""
    pose_data, reset_data = event.data[: _POSE.size], event.data[_POSE.size :]
    place_robot(world, index, *_POSE.unpack(pose_data), reset=reset_data == _RESET)


def scan(world: World) -> None:
    """Convert all sensors now, so that the boards hold current readings after something was moved."""
    world.observers.on_host_event(0, HostEvent(HostEventKind.SCAN, world.time_ns))
    world.scan()


def current_playpen(world: World) -> Playpen:
    """Return the playpen with the current poses of its robots and movable objects, all assumed upright."""

    def with_current_poses(items: Iterable[Block | Cylinder], kind: str) -> tuple[Block | Cylinder, ...]:
        return tuple(
            item.model_copy(update=_current_pose(world, f"{kind}{number}", item)) if item.movable else item
            for number, item in enumerate(items)
        )

    # After a step the bodies' positions are those at its start; observers must not change them.
    mujoco.mj_kinematics(world.model, world.data)
    playpen = world.playpen
    robots = tuple(
        entry.model_copy(update={"x_mm": x * 1e3, "y_mm": y * 1e3, "heading_deg": math.degrees(heading)})
        for entry, (x, y, heading) in zip(playpen.robots, (robot.pose for robot in world.robots), strict=True)
    )
    objects = {f"{kind}s": with_current_poses(items, kind) for kind, items in playpen.objects.items()}
    return playpen.model_copy(update={**objects, "robots": robots})


def _current_pose(world: World, name: str, item: Block | Cylinder) -> dict[str, float]:
    """Return the current pose of a movable object by its keys in the playpen."""
    body = world.model.body(name).id
    x, y, _ = world.data.xpos[body].tolist()
    pose = {"x_mm": x * 1e3, "y_mm": y * 1e3}
    if isinstance(item, Block):
        along_x, along_y = world.data.xmat[body].reshape(3, 3)[:2, 0].tolist()
        pose["angle_deg"] = math.degrees(math.atan2(along_y, along_x))
    return pose
