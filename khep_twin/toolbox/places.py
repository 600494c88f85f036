"""The Khepera Toolbox's functions of the simulated robot's position: put, move and turn it, look around.

A robot is put down only where there is room. To move and to turn are the robot's own doing here, by command
C and through the physics: time passes, counters count, and wheels that push against a wall slip.
"""

import math
from typing import SupportsFloat

from khep_twin.errors import PlaypenError
from khep_twin.interventions.move_robot import current_playpen, place_robot, scan
from khep_twin.lab.sensor_test.sensor_test import PULSES_PER_DEGREE
from khep_twin.playpen.footprint import Circle
from khep_twin.playpen.overlap import Thing, placement_problems
from khep_twin.playpen.starts import near
from khep_twin.toolbox import serial_commands
from khep_twin.toolbox.simulator import OpenPlaypen, opened
from khep_twin.units import BODY_HEIGHT, PULSE_LENGTH

STEP_MM = 5.0
"""Distance of `movekhep` [mm], the toolbox's `gran`."""

SWEEP_DEG, SWEEP_STEP_DEG = 50, 5
"""Angle to either side that `checkobj` searches, and its steps [degrees] (toolbox)."""

CLEARANCE_MM = 1.5
"""Range of `checkobj` from the robot's edge [mm]: 29 mm from the centre of a Khepera (toolbox)."""

_MOVE_SLACK_S = 5.0
"""Time beyond 1 ms a pulse after which a move has failed [s]."""

_LOOK = 0.01
"""Time between two looks at a move [s]."""


def checkobj(btmap1: OpenPlaypen, port_id: int = 1) -> tuple[int, int]:
    """Return 1 or 0 each for something close before and close behind the robot.

    That is wherever its edge is met within 1.5 mm, 50 degrees to either side of ahead and of behind; walls,
    objects where they are by now, and other robots.
    """
    scene = opened(btmap1)
    robot = scene.twin.robots[scene.index(port_id)]
    x, y, reach = (length * 1e3 for length in robot.disc)
    heading_deg = math.degrees(robot.pose[2])
    angles = [*range(-SWEEP_DEG, SWEEP_DEG + 1, SWEEP_STEP_DEG)]
    way = reach + CLEARANCE_MM
    probes: list[Thing] = []
    for number, angle_deg in enumerate([*angles, *(180 + angle for angle in angles)], 1):
        angle = math.radians(heading_deg + angle_deg)
        point = Circle(x + way * math.cos(angle), y + way * math.sin(angle), 1e-3)
        probes.append(Thing("probe", number, None, point, 0, BODY_HEIGHT * 1e3, True))
    others = near(current_playpen(scene.twin.world), robot.index, Circle(x, y, way))
    found = placement_problems([*others, *probes], scene.twin.world.playpen.arena)
    met = {problem.location[1] for problem in found if problem.location[0] == "probe"}
    front = any(number in met for number in range(len(angles)))
    back = any(number in met for number in range(len(angles), 2 * len(angles)))
    return int(front), int(back)


def putkhep(
    xabs: SupportsFloat, yabs: SupportsFloat, heading_deg: SupportsFloat | None = None, port_id: int = 1
) -> None:
    """Put the robot down at a position, at rest, its board as after a reset, its sensors converted there.

    Args:
        xabs: Position of its centre in x, from the arena's lower left inner corner [mm].
        yabs: Position in y, likewise [mm].
        heading_deg: Heading, counter-clockwise from x [degrees]; without, as before.
        port_id: Number of the robot, where there are several.

    Raises:
        PlaypenError: There is no room for it; it stays where it was.
    """
    scene = opened()
    world, robot = scene.twin.world, scene.twin.robots[scene.index(port_id)]
    heading = math.degrees(robot.pose[2]) if heading_deg is None else float(heading_deg)
    try:
        place_robot(world, robot.index, float(xabs), float(yabs), heading, reset=True)
    except PlaypenError as error:
        raise PlaypenError(f"putkhep: {error}") from None
    scan(world)


def movekhep(dirn: int, btmap1: OpenPlaypen, port_id: int = 1) -> None:
    """Drive the robot 5 mm straight on (1) or backwards (-1), as long as that takes.

    Raises:
        ValueError: `dirn` is neither.
        PlaypenError: It does not get there.
    """
    if dirn not in (1, -1):
        raise ValueError(f"movekhep: dirn = {dirn!r}; expected 1 for forward or -1 for reverse")
    pulses = dirn * STEP_MM * 1e-3 / PULSE_LENGTH
    _go(opened(btmap1), port_id, pulses, pulses)


def rotkhep(alpha: SupportsFloat, port_id: int = 1) -> None:
    """Turn the robot on the spot [degrees], to the left above 0, as long as that takes.

    Raises:
        PlaypenError: It does not get there.
    """
    pulses = float(alpha) * PULSES_PER_DEGREE
    _go(opened(), port_id, -pulses, pulses)


def cvrtang(angle: SupportsFloat) -> float:
    """Convert an angle to its equal from -180 to 180 [degrees]."""
    return math.remainder(float(angle), 360)


def _go(scene: OpenPlaypen, port_id: int, left: float, right: float) -> None:
    """Move the wheels by so many pulses."""
    robot = scene.robots[scene.index(port_id)]
    start, (left_before, right_before) = scene.time, robot.position()
    serial_commands.skp(robot, left_before + left, right_before + right)
    while True:
        scene.pass_time(_LOOK)
        if all(wheel.on_target for wheel in robot.status()):
            return
        if scene.time > start + _MOVE_SLACK_S + (abs(left) + abs(right)) / 1000:
            raise PlaypenError(
                f"the robot is still on its way after {scene.time - start:.1f} s, at {robot.position()} "
                f"pulses; expected a free path"
            )
