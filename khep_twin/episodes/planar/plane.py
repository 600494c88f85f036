"""Data of a plane: a robot, the obstacles around it, and distances to them."""

import math
from collections.abc import Sequence
from typing import NamedTuple

from khep_twin.compilable import compilable
from khep_twin.sensing.buffers import Matrix, Vector

CENTRE_X, CENTRE_Y, COSINE, SINE, HALF_LENGTH, HALF_WIDTH, BOTTOM, TOP = 0, 1, 2, 3, 4, 5, 6, 7
"""Columns of `Plane.obstacles`: centre [m], direction of the length, half of length and width [m], heights
[m]. A half width below 0 marks a cylinder, whose half length is its radius."""

TOUCHABLE, REFLECTANCE, DISTANCE, NORMAL_IMPULSE, TANGENT_IMPULSE = 8, 9, 10, 11, 12
"""More columns: 1 if the robot's body can touch it, infrared reflectance, distance from the anchor [m] (the
position of the last measurement), and impulse on the robot in the last substep: normal, tangential [N s]."""
BODY = 13
"""Another column: index of a movable obstacle in `Plane.bodies`; below 0 for fixed ones."""
N_COLUMNS = 14

Pair = tuple[float, float]

OBSTACLE, ACTIVE, SPEED_X, SPEED_Y, SPIN = range(5)
INVERSE_MASS, INVERSE_INERTIA, MAX_FORCE, MAX_TORQUE, FRICTION = range(5, 10)
"""Columns of `Plane.bodies`: row in `Plane.obstacles`, 1 if it moves or is touched, velocity [m/s] and
rotation [rad/s], inverse mass [1/kg] and inertia [1/(kg m^2)], largest force [N] and torque [N m] of the
floor's friction, and coefficient of friction on other obstacles."""
FLOOR_X, FLOOR_Y, FLOOR_TORQUE = 10, 11, 12
"""More columns: impulses of the floor's friction in the last substep [N s, N m s]."""
N_BODY = 13

OTHER_BODY = 1
"""Column of `Plane.obstacle_contacts` behind the index of one body: index of the other, below 0 for a fixed
obstacle; then the normal towards the first, the gap [m], the contact from both centres [m], and its impulses
along and across the normal [N s]."""
N_CONTACT_COLUMNS = 11

HEADING_COSINE, HEADING_SINE, ANCHOR_DISTANCE, ANCHOR_X, ANCHOR_Y, SLIPS = range(2, 8)
END_HEADING, END_COSINE, END_SINE, N_NEAR, NEAREST = range(8, 13)
"""Indices in `PlanarRobot.last_step`, behind CENTRE_X and CENTRE_Y: the heading at the start of the step, the
distance from the anchor and the anchor [m], whether a tyre slips or an obstacle is touched, the heading at
the end of the step with its cosine and sine, and the number of near obstacles at its start, with the distance
of the nearest [m]."""
N_LAST = 13

ASIDE, GEARS, PUSHED, PUSHED_ASIDE = 2, 4, 6, 7
"""Indices in `PlanarRobot.impulses`. First are the forward impulses of the left and right tyre; then those of
both tyres to the left, of the gears' friction (left, right), and of all obstacles forwards and to the
left."""
N_IMPULSES = 8

X, Y, HEADING, LEFT_ANGLE, RIGHT_ANGLE = 0, 1, 2, 3, 4
"""Indices in `PlanarRobot.joints` [m, rad]; `PlanarRobot.speeds` contains the speeds forwards, to the left,
of rotation, and of the wheels [m/s, rad/s]."""
N_JOINTS = 5

MOUNT_HEIGHT = 5
"""Column of `PlanarRobot.mounts`."""

FREE_JOINT = N_JOINTS
"""First of the numbers of a free joint, as in MuJoCo, which `casting` computes from the others."""


def true_pose(joints: Sequence[float]) -> tuple[float, float, float]:
    """Return x, y [m] and the heading [rad], -pi to pi, of joint positions (N_JOINTS,)."""
    heading = joints[HEADING]
    return joints[X], joints[Y], math.atan2(math.sin(heading), math.cos(heading))


class PlanarRobot(NamedTuple):
    """A robot in a plane. Compiled code uses a record of the same fields, which needs only one address.

    Attributes:
        substep: Substep of the motion [s].
        n_substeps: Substeps in each step.
        radius: Radius of the body [m].
        track: Distance between the wheels [m].
        wheel_radius: Mean radius of the wheels [m].
        left_wheel: Radius of the left wheel [m].
        right_wheel: Radius of the right wheel [m].
        mass: Mass of the whole robot [kg].
        inertia: Inertia of the whole robot about the vertical axis [kg m^2].
        wheel_inertia: Inertia of a wheel and its rotor [kg m^2].
        stall_torque: Stall torque of a motor per voltage [N m/V].
        damping: Torque loss per speed of a wheel [N m s].
        left_free_speed: Speed of the left tyre per voltage, without load [m/s/V].
        right_free_speed: Speed of the right tyre per voltage, without load [m/s/V].
        linear_decay: Factor by which a substep reduces the lag behind the free speed, driving straight.
        angular_decay: Factor as `linear_decay`, turning in place.
        gear_friction: Dry friction of a gear, as a force at the tyre [N].
        max_voltage: Largest voltage of a motor [V].
        dead_voltage: Voltage at which a motor overcomes the gear's friction [V].
        tyre_force: Largest force of a tyre that carries half of the robot [N].
        left_grip: Factor of `tyre_force` for the left tyre; 1 without a fault.
        right_grip: Factor of `tyre_force` for the right tyre.
        pitch_relief: Loss of `tyre_force` per pitching moment, which loads a support [1/m].
        roll_shift: Shift of `tyre_force` to the other tyre per rolling moment [1/m].
        weight_moment: Pitching moment of the weight [N m].
        pitch_arm: Pitching moment per accelerating force: height of the mass, and inertia of the wheels [m].
        push_height: Height at which obstacles push [m].
        friction: Coefficient of friction of the body on obstacles.
        sensor_range: Largest distance from the robot's centre at which a sensor detects an obstacle [m].
        mounts: Mount of each sensor: x forward, y left, cosine and sine of its direction, distance from the
            robot's centre, and height (n, 6) [m].
        n_coarse_points: Number of points in the coarse sampling of a bulb.
        points: Points of a bulb, those of the coarse and then of the fine sampling (n_points, 2).
        hidden: Buffer: 1 for points that are hidden (n_points,).
        contacts: Buffer for contacts: normal, gap, index of the obstacle, and position from its centre
            (n_contacts, 6).
        joints: Joint positions, updated in place (N_JOINTS,).
        speeds: Joint speeds, updated in place (N_JOINTS,).
        ctrl: Motor voltages (2,) [V].
        force: Motor torques at the start of the step (2,) [N m].
        impulses: Impulses in the last substep (N_IMPULSES,) [N s].
        last_step: State of the last step (N_LAST,).
    """

    substep: float
    n_substeps: int
    radius: float
    track: float
    wheel_radius: float
    left_wheel: float
    right_wheel: float
    mass: float
    inertia: float
    wheel_inertia: float
    stall_torque: float
    damping: float
    left_free_speed: float
    right_free_speed: float
    linear_decay: float
    angular_decay: float
    gear_friction: float
    max_voltage: float
    dead_voltage: float
    tyre_force: float
    left_grip: float
    right_grip: float
    pitch_relief: float
    roll_shift: float
    weight_moment: float
    pitch_arm: float
    push_height: float
    friction: float
    sensor_range: float
    mounts: Matrix
    n_coarse_points: int
    points: Matrix
    hidden: Vector[int]
    contacts: Matrix
    joints: Vector[float]
    speeds: Vector[float]
    ctrl: Vector[float]
    force: Vector[float]
    impulses: Vector[float]
    last_step: Vector[float]


class Plane(NamedTuple):
    """The robot and all obstacles of a plane; for compiled code arrays, with the robot as a record (1,).

    Attributes:
        obstacles: Obstacles around the robot, fixed ones first (n, N_COLUMNS).
        fixed_by_distance: Indices of the fixed obstacles, nearest to the anchor first (n_fixed,).
        near: Buffer for the obstacles in sensor range at the start of the last step, in the robot's frame
            (n, N_COLUMNS).
        bodies: Movable obstacles (n_movable, N_BODY).
        obstacle_contacts: Buffer for contacts of movable obstacles (n_contacts, N_CONTACT_COLUMNS).
        paint: Floor and paint on it, with the columns of `obstacles` (n_paint, N_COLUMNS).
        robot: Robot with its sensors.
    """

    obstacles: Matrix
    fixed_by_distance: Vector[int]
    near: Matrix
    bodies: Matrix
    obstacle_contacts: Matrix
    paint: Matrix
    robot: PlanarRobot


@compilable
def distance_to(obstacles: Matrix, obstacle: int, x: float, y: float) -> float:
    """Return the distance of an obstacle from a point [m], 0 within."""
    dx, dy = x - obstacles[obstacle, CENTRE_X], y - obstacles[obstacle, CENTRE_Y]
    half_length, half_width = obstacles[obstacle, HALF_LENGTH], obstacles[obstacle, HALF_WIDTH]
    if half_width < 0:
        return max(math.sqrt(dx * dx + dy * dy) - half_length, 0.0)
    c, s = obstacles[obstacle, COSINE], obstacles[obstacle, SINE]
    along = max(abs(dx * c + dy * s) - half_length, 0.0)
    across = max(abs(dy * c - dx * s) - half_width, 0.0)
    if along == 0.0:
        return across
    return math.sqrt(along * along + across * across)


@compilable
def normal_and_distance(obstacles: Matrix, obstacle: int, x: float, y: float) -> tuple[float, float, float]:
    """Return the unit normal x, y of an obstacle towards a point, and the distance [m], negative within."""
    dx, dy = x - obstacles[obstacle, CENTRE_X], y - obstacles[obstacle, CENTRE_Y]
    length, width = obstacles[obstacle, HALF_LENGTH], obstacles[obstacle, HALF_WIDTH]
    if width < 0:
        distance = math.sqrt(dx * dx + dy * dy)
        if distance == 0:
            return 1.0, 0.0, -length
        return dx / distance, dy / distance, distance - length
    c, s = obstacles[obstacle, COSINE], obstacles[obstacle, SINE]
    along, across = dx * c + dy * s, dy * c - dx * s
    outside_along, outside_across = abs(along) - length, abs(across) - width
    if outside_along > 0 and outside_across > 0:
        distance = math.sqrt(outside_along * outside_along + outside_across * outside_across)
        normal_along = math.copysign(outside_along / distance, along)
        normal_across = math.copysign(outside_across / distance, across)
    elif outside_along > outside_across:
        distance, normal_along, normal_across = outside_along, math.copysign(1.0, along), 0.0
    else:
        distance, normal_along, normal_across = outside_across, 0.0, math.copysign(1.0, across)
    return c * normal_along - s * normal_across, s * normal_along + c * normal_across, distance


@compilable
def direction(robot: PlanarRobot) -> tuple[float, float]:
    """Return cosine and sine of the heading."""
    last, heading = robot.last_step, robot.joints[HEADING]
    if heading == last[END_HEADING]:
        return last[END_COSINE], last[END_SINE]
    return math.cos(heading), math.sin(heading)


@compilable
def set_heading(robot: PlanarRobot, heading: float, cosine: float, sine: float) -> None:
    """Set the heading at the end of a step [rad], and its cosine and sine, which are normalised."""
    last, scale = robot.last_step, 1.5 - 0.5 * (cosine * cosine + sine * sine)
    robot.joints[HEADING] = last[END_HEADING] = heading
    last[END_COSINE], last[END_SINE] = cosine * scale, sine * scale


@compilable
def turn_vector(angle: float) -> tuple[float, float]:
    """Return cosine and sine of the turn in a substep [rad]; double precision up to a tenth of a radian."""
    # Multiplications, as divisions take several times as long.
    square = angle * angle
    cosine = 1 - square / 2 * (1 - square * (1 / 12) * (1 - square * (1 / 30) * (1 - square * (1 / 56))))
    sine = 1 - square * (1 / 6) * (1 - square * (1 / 20) * (1 - square * (1 / 42) * (1 - square * (1 / 72))))
    return cosine, angle * sine
