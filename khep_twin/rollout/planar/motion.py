"""Motion of a robot in a plane: two motors, and tyres that grip.

All constants are those of the scene that `playpen_to_mjcf` makes. Motion is integrated as by MuJoCo's
implicit integrator, in substeps of 2.5 ms, for any number of them per step:

    J w' = K (V - K w) / R - T - r F      each wheel, w its speed, F the force of its tyre on the floor
    m v' = F_left + F_right + walls       and likewise about the vertical axis

T is the gear's dry friction, against the speed; a wheel stands while less than its torque drives it. While
tyres grip and wheels keep turning as they do, both wheels and the body are two first-order lags, for
translation and rotation, and nothing has to be solved. Wheels of different radii have
the lags of their mean. `contact_solver` does the rest.
"""

import math

from khep_twin.compilable import compilable
from khep_twin.rollout.planar import contact_solver
from khep_twin.rollout.planar import plane as flat
from khep_twin.rollout.planar.plane import (
    ANCHOR_X,
    ANCHOR_Y,
    CENTRE_X,
    CENTRE_Y,
    DISTANCE,
    HEADING,
    HEADING_COSINE,
    HEADING_SINE,
    LEFT_ANGLE,
    MOVED,
    RIGHT_ANGLE,
    SLIPS,
    TOUCHED,
    PlanarRobot,
    Plane,
    X,
    Y,
)

_ANCHORED = 0.02
"""Distance moved after which distances to all obstacles are measured again [m]."""


@compilable
def step(plane: Plane) -> None:
    """Advance by one step, of all its substeps, at the present motor voltages."""
    robot = plane.robot
    joints, speeds, last = robot.joints, robot.speeds, robot.last
    x, y, heading = joints[X], joints[Y], joints[HEADING]
    c, s = math.cos(heading), math.sin(heading)
    last[CENTRE_X], last[CENTRE_Y], last[HEADING_COSINE], last[HEADING_SINE] = x, y, c, s
    dx, dy = x - last[ANCHOR_X], y - last[ANCHOR_Y]
    last[MOVED] = math.sqrt(dx * dx + dy * dy)
    if last[MOVED] > _ANCHORED:
        measure(plane)
    robot.force[0] = robot.stall * robot.ctrl[0] - robot.damping * speeds[LEFT_ANGLE]
    robot.force[1] = robot.stall * robot.ctrl[1] - robot.damping * speeds[RIGHT_ANGLE]
    left, right = robot.left_wheel * speeds[LEFT_ANGLE], robot.right_wheel * speeds[RIGHT_ANGLE]
    left_way, right_way = _turning(left, robot.ctrl[0], robot), _turning(right, robot.ctrl[1], robot)
    if left_way == 0.0 and right_way == 0.0 and last[SLIPS] == 0:
        # Both gears hold; what is left of a speed is the solver's rest.
        for i in range(len(speeds)):
            speeds[i] = 0.0
        return
    left_aim = robot.left_free_speed * (robot.ctrl[0] - left_way * robot.dead_voltage)
    right_aim = robot.right_free_speed * (robot.ctrl[1] - right_way * robot.dead_voltage)
    going, turning = (left + right) / 2, (right - left) / 2
    going_aim, turning_aim = (left_aim + right_aim) / 2, (right_aim - left_aim) / 2
    n, h = robot.n_substeps, robot.substep
    # The first substep needs the largest tyre force.
    speeding = (going_aim - going) * (1 - robot.going) / h
    swinging = (turning_aim - turning) * (1 - robot.turning) / h
    per_turn = 2 / robot.track
    force = abs(robot.mass * speeding) / 2 + abs(robot.inertia * swinging) * per_turn * per_turn / 2
    force += abs(robot.mass * going * turning) * per_turn / 2
    pitching = abs(robot.lean + robot.mass * robot.high * speeding)
    most = max(abs(going), abs(going_aim)) * h * n
    if (
        last[SLIPS] != 0
        or left_way * right_way == 0.0
        or force > (robot.grip - robot.relief * pitching) * min(robot.left_hold, robot.right_hold)
        or not _clear(plane, x, y, robot.radius + most)
    ):
        contact_solver.slide(plane)
        return
    left_path = right_path = 0.0
    for _ in range(n):
        going = going_aim + (going - going_aim) * robot.going
        turning = turning_aim + (turning - turning_aim) * robot.turning
        # Positions are integrated with the new speeds along the old heading, as in MuJoCo.
        x += h * going * c
        y += h * going * s
        left_path += going - turning
        right_path += going + turning
        turn = h * turning * per_turn
        heading += turn
        turn_c, turn_s = flat.turned(turn)
        c, s = c * turn_c - s * turn_s, s * turn_c + c * turn_s
    if (going - turning) * left_way < 0 or (going + turning) * right_way < 0:
        # A wheel stops within the step.
        contact_solver.slide(plane)
        return
    joints[X], joints[Y], joints[HEADING] = x, y, heading
    joints[LEFT_ANGLE] += left_path * h / robot.left_wheel
    joints[RIGHT_ANGLE] += right_path * h / robot.right_wheel
    speeds[0], speeds[1], speeds[2] = going, 0.0, turning * per_turn
    speeds[LEFT_ANGLE] = (going - turning) / robot.left_wheel
    speeds[RIGHT_ANGLE] = (going + turning) / robot.right_wheel


@compilable
def _turning(speed: float, voltage: float, robot: PlanarRobot) -> float:
    """Return the direction in which a wheel turns or starts to, 1 or -1; 0 if its gear holds it."""
    if abs(speed) > contact_solver.STANDS:
        return math.copysign(1.0, speed)
    return math.copysign(1.0, voltage) if abs(voltage) > robot.dead_voltage else 0.0


@compilable
def measure(plane: Plane) -> None:
    """Make the position of the last step's start the anchor; measure and sort the distances from it."""
    last, order, things = plane.robot.last, plane.order, plane.things
    x, y = last[CENTRE_X], last[CENTRE_Y]
    last[ANCHOR_X], last[ANCHOR_Y], last[MOVED] = x, y, 0.0
    for i in range(len(order)):
        # Insertion sort, as few change their order.
        thing, k = order[i], i
        distance = flat.distance_to(things, thing, x, y)
        things[thing, DISTANCE] = distance
        while k > 0 and things[order[k - 1], DISTANCE] > distance:
            order[k] = order[k - 1]
            k -= 1
        order[k] = thing


@compilable
def _clear(plane: Plane, x: float, y: float, reach: float) -> bool:
    """Return whether nothing that can be touched is within reach of a position [m]."""
    things, moved = plane.things, plane.robot.last[MOVED]
    for i in range(len(plane.order)):
        if things[plane.order[i], DISTANCE] - moved > reach:
            return True
        thing = plane.order[i]
        if things[thing, TOUCHED] and flat.distance_to(things, thing, x, y) <= reach:
            return False
    return True
