"""Contact impulses by warm-started projected Gauss-Seidel: tyres that slip, gears that hold, obstacles.

A tyre slips beyond its share of friction x load, along or across; the load that a pitching moment puts on a
support is taken off the tyres. A gear's dry friction holds its wheel up to its torque. Obstacles push along
the line to the disc's centre, with friction across. All impulses of a substep are solved together, in
repeated rounds, with those of movable obstacles (`pushing`).

Left out: tilt, hopping tyres, soft contacts.
"""

import math

from khep_twin.compilable import compilable
from khep_twin.episodes.planar import plane as flat
from khep_twin.episodes.planar import pushing
from khep_twin.episodes.planar.plane import (
    ACROSS,
    ACTIVE,
    ALONG,
    ANCHOR_X,
    ANCHOR_Y,
    ASIDE,
    BODY,
    CENTRE_X,
    CENTRE_Y,
    DISTANCE,
    GEAR,
    HEADING,
    HEADING_COSINE,
    HEADING_SINE,
    LEFT_ANGLE,
    PUSHED,
    PUSHED_ASIDE,
    RIGHT_ANGLE,
    SLIPS,
    TOUCHED,
    PlanarRobot,
    Plane,
    X,
    Y,
)

_ROUNDS = 8
"""Most rounds of the solver in each 2.5 ms; it starts from the last impulses."""

_SETTLED = 2e-5
"""Change of speed in a round below which the solver stops [m/s]."""

_GRIPS = 1e-5
"""Slip below which a tyre counts as gripping [m/s]."""

STANDS = 1e-5
"""Speed of a tyre below which its gear may hold the wheel [m/s]."""

_NEAR = 1e-4
"""Distance within which an obstacle counts as touched [m]."""

_PASSES = 4
"""Passes that push the disc out of obstacles one by one; between two obstacles it takes several."""


_Motion = tuple[float, float, float, float, float]
"""Speeds forwards and to the left [m/s], of rotation [rad/s], and of the left and right tyre [m/s]."""

_Rates = tuple[float, float, float, float, float, float, float]
"""Half of the track [m], inverse mass and inertia, effective masses of a tyre and of a touch, a tyre's speed
per impulse, and the part of the lag behind the free speed left after a substep."""


@compilable
def slide(plane: Plane) -> None:
    """Advance by one step in which tyres may slip and obstacles may push."""
    robot = plane.robot
    joints, speeds, grips, h = robot.joints, robot.speeds, robot.grips, robot.substep
    x, y, heading = joints[X], joints[Y], joints[HEADING]
    forward, lateral, spin = speeds[0], speeds[1], speeds[2]
    left, right = robot.left_wheel * speeds[LEFT_ANGLE], robot.right_wheel * speeds[RIGHT_ANGLE]
    rates = _rates(robot)
    half = rates[0]
    slips = touches = False
    c, s = robot.last[HEADING_COSINE], robot.last[HEADING_SINE]
    for _ in range(robot.n_substeps):
        reach = robot.radius + h * (abs(forward) + abs(lateral)) + _NEAR
        count = _gather(plane, x, y, c, s, reach)
        n_touches = pushing.begin(plane, c, s)
        forward, lateral, spin, left, right = _solve(
            plane, count, n_touches, rates, (forward, lateral, spin, left, right)
        )
        moves = pushing.end(plane, c, s)
        x += h * (forward * c - lateral * s)
        y += h * (forward * s + lateral * c)
        joints[LEFT_ANGLE] += h * left / robot.left_wheel
        joints[RIGHT_ANGLE] += h * right / robot.right_wheel
        turn = h * spin
        heading += turn
        slip = abs(forward - half * spin - left) + abs(forward + half * spin - right) + abs(lateral)
        slips = count > 0 or slip > _GRIPS or moves
        # The body's velocity is constant in space while the body turns.
        turn_c, turn_s = flat.turned(turn)
        c, s = c * turn_c - s * turn_s, s * turn_c + c * turn_s
        forward, lateral = forward * turn_c + lateral * turn_s, lateral * turn_c - forward * turn_s
        touches = touches or count > 0
    if touches:
        x, y = _out(plane, x, y)
    joints[X], joints[Y] = x, y
    flat.end(robot, heading, c, s)
    speeds[0], speeds[1], speeds[2] = forward, lateral, spin
    speeds[LEFT_ANGLE], speeds[RIGHT_ANGLE] = left / robot.left_wheel, right / robot.right_wheel
    robot.last[SLIPS] = 1.0 if slips else 0.0
    if not slips:
        for i in range(len(grips)):
            grips[i] = 0.0


@compilable
def _rates(robot: PlanarRobot) -> _Rates:
    half, inv_mass, inv_inertia = robot.track / 2, 1 / robot.mass, 1 / robot.inertia
    effective_mass = robot.spin + robot.substep * robot.damping
    rim = robot.wheel * robot.wheel / effective_mass
    tyre = 1 / (inv_mass + half * half * inv_inertia + rim)
    friction_impulse = 1 / (inv_mass + robot.radius * robot.radius * inv_inertia)
    return half, inv_mass, inv_inertia, tyre, friction_impulse, rim, robot.spin / effective_mass


@compilable
def _solve(plane: Plane, count: int, n_touches: int, rates: _Rates, motion: _Motion) -> _Motion:
    """Return the motion after a substep's impulses, of the tyres and of all contacts.

    Args:
        plane: Plane.
        count: Number of contacts of the robot.
        n_touches: Number of contacts of movable obstacles with others.
        rates: Constants of a substep.
        motion: Motion so far.
    """
    robot, things, grips = plane.robot, plane.things, plane.robot.grips
    half, inv_mass, inv_inertia, _, _, rim, lag = rates
    forward, lateral, spin, left, right = motion
    for side in range(2):
        speed = motion[3 + side]
        if abs(speed) > STANDS:
            grips[GEAR + side] = math.copysign(robot.gear * robot.substep, speed)
    left += (robot.left_free_speed * robot.ctrl[0] - left) * (1 - lag)
    right += (robot.right_free_speed * robot.ctrl[1] - right) * (1 - lag)
    grips[PUSHED] = grips[PUSHED_ASIDE] = 0.0
    for i in range(count):
        thing = int(robot.contacts[i, 3])
        along, across = things[thing, ALONG], things[thing, ACROSS]
        nx, ny = robot.contacts[i, 0], robot.contacts[i, 1]
        grips[PUSHED] += along * nx - across * ny
        grips[PUSHED_ASIDE] += along * ny + across * nx
        spin -= across * robot.radius * inv_inertia
        place_x, place_y = robot.contacts[i, 4], robot.contacts[i, 5]
        x, y = across * ny - along * nx, -across * nx - along * ny
        pushing.push(plane, int(things[thing, BODY]), place_x, place_y, x, y)
    forward += (grips[0] + grips[1] + grips[PUSHED]) * inv_mass
    lateral += (grips[ASIDE] + grips[ASIDE + 1] + grips[PUSHED_ASIDE]) * inv_mass
    spin += (grips[1] - grips[0]) * half * inv_inertia
    left -= (grips[0] + grips[GEAR]) * rim
    right -= (grips[1] + grips[GEAR + 1]) * rim
    motion = forward, lateral, spin, left, right
    for _ in range(_ROUNDS):
        # Pitching loads a support instead of the tyres, rolling one tyre instead of the other.
        pitching = robot.lean * robot.substep - robot.low * grips[PUSHED]
        pitching += robot.high * (grips[0] + grips[1] + grips[PUSHED])
        rolling = robot.high * (grips[ASIDE] + grips[ASIDE + 1] + grips[PUSHED_ASIDE])
        rolling = (rolling - robot.low * grips[PUSHED_ASIDE]) * robot.shift
        most = robot.grip * robot.substep - robot.relief * abs(pitching)
        motion, changed = _hold(robot, rates, motion, 0, max(most - rolling, 0.0) * robot.left_hold)
        motion, more = _hold(robot, rates, motion, 1, max(most + rolling, 0.0) * robot.right_hold)
        motion, changed = _push(plane, count, rates, motion, changed + more)
        changed += pushing.hold(plane, n_touches)
        if changed * inv_mass < _SETTLED:
            break
    return motion


@compilable
def _hold(
    robot: PlanarRobot, rates: _Rates, motion: _Motion, side: int, most: float
) -> tuple[_Motion, float]:
    """Return the motion after one round of a tyre and its gear, and the change of their impulses [N s].

    Args:
        robot: Robot.
        rates: Constants of a substep.
        motion: Motion so far.
        side: 0 for the left tyre, 1 for the right one.
        most: Largest impulse of the tyre, along and aside together [N s].
    """
    half, inv_mass, inv_inertia, tyre, _, rim, _ = rates
    forward, lateral, spin, left, right = motion
    grips, rubs = robot.grips, robot.gear * robot.substep
    arm, speed = (-half, left) if side == 0 else (half, right)
    rub = min(max(grips[GEAR + side] + speed / rim, -rubs), rubs)
    change = rub - grips[GEAR + side]
    speed -= change * rim
    changed = abs(change)
    slip = forward + arm * spin - speed
    along, aside = grips[side] - slip * tyre, grips[ASIDE + side] - lateral * robot.mass
    if along * along + aside * aside > most * most:
        # One scale for both: where it slips, the force is against the slip.
        aside = grips[ASIDE + side] - lateral * tyre
        part = most / max(math.sqrt(along * along + aside * aside), most)
        along, aside = along * part, aside * part
    change, change_aside = along - grips[side], aside - grips[ASIDE + side]
    grips[side], grips[ASIDE + side], grips[GEAR + side] = along, aside, rub
    forward += change * inv_mass
    lateral += change_aside * inv_mass
    spin += change * arm * inv_inertia
    speed -= change * rim
    if side == 0:
        left = speed
    else:
        right = speed
    return (forward, lateral, spin, left, right), changed + abs(change) + abs(change_aside)


@compilable
def _push(plane: Plane, count: int, rates: _Rates, motion: _Motion, changed: float) -> tuple[_Motion, float]:
    """Return the motion after one round of the contacts, and `changed` with the change of theirs [N s]."""
    robot, things, h = plane.robot, plane.things, plane.robot.substep
    _, inv_mass, inv_inertia, _, friction_impulse, _, _ = rates
    forward, lateral, spin, left, right = motion
    for i in range(count):
        thing = int(robot.contacts[i, 3])
        nx, ny, gap = robot.contacts[i, 0], robot.contacts[i, 1], robot.contacts[i, 2]
        across, along, body = things[thing, ACROSS], things[thing, ALONG], int(things[thing, BODY])
        place_x, place_y = robot.contacts[i, 4], robot.contacts[i, 5]
        mass, turning = robot.mass, friction_impulse
        if body >= 0:
            inv_body, inv_turn = pushing.masses(plane, body)
            arm, arm_across = place_x * ny - place_y * nx, place_x * nx + place_y * ny
            mass = 1 / (inv_mass + inv_body + arm * arm * inv_turn)
            turning = 1 / (1 / friction_impulse + inv_body + arm_across * arm_across * inv_turn)
        speed_x, speed_y = pushing.speed_at(plane, body, place_x, place_y)
        side, slip = robot.friction * along, (lateral - speed_y) * nx - (forward - speed_x) * ny
        new = min(max(across - (slip - robot.radius * spin) * turning, -side), side)
        things[thing, ACROSS] = new
        change = new - across
        forward -= change * ny * inv_mass
        lateral += change * nx * inv_mass
        spin -= change * robot.radius * inv_inertia
        pushing.push(plane, body, place_x, place_y, change * ny, -change * nx)
        speed_x, speed_y = pushing.speed_at(plane, body, place_x, place_y)
        closing = (forward - speed_x) * nx + (lateral - speed_y) * ny
        new = max(along - (closing + gap / h) * mass, 0.0)
        things[thing, ALONG] = new
        changed += abs(change) + abs(new - along)
        forward += (new - along) * nx * inv_mass
        lateral += (new - along) * ny * inv_mass
        pushing.push(plane, body, place_x, place_y, (along - new) * nx, (along - new) * ny)
        robot.grips[PUSHED] += (new - along) * nx - change * ny
        robot.grips[PUSHED_ASIDE] += (new - along) * ny + change * nx
    return (forward, lateral, spin, left, right), changed


@compilable
def _gather(plane: Plane, x: float, y: float, c: float, s: float, reach: float) -> int:
    """Fill in the contacts within reach of a point [m], normals in the robot's frame; return their number."""
    robot, things, order, count = plane.robot, plane.things, plane.order, 0
    dx, dy = x - robot.last[ANCHOR_X], y - robot.last[ANCHOR_Y]
    moved = math.sqrt(dx * dx + dy * dy)
    for i in range(len(order)):
        if things[order[i], DISTANCE] - moved > reach:
            break
        count = _meet(plane, order[i], (x, y), (c, s), reach, count)
    for thing in range(len(order), len(things)):
        count = _meet(plane, thing, (x, y), (c, s), reach, count)
    return count


@compilable
def _meet(
    plane: Plane, thing: int, at: tuple[float, float], axes: tuple[float, float], reach: float, count: int
) -> int:
    """Add the contact with an obstacle, if it is within reach; return the number of contacts."""
    contacts, things = plane.robot.contacts, plane.things
    if not things[thing, TOUCHED] or count == len(contacts):
        return count
    (x, y), (c, s) = at, axes
    nx, ny, away = flat.nearest(things, thing, x, y)
    if away > reach:
        things[thing, ALONG] = things[thing, ACROSS] = 0.0
        return count
    gap = away - plane.robot.radius
    contacts[count, 0], contacts[count, 1] = c * nx + s * ny, c * ny - s * nx
    contacts[count, 2], contacts[count, 3] = max(gap, 0.0), thing
    body = int(things[thing, BODY])
    if body >= 0:
        plane.bodies[body, ACTIVE] = 1.0
        dx, dy = x - away * nx - things[thing, CENTRE_X], y - away * ny - things[thing, CENTRE_Y]
        contacts[count, 2] = pushing.gap_for(gap)
        contacts[count, 4], contacts[count, 5] = c * dx + s * dy, c * dy - s * dx
    return count + 1


@compilable
def _out(plane: Plane, x: float, y: float) -> tuple[float, float]:
    """Return a position pushed out of all obstacles that the disc overlaps."""
    robot, things = plane.robot, plane.things
    for _ in range(_PASSES):
        dx, dy = x - robot.last[ANCHOR_X], y - robot.last[ANCHOR_Y]
        moved, free = math.sqrt(dx * dx + dy * dy), True
        for i in range(len(plane.order)):
            if things[plane.order[i], DISTANCE] - moved > robot.radius:
                break
            thing = plane.order[i]
            if not things[thing, TOUCHED]:
                continue
            nx, ny, away = flat.nearest(things, thing, x, y)
            if away < robot.radius:
                x += (robot.radius - away) * nx
                y += (robot.radius - away) * ny
                free = False
        if free:
            break
    return x, y
