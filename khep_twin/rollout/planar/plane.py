"""The plane of screening: a robot's numbers, the things around it, and how far off those are."""

import math
from typing import Any, NamedTuple

CENTRE_X, CENTRE_Y, COSINE, SINE, LENGTH, WIDTH, BOTTOM, TOP = 0, 1, 2, 3, 4, 5, 6, 7
"""Columns of `Plane.things`: centre [m], direction of the length, half of length and width [m], heights [m].
A cylinder has its radius as length, and a width below 0."""

TOUCHED, SEEN, REFLECTANCE, DISTANCE, ALONG, ACROSS = 8, 9, 10, 11, 12, 13
"""More columns: 1 for what the body can touch, 1 for what rays can hit, infrared reflectance, how far it is
from the anchor [m], and how it pushed the body in the last substep, along and across [N s]."""
N_COLUMNS = 14

HEADING_COSINE, HEADING_SINE, MOVED, ANCHOR_X, ANCHOR_Y, SLIPS = 2, 3, 4, 5, 6, 7
"""Places in `Robot.last`, behind CENTRE_X and CENTRE_Y: the pose at the start of the last step, how far off
the anchor that is, the anchor [m], and whether a tyre slips or something is touched."""
N_LAST = 8

X, Y, HEADING, LEFT_ANGLE, RIGHT_ANGLE = 0, 1, 2, 3, 4
"""Places in `Robot.joints` [m, rad]; `Robot.speeds` has the speeds forwards, to the left, of turning, and of
the wheels [m/s, rad/s]."""
N_JOINTS = 5


class Robot(NamedTuple):
    """A robot as the plane has it. Compiled code has a record of the same fields: one address to hand on.

    Attributes:
        substep: of its motion [s].
        n_substeps: in each step.
        radius: of its body [m].
        track: between its wheels [m].
        wheel: their radius [m].
        mass: of the whole robot [kg].
        inertia: likewise, about the vertical axis [kg m^2].
        spin: inertia of a wheel and its rotor [kg m^2].
        stall: torque per voltage of a motor [N m/V].
        damping: torque lost per speed of a wheel [N m s].
        free_speed: of a tyre per voltage, without load [m/s/V].
        going: what is left of the lag behind the free speed after a substep, going straight.
        turning: likewise, turning in place.
        grip: most force of a tyre while the robot does not speed up [N].
        relief: how much of that is lost per acceleration [N s^2/m].
        friction: of the body on things.
        height: of the sensors above the floor [m].
        mounts: x forward, y left, cosine and sine of where it looks, distance from the robot's centre, of
            each sensor (8, 5) [m].
        ways: of all rays in the robot's frame, first x forward of each, then y left (8, 2 n_wide); behind
            the last, up to n_wide, there are some that go nowhere.
        cones: unit vectors across the edges of each sensor's cone, to its inside, right then left (8, 4).
        looks: room for the ways of a sensor's rays in the plane, first all x, then all y (2 n_wide,).
        hits: room for what they hit, four times its number and which of its faces, ahead, behind, left or
            right; below 0 for nothing (n_wide,).
        lengths: room for how far off that is, infinite for nothing (n_wide,) [m].
        shares: room for how much light these send back at most (n_wide,) [1/m^2].
        n_few: of the points of a bulb that are the few.
        points: of a bulb, few and then many (n_points, 2).
        hidden: room for which of these are (n_points,).
        contacts: room for what is touched: normal, way left and which it is (n_contacts, 4).
        joints: N_JOINTS numbers, live.
        speeds: likewise.
        ctrl: voltages (2,) [V].
        force: torques of the motors at the start of the step (2,) [N m].
        grips: push of the tyres in the last substep: left, right, and of both to the left (3,) [N s].
        last: N_LAST numbers.
    """

    substep: float
    n_substeps: int
    radius: float
    track: float
    wheel: float
    mass: float
    inertia: float
    spin: float
    stall: float
    damping: float
    free_speed: float
    going: float
    turning: float
    grip: float
    relief: float
    friction: float
    height: float
    mounts: Any
    ways: Any
    cones: Any
    looks: Any
    hits: Any
    lengths: Any
    shares: Any
    n_few: int
    points: Any
    hidden: Any
    contacts: Any
    joints: Any
    speeds: Any
    ctrl: Any
    force: Any
    grips: Any
    last: Any


class Plane(NamedTuple):
    """Where the robot and all things are.

    Attributes:
        things: that stand around (n, N_COLUMNS).
        order: of the things, nearest to the anchor first (n,).
        robot: with its sensors.
    """

    things: Any
    order: Any
    robot: Robot


def distance_to(things: Any, thing: int, x: float, y: float) -> float:
    """How far a thing is from a place [m], 0 within."""
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


def nearest(things: Any, thing: int, x: float, y: float) -> tuple[float, float, float]:
    """Unit vector from a thing to a place, and how far it is [m]; below 0 within, by the nearest way out."""
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


def turned(angle: float) -> tuple[float, float]:
    """Cosine and sine of a substep's turn [rad], to the last bits of a tenth of a radian."""
    square = angle * angle
    cosine = 1 - square / 2 * (1 - square / 12 * (1 - square / 30 * (1 - square / 56)))
    return cosine, angle * (1 - square / 6 * (1 - square / 20 * (1 - square / 42 * (1 - square / 72))))
