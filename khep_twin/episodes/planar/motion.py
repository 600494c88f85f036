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

from khep_twin.compilable import compilable, compilable_once
from khep_twin.episodes.planar import contact_solver
from khep_twin.episodes.planar import plane as flat
from khep_twin.episodes.planar.plane import (
    ANCHOR_X,
    ANCHOR_Y,
    CENTRE_X,
    CENTRE_Y,
    COSINE,
    DISTANCE,
    HEADING,
    HEADING_COSINE,
    HEADING_SINE,
    LEFT_ANGLE,
    LENGTH,
    MOVED,
    N_NEAR,
    NEAREST,
    REFLECTANCE,
    RIGHT_ANGLE,
    SINE,
    SLIPS,
    TOUCHED,
    PlanarRobot,
    Plane,
    X,
    Y,
)

_ANCHORED = 0.02
"""Distance moved after which distances to all obstacles are measured again [m]."""


@compilable_once
def step(plane: Plane) -> None:
    """Advance by one step, of all its substeps, at the present motor voltages."""
    robot = plane.robot
    joints, speeds, last = robot.joints, robot.speeds, robot.last
    x, y, heading = joints[X], joints[Y], joints[HEADING]
    c, s = flat.direction(robot)
    last[CENTRE_X], last[CENTRE_Y], last[HEADING_COSINE], last[HEADING_SINE] = x, y, c, s
    dx, dy = x - last[ANCHOR_X], y - last[ANCHOR_Y]
    last[MOVED] = math.sqrt(dx * dx + dy * dy)
    if last[MOVED] > _ANCHORED:
        measure(plane)
    look_around(plane)
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
        or not _clear(plane, robot.radius + most)
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
    joints[X], joints[Y] = x, y
    flat.end(robot, heading, c, s)
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
def look_around(plane: Plane) -> None:
    """Fill in the obstacles within sight at the start of the last step."""
    things, order, last = plane.things, plane.order, plane.robot.last
    last[N_NEAR], last[NEAREST] = 0.0, math.inf
    for i in range(len(order)):
        if things[order[i], DISTANCE] > plane.robot.sight + last[MOVED]:
            break
        _look_at(plane, order[i])
    for thing in range(len(order), len(things)):
        _look_at(plane, thing)


@compilable
def _look_at(plane: Plane, thing: int) -> None:
    """Add an obstacle to those within sight, if it is."""
    things, near, last = plane.things, plane.near, plane.robot.last
    c, s, row = last[HEADING_COSINE], last[HEADING_SINE], int(last[N_NEAR])
    dx, dy = things[thing, CENTRE_X] - last[CENTRE_X], things[thing, CENTRE_Y] - last[CENTRE_Y]
    near[row, CENTRE_X], near[row, CENTRE_Y] = dx * c + dy * s, dy * c - dx * s
    cosine, sine = things[thing, COSINE], things[thing, SINE]
    near[row, COSINE], near[row, SINE] = cosine * c + sine * s, sine * c - cosine * s
    for column in range(LENGTH, REFLECTANCE + 1):
        near[row, column] = things[thing, column]
    near[row, DISTANCE] = distance = flat.distance_to(near, row, 0.0, 0.0)
    last[NEAREST] = min(last[NEAREST], distance)
    if distance <= plane.robot.sight:
        last[N_NEAR] = row + 1


@compilable
def _clear(plane: Plane, reach: float) -> bool:
    """Return whether nothing that can be touched was within reach at the start of the step [m]."""
    near = plane.near
    for i in range(int(plane.robot.last[N_NEAR])):
        if near[i, TOUCHED] and near[i, DISTANCE] <= reach:
            return False
    return reach <= plane.robot.sight
