"""Contact impulses by warm-started projected Gauss-Seidel: tyres that slip, gears that hold, obstacles.

A tyre slips if its force, along and across, exceeds friction times load. A pitching moment shifts load from
the tyres to a support. A gear's dry friction holds its wheel up to its torque. Obstacles push along the line
to the robot's centre, with friction across. Each iteration updates all impulses of a substep, including those
of movable obstacles (`pushing`), starting from those of the previous substep (warm start).

Not modelled: tilt, hopping tyres, soft contacts.
"""

import math

from khep_twin.compilable import compilable
from khep_twin.episodes.planar import plane as planar
from khep_twin.episodes.planar import pushing
from khep_twin.episodes.planar.plane import (
    ASIDE,
    GEARS,
    LEFT_ANGLE,
    NORMAL_IMPULSE,
    PUSHED,
    PUSHED_ASIDE,
    RIGHT_ANGLE,
    TANGENT_IMPULSE,
    PlanarRobot,
    Plane,
    X,
    Y,
)

_MAX_ITERATIONS = 8
"""Largest number of iterations in a substep of 2.5 ms."""

_TOLERANCE = 2e-5
"""Change of speed in an iteration below which the solver stops [m/s]."""

_GRIP_SLIP = 1e-5
"""Slip speed below which a tyre counts as gripping [m/s]."""

STOP_SPEED = 1e-5
"""Speed of a tyre below which the gear may hold its wheel [m/s]."""

_CONTACT_MARGIN = 1e-4
"""Distance below which the robot is in contact with an obstacle [m]."""

_MAX_PASSES = 4
"""Passes that push the disc out of obstacles one by one; a disc between two obstacles needs several."""

_Motion = tuple[float, float, float, float, float]
"""Speeds forwards and to the left [m/s], of rotation [rad/s], and of the left and right tyre [m/s]."""

_Update = tuple[_Motion, float]
"""Motion after an iteration, and the change of the impulses in it [N s]."""

_Constants = tuple[float, float, float, float, float, float, float]
"""Half of the track [m]; inverse mass and inertia; effective masses of a tyre and of a contact's friction;
inverse mass of a wheel at its rim; factor by which a substep reduces the lag behind the free speed."""


@compilable
def step_with_slip(plane: Plane) -> None:
    """Advance by one step in which tyres may slip and obstacles may push."""
    robot = plane.robot
    joints, speeds, impulses, h = robot.joints, robot.speeds, robot.impulses, robot.substep
    x, y, heading = joints[X], joints[Y], joints[planar.HEADING]
    forward, lateral, spin = speeds[0], speeds[1], speeds[2]
    left, right = (robot.left_wheel * speeds[LEFT_ANGLE], robot.right_wheel * speeds[RIGHT_ANGLE])
    constants = _substep_constants(robot)
    half = constants[0]
    slips = is_pushed = False
    c, s = robot.last_step[planar.HEADING_COSINE], robot.last_step[planar.HEADING_SINE]
    for _ in range(robot.n_substeps):
        reach = robot.radius + h * (abs(forward) + abs(lateral)) + _CONTACT_MARGIN
        n_contacts = _find_contacts(plane, x, y, c, s, reach)
        n_obstacle_contacts = pushing.start_substep(plane, c, s)
        forward, lateral, spin, left, right = _solve_substep(
            plane, n_contacts, n_obstacle_contacts, constants, (forward, lateral, spin, left, right)
        )
        obstacles_move = pushing.end_substep(plane, c, s)
        x += h * (forward * c - lateral * s)
        y += h * (forward * s + lateral * c)
        joints[LEFT_ANGLE] += h * left / robot.left_wheel
        joints[RIGHT_ANGLE] += h * right / robot.right_wheel
        turn = h * spin
        heading += turn
        slip = abs(forward - half * spin - left) + abs(forward + half * spin - right) + abs(lateral)
        slips = n_contacts > 0 or slip > _GRIP_SLIP or obstacles_move
        # The body's velocity is constant in space while the body turns.
        turn_c, turn_s = planar.turn_vector(turn)
        c, s = c * turn_c - s * turn_s, s * turn_c + c * turn_s
        forward, lateral = forward * turn_c + lateral * turn_s, lateral * turn_c - forward * turn_s
        is_pushed = is_pushed or n_contacts > 0
    if is_pushed:
        x, y = _push_out(plane, x, y)
    joints[X], joints[Y] = x, y
    planar.set_heading(robot, heading, c, s)
    speeds[0], speeds[1], speeds[2] = forward, lateral, spin
    speeds[LEFT_ANGLE], speeds[RIGHT_ANGLE] = (left / robot.left_wheel, right / robot.right_wheel)
    robot.last_step[planar.SLIPS] = 1.0 if slips else 0.0
    if not slips:
        for i in range(len(impulses)):
            impulses[i] = 0.0


@compilable
def _substep_constants(robot: PlanarRobot) -> _Constants:
    half_track, inv_mass, inv_inertia = robot.track / 2, 1 / robot.mass, 1 / robot.inertia
    effective_mass = robot.wheel_inertia + robot.substep * robot.damping
    inv_rim_mass = robot.wheel_radius * robot.wheel_radius / effective_mass
    tyre_mass = 1 / (inv_mass + half_track * half_track * inv_inertia + inv_rim_mass)
    friction_mass = 1 / (inv_mass + robot.radius * robot.radius * inv_inertia)
    decay = robot.wheel_inertia / effective_mass
    return half_track, inv_mass, inv_inertia, tyre_mass, friction_mass, inv_rim_mass, decay


@compilable
def _solve_substep(
    plane: Plane, n_contacts: int, n_obstacle_contacts: int, constants: _Constants, motion: _Motion
) -> _Motion:
    """Return the motion after the impulses of a substep, those of the tyres and of all contacts.

    Args:
        plane: Plane.
        n_contacts: Number of contacts of the robot.
        n_obstacle_contacts: Number of contacts of movable obstacles with others.
        constants: Constants of a substep.
        motion: Motion so far.
    """
    robot, obstacles, impulses = plane.robot, plane.obstacles, plane.robot.impulses
    half_track, inv_mass, inv_inertia, _, _, inv_rim_mass, decay = constants
    forward, lateral, spin, left, right = motion
    for side in range(2):
        speed = motion[3 + side]
        if abs(speed) > STOP_SPEED:
            impulses[GEARS + side] = math.copysign(robot.gear_friction * robot.substep, speed)
    left += (robot.left_free_speed * robot.ctrl[0] - left) * (1 - decay)
    right += (robot.right_free_speed * robot.ctrl[1] - right) * (1 - decay)
    impulses[PUSHED] = impulses[PUSHED_ASIDE] = 0.0
    for i in range(n_contacts):
        obstacle = int(robot.contacts[i, 3])
        along, across = obstacles[obstacle, NORMAL_IMPULSE], obstacles[obstacle, TANGENT_IMPULSE]
        nx, ny = robot.contacts[i, 0], robot.contacts[i, 1]
        impulses[PUSHED] += along * nx - across * ny
        impulses[PUSHED_ASIDE] += along * ny + across * nx
        spin -= across * robot.radius * inv_inertia
        contact_x, contact_y = robot.contacts[i, 4], robot.contacts[i, 5]
        x, y = across * ny - along * nx, -across * nx - along * ny
        pushing.apply_impulse(plane, int(obstacles[obstacle, planar.BODY]), contact_x, contact_y, x, y)
    forward += (impulses[0] + impulses[1] + impulses[PUSHED]) * inv_mass
    lateral += (impulses[ASIDE] + impulses[ASIDE + 1] + impulses[PUSHED_ASIDE]) * inv_mass
    spin += (impulses[1] - impulses[0]) * half_track * inv_inertia
    left -= (impulses[0] + impulses[GEARS]) * inv_rim_mass
    right -= (impulses[1] + impulses[GEARS + 1]) * inv_rim_mass
    motion = forward, lateral, spin, left, right
    for _ in range(_MAX_ITERATIONS):
        # Pitching shifts load from the tyres to a support, rolling from one tyre to the other.
        pitch_moment = robot.weight_moment * robot.substep - robot.push_height * impulses[PUSHED]
        pitch_moment += robot.pitch_arm * (impulses[0] + impulses[1] + impulses[PUSHED])
        roll_shift = robot.pitch_arm * (impulses[ASIDE] + impulses[ASIDE + 1] + impulses[PUSHED_ASIDE])
        roll_shift = (roll_shift - robot.push_height * impulses[PUSHED_ASIDE]) * robot.roll_shift
        max_impulse = robot.tyre_force * robot.substep - robot.pitch_relief * abs(pitch_moment)
        left_limit = max(max_impulse - roll_shift, 0.0) * robot.left_grip
        right_limit = max(max_impulse + roll_shift, 0.0) * robot.right_grip
        motion, left_change = _solve_tyre(robot, constants, motion, 0, left_limit)
        motion, right_change = _solve_tyre(robot, constants, motion, 1, right_limit)
        motion, change = _solve_contacts(plane, n_contacts, constants, motion, left_change + right_change)
        change += pushing.solve_iteration(plane, n_obstacle_contacts)
        if change * inv_mass < _TOLERANCE:
            break
    return motion


@compilable
def _solve_tyre(
    robot: PlanarRobot, constants: _Constants, motion: _Motion, side: int, max_impulse: float
) -> _Update:
    """Return the motion after one iteration of a tyre and its gear, and the change of their impulses [N s].

    Args:
        robot: Robot.
        constants: Constants of a substep.
        motion: Motion so far.
        side: 0 for the left tyre, 1 for the right one.
        max_impulse: Largest magnitude of the tyre's impulse [N s].
    """
    half_track, inv_mass, inv_inertia, tyre_mass, _, inv_rim_mass, _ = constants
    forward, lateral, spin, left, right = motion
    impulses, max_gear = robot.impulses, robot.gear_friction * robot.substep
    arm, speed = (-half_track, left) if side == 0 else (half_track, right)
    gear = min(max(impulses[GEARS + side] + speed / inv_rim_mass, -max_gear), max_gear)
    change = gear - impulses[GEARS + side]
    speed -= change * inv_rim_mass
    gear_change = abs(change)
    slip = forward + arm * spin - speed
    along, aside = impulses[side] - slip * tyre_mass, impulses[ASIDE + side] - lateral * robot.mass
    if along * along + aside * aside > max_impulse * max_impulse:
        # One scale for both: the force of a slipping tyre opposes the slip.
        aside = impulses[ASIDE + side] - lateral * tyre_mass
        scale = max_impulse / max(math.sqrt(along * along + aside * aside), max_impulse)
        along, aside = along * scale, aside * scale
    change, change_aside = along - impulses[side], aside - impulses[ASIDE + side]
    impulses[side], impulses[ASIDE + side], impulses[GEARS + side] = along, aside, gear
    forward += change * inv_mass
    lateral += change_aside * inv_mass
    spin += change * arm * inv_inertia
    speed -= change * inv_rim_mass
    if side == 0:
        left = speed
    else:
        right = speed
    return (forward, lateral, spin, left, right), gear_change + abs(change) + abs(change_aside)


@compilable
def _solve_contacts(
    plane: Plane, n_contacts: int, constants: _Constants, motion: _Motion, impulse_change: float
) -> _Update:
    """Return the motion after one iteration of the contacts, and `impulse_change` plus their change [N s]."""
    robot, obstacles, h = plane.robot, plane.obstacles, plane.robot.substep
    _, inv_mass, inv_inertia, _, friction_mass, _, _ = constants
    forward, lateral, spin, left, right = motion
    for i in range(n_contacts):
        obstacle = int(robot.contacts[i, 3])
        nx, ny, gap = robot.contacts[i, 0], robot.contacts[i, 1], robot.contacts[i, 2]
        across, along = obstacles[obstacle, TANGENT_IMPULSE], obstacles[obstacle, NORMAL_IMPULSE]
        body = int(obstacles[obstacle, planar.BODY])
        contact_x, contact_y = robot.contacts[i, 4], robot.contacts[i, 5]
        normal_mass, tangent_mass = robot.mass, friction_mass
        if body >= 0:
            inv_body, inv_turn = pushing.inverse_masses(plane, body)
            arm, arm_across = contact_x * ny - contact_y * nx, contact_x * nx + contact_y * ny
            normal_mass = 1 / (inv_mass + inv_body + arm * arm * inv_turn)
            tangent_mass = 1 / (1 / friction_mass + inv_body + arm_across * arm_across * inv_turn)
        speed_x, speed_y = pushing.speed_at(plane, body, contact_x, contact_y)
        limit, slip = robot.friction * along, (lateral - speed_y) * nx - (forward - speed_x) * ny
        impulse = min(max(across - (slip - robot.radius * spin) * tangent_mass, -limit), limit)
        obstacles[obstacle, TANGENT_IMPULSE] = impulse
        change = impulse - across
        forward -= change * ny * inv_mass
        lateral += change * nx * inv_mass
        spin -= change * robot.radius * inv_inertia
        pushing.apply_impulse(plane, body, contact_x, contact_y, change * ny, -change * nx)
        speed_x, speed_y = pushing.speed_at(plane, body, contact_x, contact_y)
        closing = (forward - speed_x) * nx + (lateral - speed_y) * ny
        impulse = max(along - (closing + gap / h) * normal_mass, 0.0)
        obstacles[obstacle, NORMAL_IMPULSE] = impulse
        impulse_change += abs(change) + abs(impulse - along)
        forward += (impulse - along) * nx * inv_mass
        lateral += (impulse - along) * ny * inv_mass
        x, y = (along - impulse) * nx, (along - impulse) * ny
        pushing.apply_impulse(plane, body, contact_x, contact_y, x, y)
        robot.impulses[PUSHED] += (impulse - along) * nx - change * ny
        robot.impulses[PUSHED_ASIDE] += (impulse - along) * ny + change * nx
    return (forward, lateral, spin, left, right), impulse_change


@compilable
def _find_contacts(plane: Plane, x: float, y: float, c: float, s: float, reach: float) -> int:
    """Fill in contacts within `reach` of the robot's centre x, y [m], heading c, s; return their number."""
    robot, obstacles, order, n_contacts = plane.robot, plane.obstacles, plane.fixed_by_distance, 0
    dx, dy = x - robot.last_step[planar.ANCHOR_X], y - robot.last_step[planar.ANCHOR_Y]
    moved = math.sqrt(dx * dx + dy * dy)
    for i in range(len(order)):
        if obstacles[order[i], planar.DISTANCE] - moved > reach:
            break
        n_contacts = _add_contact(plane, order[i], (x, y), (c, s), reach, n_contacts)
    for obstacle in range(len(order), len(obstacles)):
        n_contacts = _add_contact(plane, obstacle, (x, y), (c, s), reach, n_contacts)
    return n_contacts


@compilable
def _add_contact(
    plane: Plane, obstacle: int, centre: planar.Pair, axes: planar.Pair, reach: float, n_contacts: int
) -> int:
    """Add the contact with an obstacle within reach; return the number of contacts."""
    contacts, obstacles = plane.robot.contacts, plane.obstacles
    if not obstacles[obstacle, planar.TOUCHABLE] or n_contacts == len(contacts):
        return n_contacts
    (x, y), (c, s) = centre, axes
    nx, ny, distance = planar.normal_and_distance(obstacles, obstacle, x, y)
    if distance > reach:
        obstacles[obstacle, NORMAL_IMPULSE] = obstacles[obstacle, TANGENT_IMPULSE] = 0.0
        return n_contacts
    gap = distance - plane.robot.radius
    contacts[n_contacts, 0], contacts[n_contacts, 1] = c * nx + s * ny, c * ny - s * nx
    contacts[n_contacts, 2], contacts[n_contacts, 3] = max(gap, 0.0), obstacle
    body = int(obstacles[obstacle, planar.BODY])
    if body >= 0:
        plane.bodies[body, planar.ACTIVE] = 1.0
        dx = x - distance * nx - obstacles[obstacle, planar.CENTRE_X]
        dy = y - distance * ny - obstacles[obstacle, planar.CENTRE_Y]
        contacts[n_contacts, 2] = pushing.substep_gap(gap)
        contacts[n_contacts, 4], contacts[n_contacts, 5] = c * dx + s * dy, c * dy - s * dx
    return n_contacts + 1


@compilable
def _push_out(plane: Plane, x: float, y: float) -> tuple[float, float]:
    """Return a position pushed out of all obstacles that the disc overlaps."""
    robot, obstacles = plane.robot, plane.obstacles
    for _ in range(_MAX_PASSES):
        dx, dy = x - robot.last_step[planar.ANCHOR_X], y - robot.last_step[planar.ANCHOR_Y]
        moved, is_free = math.sqrt(dx * dx + dy * dy), True
        for i in range(len(plane.fixed_by_distance)):
            if obstacles[plane.fixed_by_distance[i], planar.DISTANCE] - moved > robot.radius:
                break
            obstacle = plane.fixed_by_distance[i]
            if not obstacles[obstacle, planar.TOUCHABLE]:
                continue
            nx, ny, distance = planar.normal_and_distance(obstacles, obstacle, x, y)
            if distance < robot.radius:
                x += (robot.radius - distance) * nx
                y += (robot.radius - distance) * ny
                is_free = False
        if is_free:
            break
    return x, y
