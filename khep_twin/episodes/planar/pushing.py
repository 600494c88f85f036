"""Movable obstacles of a plane: friction on the floor, and contacts with all others, by impulses.

A movable obstacle slides upright. The floor's friction holds it up to a force F and a torque T about its
centre, which limit each other as in an ellipse: (f / F)^2 + (t / T)^2 <= 1; T is F times the distance of its
rim or corners from the centre, where MuJoCo has its contacts. Contacts of boxes are at their corners.
`contact_solver` solves what the robot pushes together with these impulses, in the same rounds; velocities and
normals have the axes of the robot meanwhile.

Left out: tipping over, so that only what does not tip may be movable; contacts where boxes cross without a
corner in each other.
"""

import math

from khep_twin.compilable import compilable
from khep_twin.episodes.planar import plane as flat
from khep_twin.episodes.planar.plane import (
    ACTIVE,
    BODY,
    CENTRE_X,
    CENTRE_Y,
    COSINE,
    FLOOR_X,
    FLOOR_Y,
    FRICTION,
    GRIP,
    LENGTH,
    OTHER,
    SINE,
    SPEED_X,
    SPEED_Y,
    SPIN,
    THING,
    TOUCHED,
    TWIST,
    TWISTING,
    WIDTH,
    Plane,
)

_MARGIN = 2e-4
"""Distance within which obstacles touch [m]."""

_RESTS = 1e-4
"""Speed below which a movable obstacle that nothing touches comes to rest [m/s, and rad/s over 0.1 m]."""

_PUSHED_APART = 0.2
"""Part of an overlap that a substep takes away (assumed)."""


@compilable
def begin(plane: Plane, cosine: float, sine: float) -> int:
    """Begin a substep with these axes: turn velocities and find contacts; return their number."""
    bodies, things, count = plane.bodies, plane.things, 0
    for body in range(len(bodies)):
        _turn(plane, body, cosine, -sine)
        bodies[body, FLOOR_X] = bodies[body, FLOOR_Y] = bodies[body, TWISTING] = 0.0
    for body in range(len(bodies)):
        if not bodies[body, ACTIVE]:
            continue
        thing = int(bodies[body, THING])
        for other in range(len(things)):
            if other == thing or not things[other, TOUCHED]:
                continue
            second = int(things[other, BODY])
            if second >= 0 and second < body and bodies[second, ACTIVE]:
                continue  # found already, the other way round
            dx = things[other, CENTRE_X] - things[thing, CENTRE_X]
            dy = things[other, CENTRE_Y] - things[thing, CENTRE_Y]
            apart = _size(plane, thing) + _size(plane, other) + _MARGIN
            if dx * dx + dy * dy <= apart * apart:
                count = _touch(plane, count, thing, other, cosine, sine)
    return count


@compilable
def end(plane: Plane, cosine: float, sine: float) -> bool:
    """End a substep: move the obstacles; return whether any of them moves."""
    bodies, things, h, moves = plane.bodies, plane.things, plane.robot.substep, False
    for body in range(len(bodies)):
        _turn(plane, body, cosine, sine)
        if not bodies[body, ACTIVE]:
            continue
        thing = int(bodies[body, THING])
        x, y, spin = _speeds(plane, body)
        things[thing, CENTRE_X] += h * x
        things[thing, CENTRE_Y] += h * y
        c, s = things[thing, COSINE], things[thing, SINE]
        turn_c, turn_s = flat.turned(h * spin)
        c, s = c * turn_c - s * turn_s, s * turn_c + c * turn_s
        scale = 1.5 - 0.5 * (c * c + s * s)
        things[thing, COSINE], things[thing, SINE] = c * scale, s * scale
        if abs(x) + abs(y) + 0.1 * abs(spin) > _RESTS:
            moves = True
        else:
            bodies[body, SPEED_X] = bodies[body, SPEED_Y] = bodies[body, SPIN] = bodies[body, ACTIVE] = 0.0
    return moves


@compilable
def hold(plane: Plane, count: int) -> float:
    """Run one round of the floor and of `count` contacts; return the change of their impulses [N s]."""
    changed, bodies = 0.0, plane.bodies
    for body in range(len(bodies)):
        if bodies[body, ACTIVE]:
            changed += _rub(plane, body)
    for i in range(count):
        changed += _part(plane, i)
    return changed


@compilable
def masses(plane: Plane, body: int) -> tuple[float, float]:
    """Return the inverse mass and inertia of a body [1/kg, 1/(kg m^2)]; 0 for an index below 0."""
    if body < 0:
        return 0.0, 0.0
    return plane.bodies[body, flat.INVERSE_MASS], plane.bodies[body, flat.INVERSE_INERTIA]


@compilable
def speed_at(plane: Plane, body: int, x: float, y: float) -> tuple[float, float]:
    """Return the velocity of a body's point [m] from its centre; 0 for an index below 0 [m/s]."""
    if body < 0:
        return 0.0, 0.0
    speed_x, speed_y, spin = _speeds(plane, body)
    return speed_x - spin * y, speed_y + spin * x


@compilable
def push(plane: Plane, body: int, x: float, y: float, impulse_x: float, impulse_y: float) -> None:
    """Apply an impulse [N s] to a body's point [m] from its centre; nothing for an index below 0."""
    if body < 0:
        return
    bodies = plane.bodies
    inv_mass, inv_inertia = masses(plane, body)
    bodies[body, SPEED_X] += impulse_x * inv_mass
    bodies[body, SPEED_Y] += impulse_y * inv_mass
    bodies[body, SPIN] += (x * impulse_y - y * impulse_x) * inv_inertia


@compilable
def gap_for(away: float) -> float:
    """Return the gap that a contact may close within a substep, for surfaces so far apart [m]."""
    return away if away >= 0 else _PUSHED_APART * away


@compilable
def _speeds(plane: Plane, body: int) -> tuple[float, float, float]:
    bodies = plane.bodies
    return bodies[body, SPEED_X], bodies[body, SPEED_Y], bodies[body, SPIN]


@compilable
def _turn(plane: Plane, body: int, cosine: float, sine: float) -> None:
    """Turn the axes of a body's velocity."""
    x, y, _ = _speeds(plane, body)
    plane.bodies[body, SPEED_X], plane.bodies[body, SPEED_Y] = x * cosine - y * sine, x * sine + y * cosine


@compilable
def _size(plane: Plane, thing: int) -> float:
    """Return the distance of an obstacle's farthest point from its centre [m]."""
    length, width = plane.things[thing, LENGTH], plane.things[thing, WIDTH]
    return length if width < 0 else math.sqrt(length * length + width * width)


@compilable
def _rub(plane: Plane, body: int) -> float:
    """Run one round of the floor's friction on a body; return the change of its impulse [N s]."""
    bodies, h = plane.bodies, plane.robot.substep
    inv_mass, inv_inertia = masses(plane, body)
    x, y, spin = _speeds(plane, body)
    along, aside = bodies[body, FLOOR_X] - x / inv_mass, bodies[body, FLOOR_Y] - y / inv_mass
    twisting = bodies[body, TWISTING] - spin / inv_inertia
    most, twist = bodies[body, GRIP] * h, bodies[body, TWIST] * h
    share = math.sqrt((along * along + aside * aside) / (most * most) + twisting * twisting / (twist * twist))
    if share > 1:
        along, aside, twisting = along / share, aside / share, twisting / share
    change_x, change_y = along - bodies[body, FLOOR_X], aside - bodies[body, FLOOR_Y]
    bodies[body, SPEED_X] += change_x * inv_mass
    bodies[body, SPEED_Y] += change_y * inv_mass
    bodies[body, SPIN] += (twisting - bodies[body, TWISTING]) * inv_inertia
    bodies[body, FLOOR_X], bodies[body, FLOOR_Y], bodies[body, TWISTING] = along, aside, twisting
    return abs(change_x) + abs(change_y)


@compilable
def _part(plane: Plane, i: int) -> float:
    """Run one round of a contact of two obstacles; return the change of its impulses [N s]."""
    bodies, touches, h = plane.bodies, plane.touches, plane.robot.substep
    one, other = int(touches[i, 0]), int(touches[i, OTHER])
    nx, ny, gap = touches[i, 2], touches[i, 3], touches[i, 4]
    x, y, other_x, other_y = touches[i, 5], touches[i, 6], touches[i, 7], touches[i, 8]
    mass, inertia = masses(plane, one)
    other_mass, other_inertia = masses(plane, other)
    friction, changed = bodies[max(one, other), FRICTION], 0.0
    for tangent in range(1, -1, -1):
        ax, ay = (-ny, nx) if tangent else (nx, ny)
        arm, other_arm = x * ay - y * ax, other_x * ay - other_y * ax
        inverse = mass + other_mass + arm * arm * inertia + other_arm * other_arm * other_inertia
        speed_x, speed_y = speed_at(plane, one, x, y)
        from_x, from_y = speed_at(plane, other, other_x, other_y)
        speed, before = (speed_x - from_x) * ax + (speed_y - from_y) * ay, touches[i, 9 + tangent]
        if tangent:
            most = friction * touches[i, 9]
            after = min(max(before - speed / inverse, -most), most)
        else:
            after = max(before - (speed + gap / h) / inverse, 0.0)
        touches[i, 9 + tangent], change = after, after - before
        push(plane, one, x, y, change * ax, change * ay)
        push(plane, other, other_x, other_y, -change * ax, -change * ay)
        changed += abs(change)
    return changed


@compilable
def _touch(plane: Plane, count: int, thing: int, other: int, cosine: float, sine: float) -> int:
    """Add the contacts of two obstacles; return the number of contacts."""
    things = plane.things
    if things[thing, WIDTH] < 0:
        return _add(plane, count, thing, other, 0.0, 0.0, things[thing, LENGTH], (cosine, sine))
    if things[other, WIDTH] < 0:
        return _add(plane, count, other, thing, 0.0, 0.0, things[other, LENGTH], (cosine, sine))
    for turn in range(2):
        corners, faces = (thing, other) if turn == 0 else (other, thing)
        c, s = things[corners, COSINE], things[corners, SINE]
        for corner in range(4):
            along = things[corners, LENGTH] * (1 if corner & 1 else -1)
            across = things[corners, WIDTH] * (1 if corner & 2 else -1)
            dx, dy = along * c - across * s, along * s + across * c
            count = _add(plane, count, corners, faces, dx, dy, 0.0, (cosine, sine))
    return count


@compilable
def _add(
    plane: Plane,
    count: int,
    thing: int,
    other: int,
    dx: float,
    dy: float,
    radius: float,
    axes: tuple[float, float],
) -> int:
    """Add the contact of an obstacle's disc, at a place from its centre [m], with another one."""
    things, touches = plane.things, plane.touches
    c, s = axes
    x, y = things[thing, CENTRE_X] + dx, things[thing, CENTRE_Y] + dy
    nx, ny, away = flat.nearest(things, other, x, y)
    if away - radius > _MARGIN or count == len(touches):
        return count
    one, second = int(things[thing, BODY]), int(things[other, BODY])
    for body in (one, second):
        if body >= 0:
            plane.bodies[body, ACTIVE] = 1.0
    dx, dy = dx - radius * nx, dy - radius * ny
    from_x = things[thing, CENTRE_X] + dx - things[other, CENTRE_X]
    from_y = things[thing, CENTRE_Y] + dy - things[other, CENTRE_Y]
    touches[count, 0], touches[count, OTHER] = one, second
    touches[count, 2], touches[count, 3] = c * nx + s * ny, c * ny - s * nx
    touches[count, 4] = gap_for(away - radius)
    touches[count, 5], touches[count, 6] = c * dx + s * dy, c * dy - s * dx
    touches[count, 7], touches[count, 8] = c * from_x + s * from_y, c * from_y - s * from_x
    touches[count, 9] = touches[count, 10] = 0.0
    return count + 1
