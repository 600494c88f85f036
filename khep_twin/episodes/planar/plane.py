"""Data of a plane: a robot's numbers, the obstacles around it, and distances to them."""

import math
from collections.abc import Sequence
from typing import NamedTuple

from khep_twin.compilable import compilable
from khep_twin.sensing.buffers import Matrix, Vector

CENTRE_X, CENTRE_Y, COSINE, SINE, LENGTH, WIDTH, BOTTOM, TOP = 0, 1, 2, 3, 4, 5, 6, 7
"""Columns of `Plane.things`: centre [m], direction of the length, half of length and width [m], heights [m].
A cylinder has its radius as length, and a width below 0."""

TOUCHED, REFLECTANCE, DISTANCE, ALONG, ACROSS = 8, 9, 10, 11, 12
"""More columns: 1 if the body can touch it, infrared reflectance, distance from the anchor [m], and its
impulse on the body in the last substep, along and across [N s]."""
BODY = 13
"""One more: index in `Plane.bodies` of what is movable; below 0 for the others."""
N_COLUMNS = 14

THING, ACTIVE, SPEED_X, SPEED_Y, SPIN, INVERSE_MASS, INVERSE_INERTIA, GRIP, TWIST, FRICTION = range(10)
"""Columns of `Plane.bodies`: row of `Plane.things`, 1 if it moves or is touched, velocity [m/s] and rotation
[rad/s], inverse mass [1/kg] and inertia [1/(kg m^2)], largest force [N] and torque [N m] of the floor's
friction, and friction on other obstacles."""
FLOOR_X, FLOOR_Y, TWISTING = 10, 11, 12
"""More columns: impulses of the floor's friction in the last substep [N s, N m s]."""
N_BODY = 13

OTHER = 1
"""Column of `Plane.touches` behind the index of one body: index of the other, below 0 for what is fixed; then
the normal towards the one, the gap [m], the contact from the centres of both [m], and its impulses along and
across the normal [N s]."""
N_TOUCH = 11

HEADING_COSINE, HEADING_SINE, MOVED, ANCHOR_X, ANCHOR_Y, SLIPS, END, END_COSINE, END_SINE = range(2, 11)
N_NEAR, NEAREST = 11, 12
"""Indices in `PlanarRobot.last`, behind CENTRE_X and CENTRE_Y: the pose at the start of the last step, its
distance from the anchor, the anchor [m], whether a tyre slips or something is touched, the heading at the end
of the step with its cosine and sine, and the number of near obstacles at its start, with the
distance of the nearest [m]."""
N_LAST = 13

ASIDE, GEAR, PUSHED, PUSHED_ASIDE = 2, 4, 6, 7
"""Indices in `PlanarRobot.grips`, behind the left and right tyre's impulse along: both to the left, those of
the gears' friction, left before right, and of all obstacles forwards and to the left."""
N_GRIPS = 8

X, Y, HEADING, LEFT_ANGLE, RIGHT_ANGLE = 0, 1, 2, 3, 4
"""Indices in `PlanarRobot.joints` [m, rad]; `PlanarRobot.speeds` has the speeds forwards, to the left, of
rotation, and of the wheels [m/s, rad/s]."""
N_JOINTS = 5


def true_pose(joints: Sequence[float]) -> tuple[float, float, float]:
    """Return x, y [m] and the heading [rad], -pi to pi, of joint positions (N_JOINTS,)."""
    heading = joints[HEADING]
    return joints[X], joints[Y], math.atan2(math.sin(heading), math.cos(heading))


class PlanarRobot(NamedTuple):
    """A robot in a plane. Compiled code uses a record of the same fields: one address to pass on.

    Attributes:
        substep: Substep of the motion [s].
        n_substeps: Substeps in each step.
        radius: Radius of the body [m].
        track: Distance between the wheels [m].
        wheel: Mean radius of the wheels [m].
        left_wheel: Radius of the left wheel [m].
        right_wheel: Radius of the right wheel [m].
        mass: Mass of the whole robot [kg].
        inertia: Inertia of the whole robot about the vertical axis [kg m^2].
        spin: Inertia of a wheel and its rotor [kg m^2].
        stall: Stall torque of a motor per voltage [N m/V].
        damping: Torque lost per speed of a wheel [N m s].
        left_free_speed: Speed of the left tyre per voltage, without load [m/s/V].
        right_free_speed: Speed of the right tyre per voltage, without load [m/s/V].
        going: Part of the lag behind the free speed left after a substep, driving straight.
        turning: Part of the lag left after a substep, turning in place.
        gear: Dry friction of a gear, as a force at the tyre [N].
        dead_voltage: Voltage at which a motor overcomes that friction [V].
        grip: Largest force of a tyre that carries half of the robot [N].
        left_hold: Part of that force that the left tyre has; 1 for a sound one.
        right_hold: The same of the right tyre.
        relief: Loss of that force per pitching moment, which a support takes [1/m].
        shift: Shift of that force to the other tyre per rolling moment [1/m].
        lean: Pitching moment of the weight [N m].
        high: Pitching moment per accelerating force: the height of the mass, and the wheels' spin [m].
        low: Height at which obstacles push [m].
        friction: Friction of the body on obstacles.
        height: Height of the sensors above the floor [m].
        sight: Distance from the robot's centre within which a sensor may see something [m].
        mounts: Mount of each sensor: x forward, y left, cosine and sine of its direction, distance from the
            robot's centre (8, 5) [m].
        n_few: Number of the few points of a bulb.
        points: Points of a bulb, few and then many (n_points, 2).
        hidden: Buffer for which points are hidden (n_points,).
        contacts: Buffer for contacts: normal, gap, index of the obstacle, and place from its centre
            (n_contacts, 6).
        joints: Joint positions, live (N_JOINTS,).
        speeds: Joint speeds, live (N_JOINTS,).
        ctrl: Motor voltages (2,) [V].
        force: Motor torques at the start of the step (2,) [N m].
        grips: Impulses in the last substep (N_GRIPS,) [N s].
        last: State of the last step (N_LAST,).
    """

    substep: float
    n_substeps: int
    radius: float
    track: float
    wheel: float
    left_wheel: float
    right_wheel: float
    mass: float
    inertia: float
    spin: float
    stall: float
    damping: float
    left_free_speed: float
    right_free_speed: float
    going: float
    turning: float
    gear: float
    dead_voltage: float
    grip: float
    left_hold: float
    right_hold: float
    relief: float
    shift: float
    lean: float
    high: float
    low: float
    friction: float
    height: float
    sight: float
    mounts: Matrix
    n_few: int
    points: Matrix
    hidden: Vector[int]
    contacts: Matrix
    joints: Vector[float]
    speeds: Vector[float]
    ctrl: Vector[float]
    force: Vector[float]
    grips: Vector[float]
    last: Vector[float]


class Plane(NamedTuple):
    """The robot and all obstacles of a plane.

    Attributes:
        things: Obstacles around the robot, fixed ones first (n, N_COLUMNS).
        order: Indices of the fixed obstacles, nearest to the anchor first (n_fixed,).
        near: Buffer for the obstacles within sight at the start of the last step, in the robot's frame
            (n, N_COLUMNS).
        bodies: Movable obstacles (n_movable, N_BODY).
        touches: Buffer for contacts of movable obstacles with others (n_touches, N_TOUCH).
        robot: Robot with its sensors.
    """

    things: Matrix
    order: Vector[int]
    near: Matrix
    bodies: Matrix
    touches: Matrix
    robot: PlanarRobot


@compilable
def distance_to(things: Matrix, thing: int, x: float, y: float) -> float:
    """Return the distance of an obstacle from a point [m], 0 within."""
    dx, dy = x - things[thing, CENTRE_X], y - things[thing, CENTRE_Y]
    length, width = things[thing, LENGTH], things[thing, WIDTH]
    if width < 0:
        return max(math.sqrt(dx * dx + dy * dy) - length, 0.0)
    c, s = things[thing, COSINE], things[thing, SINE]
    along = max(abs(dx * c + dy * s) - length, 0.0)
    across = max(abs(dy * c - dx * s) - width, 0.0)
    if along == 0.0:
        return across
    return math.sqrt(along * along + across * across)


@compilable
def nearest(things: Matrix, thing: int, x: float, y: float) -> tuple[float, float, float]:
    """Return the unit vector from an obstacle to a point, and the distance [m], negative within."""
    dx, dy = x - things[thing, CENTRE_X], y - things[thing, CENTRE_Y]
    length, width = things[thing, LENGTH], things[thing, WIDTH]
    if width < 0:
        distance = math.sqrt(dx * dx + dy * dy)
        if distance == 0:
            return 1.0, 0.0, -length
        return dx / distance, dy / distance, distance - length
    c, s = things[thing, COSINE], things[thing, SINE]
    along, across = dx * c + dy * s, dy * c - dx * s
    out_along, out_across = abs(along) - length, abs(across) - width
    if out_along > 0 and out_across > 0:
        away = math.sqrt(out_along * out_along + out_across * out_across)
        normal_along = math.copysign(out_along / away, along)
        normal_across = math.copysign(out_across / away, across)
    elif out_along > out_across:
        away, normal_along, normal_across = out_along, math.copysign(1.0, along), 0.0
    else:
        away, normal_along, normal_across = out_across, 0.0, math.copysign(1.0, across)
    return c * normal_along - s * normal_across, s * normal_along + c * normal_across, away


@compilable
def direction(robot: PlanarRobot) -> tuple[float, float]:
    """Return cosine and sine of the heading."""
    last, heading = robot.last, robot.joints[HEADING]
    if heading == last[END]:
        return last[END_COSINE], last[END_SINE]
    return math.cos(heading), math.sin(heading)


@compilable
def end(robot: PlanarRobot, heading: float, cosine: float, sine: float) -> None:
    """Set the heading at the end of a step [rad], and its cosine and sine, which may have drifted apart."""
    last, scale = robot.last, 1.5 - 0.5 * (cosine * cosine + sine * sine)
    robot.joints[HEADING] = last[END] = heading
    last[END_COSINE], last[END_SINE] = cosine * scale, sine * scale


@compilable
def turned(angle: float) -> tuple[float, float]:
    """Return cosine and sine of a substep's turn [rad], to the last bits of a tenth of a radian."""
    # Products, as divisions take several times as long.
    square = angle * angle
    cosine = 1 - square / 2 * (1 - square * (1 / 12) * (1 - square * (1 / 30) * (1 - square * (1 / 56))))
    sine = 1 - square * (1 / 6) * (1 - square * (1 / 20) * (1 - square * (1 / 42) * (1 - square * (1 / 72))))
    return cosine, angle * sine
