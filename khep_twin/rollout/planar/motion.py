"""Motion of a robot in a plane: two motors, and tyres that grip.

All constants are those of the scene that `playpen_to_mjcf` makes. Motion is integrated as by MuJoCo's
implicit integrator, in substeps of 2.5 ms, for any number of them per step:

    J w' = K (V - K w) / R - r F          each wheel, w its speed, F the force of its tyre on the floor
    m v' = F_left + F_right + walls       and likewise about the vertical axis

While tyres grip, both wheels and the body are two first-order lags, for translation and rotation, and nothing
has to be solved; wheels of different radii have the lags of their mean. `contact_solver` does the rest.
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
    left_aim, right_aim = robot.left_free_speed * robot.ctrl[0], robot.right_free_speed * robot.ctrl[1]
    left, right = robot.left_wheel * speeds[LEFT_ANGLE], robot.right_wheel * speeds[RIGHT_ANGLE]
    going, turning = (left + right) / 2, (right - left) / 2
    going_aim, turning_aim = (left_aim + right_aim) / 2, (right_aim - left_aim) / 2
    n, h = robot.n_substeps, robot.substep
    # The first substep needs the largest tyre force.
    speeding = (going_aim - going) * (1 - robot.going) / h
    swinging = (turning_aim - turning) * (1 - robot.turning) / h
    per_turn = 2 / robot.track
    force = abs(robot.mass * speeding) / 2 + abs(robot.inertia * swinging) * per_turn * per_turn / 2
    force += abs(robot.mass * going * turning) * per_turn / 2
    most = max(abs(going), abs(going_aim)) * h * n
    if (
        last[SLIPS] != 0
        or force > robot.grip - robot.relief * abs(speeding)
        or not _clear(plane, x, y, robot.radius + most)
    ):
        contact_solver.slide(plane)
        return
    left_way = right_way = 0.0
    for _ in range(n):
        going = going_aim + (going - going_aim) * robot.going
        turning = turning_aim + (turning - turning_aim) * robot.turning
        # Positions are integrated with the new speeds along the old heading, as in MuJoCo.
        x += h * going * c
        y += h * going * s
        left_way += going - turning
        right_way += going + turning
        turn = h * turning * per_turn
        heading += turn
        turn_c, turn_s = flat.turned(turn)
        c, s = c * turn_c - s * turn_s, s * turn_c + c * turn_s
    joints[X], joints[Y], joints[HEADING] = x, y, heading
    joints[LEFT_ANGLE] += left_way * h / robot.left_wheel
    joints[RIGHT_ANGLE] += right_way * h / robot.right_wheel
    speeds[0], speeds[1], speeds[2] = going, 0.0, turning * per_turn
    speeds[LEFT_ANGLE] = (going - turning) / robot.left_wheel
    speeds[RIGHT_ANGLE] = (going + turning) / robot.right_wheel


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
