"""The Khepera Toolbox's functions to place, move and turn the simulated robot, and to detect obstacles.

A robot is placed only where it does not collide. It moves and turns by command C, in the physics simulation:
time passes, counters count, and wheels that push against a wall slip.
"""

import math
from typing import SupportsFloat

from khep_twin.errors import PlaypenError
from khep_twin.interventions.move_robot import current_playpen, place_robot, scan
from khep_twin.lab.sensor_test.sensor_test import PULSES_PER_DEGREE
from khep_twin.playpen.footprint import Circle
from khep_twin.playpen.overlap import PlacedPart, placement_problems
from khep_twin.playpen.starts import find_neighbours
from khep_twin.toolbox import serial_commands
from khep_twin.toolbox.simulator import OpenPlaypen, get_open_playpen
from khep_twin.units import BODY_HEIGHT, PULSE_LENGTH

STEP_MM = 5.0
"""Distance of `movekhep` [mm], the toolbox's `gran`."""

SWEEP_DEG, SWEEP_STEP_DEG = 50, 5
"""Angle to either side that `checkobj` tests, and its step [degrees] (toolbox)."""

CLEARANCE_MM = 1.5
"""Range of `checkobj` from the robot's edge [mm]: 29 mm from the centre of a Khepera (toolbox)."""

_MOVE_SLACK_S = 5.0
"""Time-out of a move, in addition to 1 ms per pulse [s]."""

_POLL_INTERVAL_S = 0.01
"""Interval at which the status of a move is read [s]."""


def checkobj(btmap1: OpenPlaypen, port_id: int = 1) -> tuple[int, int]:
    """Return whether an obstacle is close to the robot's front and back, 1 or 0 each.

    Obstacles are walls, objects at their current positions, and other robots, within 1.5 mm of the robot's
    edge and 50 degrees to either side of its front or back.
    """
    simulator = get_open_playpen(btmap1)
    robot = simulator.twin.robots[simulator.index(port_id)]
    x, y, radius = (length * 1e3 for length in robot.disc)
    heading_deg = math.degrees(robot.pose[2])
    angles = [*range(-SWEEP_DEG, SWEEP_DEG + 1, SWEEP_STEP_DEG)]
    probe_mm = radius + CLEARANCE_MM
    probes: list[PlacedPart] = []
    for number, angle_deg in enumerate([*angles, *(180 + angle for angle in angles)], 1):
        angle = math.radians(heading_deg + angle_deg)
        point = Circle(x + probe_mm * math.cos(angle), y + probe_mm * math.sin(angle), 1e-3)
        probes.append(PlacedPart("probe", number, None, point, 0, BODY_HEIGHT * 1e3, True))
    neighbours = find_neighbours(current_playpen(simulator.twin.world), robot.index, Circle(x, y, probe_mm))
    problems = placement_problems([*neighbours, *probes], simulator.twin.world.playpen.arena)
    hits = {problem.location[1] for problem in problems if problem.location[0] == "probe"}
    front = any(number in hits for number in range(len(angles)))
    back = any(number in hits for number in range(len(angles), 2 * len(angles)))
    return int(front), int(back)


def putkhep(
    xabs: SupportsFloat, yabs: SupportsFloat, heading_deg: SupportsFloat | None = None, port_id: int = 1
) -> None:
    """Place the robot at a position, at rest, reset its board and convert its sensors.

    Args:
        xabs: Position of its centre in x, from the arena's lower left inner corner [mm].
        yabs: Position in y, likewise [mm].
        heading_deg: Heading, counter-clockwise from x [degrees]; without, the current one.
        port_id: Number of the robot, where there are several.

    Raises:
        PlaypenError: It would collide; it is not moved.
    """
    simulator = get_open_playpen()
    world, robot = simulator.twin.world, simulator.twin.robots[simulator.index(port_id)]
    heading = math.degrees(robot.pose[2]) if heading_deg is None else float(heading_deg)
    try:
        place_robot(world, robot.index, float(xabs), float(yabs), heading, reset=True)
    except PlaypenError as error:
        raise PlaypenError(f"putkhep: {error}") from None
    scan(world)


def movekhep(dirn: int, btmap1: OpenPlaypen, port_id: int = 1) -> None:
    """Drive the robot 5 mm forwards (1) or backwards (-1) and wait until it arrives.

    Raises:
        ValueError: `dirn` is neither.
        PlaypenError: It does not arrive.
    """
    if dirn not in (1, -1):
        raise ValueError(f"movekhep: dirn = {dirn!r}; expected 1 for forward or -1 for reverse")
    pulses = dirn * STEP_MM * 1e-3 / PULSE_LENGTH
    _turn_wheels(get_open_playpen(btmap1), port_id, pulses, pulses)


def rotkhep(alpha: SupportsFloat, port_id: int = 1) -> None:
    """Turn the robot on the spot [degrees], positive to the left, and wait until it arrives.

    Raises:
        PlaypenError: It does not arrive.
    """
    pulses = float(alpha) * PULSES_PER_DEGREE
    _turn_wheels(get_open_playpen(), port_id, -pulses, pulses)


def cvrtang(angle: SupportsFloat) -> float:
    """Convert an angle to the range from -180 to 180 [degrees]."""
    return math.remainder(float(angle), 360)


def _turn_wheels(simulator: OpenPlaypen, port_id: int, left: float, right: float) -> None:
    """Turn the wheels by `left` and `right` pulses, and wait until they arrive."""
    robot = simulator.robots[simulator.index(port_id)]
    start, (left_before, right_before) = simulator.time, robot.position()
    serial_commands.skp(robot, left_before + left, right_before + right)
    while True:
        simulator.pass_time(_POLL_INTERVAL_S)
        if all(wheel.on_target for wheel in robot.status()):
            return
        if simulator.time > start + _MOVE_SLACK_S + (abs(left) + abs(right)) / 1000:
            raise PlaypenError(
                f"the robot is still on its way after {simulator.time - start:.1f} s, at {robot.position()} "
                f"pulses; expected a free path"
            )
