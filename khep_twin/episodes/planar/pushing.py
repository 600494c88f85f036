"""Movable obstacles of a plane: impulses of the floor's friction, and of contacts with all other obstacles.

A movable obstacle slides upright. The floor's friction holds it up to a force F and a torque T about its
centre, which limit each other as in an ellipse: (f / F)^2 + (t / T)^2 <= 1. T is F times the distance of its
rim or corners from the centre, where MuJoCo has its contacts. Contacts of boxes are at their corners.
`contact_solver` iterates over these and the robot's impulses. Within a substep, velocities and normals are in
the robot's frame.

Not modelled: tipping over, so that movable obstacles must be stable; contacts of boxes that cross without a
corner in each other.
"""

import math

from khep_twin.compilable import compilable
from khep_twin.episodes.planar import plane as planar
from khep_twin.episodes.planar.plane import (
    ACTIVE,
    CENTRE_X,
    CENTRE_Y,
    FLOOR_TORQUE,
    FLOOR_X,
    FLOOR_Y,
    HALF_LENGTH,
    HALF_WIDTH,
    SPEED_X,
    SPEED_Y,
    SPIN,
    Pair,
    Plane,
)

_CONTACT_MARGIN = 2e-4
"""Distance below which obstacles are in contact [m]."""

_REST_SPEED = 1e-4
"""Speed below which a movable obstacle sleeps [m/s; rad/s over 0.1 m]: it is at rest until it is touched."""

_SEPARATION_SHARE = 0.2
"""Fraction of a penetration that a substep removes (assumed)."""


@compilable
def start_substep(plane: Plane, cosine: float, sine: float) -> int:
    """Start a substep: rotate velocities into the frame of the robot, find contacts, return their number."""
    bodies, obstacles, n_contacts = plane.bodies, plane.obstacles, 0
    for body in range(len(bodies)):
        _rotate_velocity(plane, body, cosine, -sine)
        bodies[body, FLOOR_X] = bodies[body, FLOOR_Y] = bodies[body, FLOOR_TORQUE] = 0.0
    for body in range(len(bodies)):
        if not bodies[body, ACTIVE]:
            continue
        obstacle = int(bodies[body, planar.OBSTACLE])
        for other in range(len(obstacles)):
            if other == obstacle or not obstacles[other, planar.TOUCHABLE]:
                continue
            other_body = int(obstacles[other, planar.BODY])
            if other_body >= 0 and other_body < body and bodies[other_body, ACTIVE]:
                continue  # already found in the reverse order
            dx = obstacles[other, CENTRE_X] - obstacles[obstacle, CENTRE_X]
            dy = obstacles[other, CENTRE_Y] - obstacles[obstacle, CENTRE_Y]
            reach = _outer_radius(plane, obstacle) + _outer_radius(plane, other) + _CONTACT_MARGIN
            if dx * dx + dy * dy <= reach * reach:
                n_contacts = _add_contacts(plane, n_contacts, obstacle, other, cosine, sine)
    return n_contacts


@compilable
def end_substep(plane: Plane, cosine: float, sine: float) -> bool:
    """End a substep: rotate velocities back to the world, integrate; return whether an obstacle moves."""
    bodies, obstacles, h, any_moves = plane.bodies, plane.obstacles, plane.robot.substep, False
    for body in range(len(bodies)):
        _rotate_velocity(plane, body, cosine, sine)
        if not bodies[body, ACTIVE]:
            continue
        obstacle = int(bodies[body, planar.OBSTACLE])
        x, y, spin = _speeds(plane, body)
        obstacles[obstacle, CENTRE_X] += h * x
        obstacles[obstacle, CENTRE_Y] += h * y
        c, s = obstacles[obstacle, planar.COSINE], obstacles[obstacle, planar.SINE]
        turn_c, turn_s = planar.turn_vector(h * spin)
        c, s = c * turn_c - s * turn_s, s * turn_c + c * turn_s
        scale = 1.5 - 0.5 * (c * c + s * s)
        obstacles[obstacle, planar.COSINE], obstacles[obstacle, planar.SINE] = c * scale, s * scale
        if abs(x) + abs(y) + 0.1 * abs(spin) > _REST_SPEED:
            any_moves = True
        else:
            bodies[body, SPEED_X] = bodies[body, SPEED_Y] = bodies[body, SPIN] = bodies[body, ACTIVE] = 0.0
    return any_moves


@compilable
def solve_iteration(plane: Plane, n_contacts: int) -> float:
    """Iterate once over the floor and `n_contacts` contacts; return the change of their impulses [N s]."""
    impulse_change, bodies = 0.0, plane.bodies
    for body in range(len(bodies)):
        if bodies[body, ACTIVE]:
            impulse_change += _solve_floor(plane, body)
    for i in range(n_contacts):
        impulse_change += _solve_contact(plane, i)
    return impulse_change


@compilable
def inverse_masses(plane: Plane, body: int) -> tuple[float, float]:
    """Return the inverse mass and inertia of a body [1/kg, 1/(kg m^2)]; 0 for an index below 0."""
    if body < 0:
        return 0.0, 0.0
    return plane.bodies[body, planar.INVERSE_MASS], plane.bodies[body, planar.INVERSE_INERTIA]


@compilable
def speed_at(plane: Plane, body: int, x: float, y: float) -> tuple[float, float]:
    """Return the velocity [m/s] of a point of a body, relative to its centre [m]; 0 for an index below 0."""
    if body < 0:
        return 0.0, 0.0
    speed_x, speed_y, spin = _speeds(plane, body)
    return speed_x - spin * y, speed_y + spin * x


@compilable
def apply_impulse(plane: Plane, body: int, x: float, y: float, impulse_x: float, impulse_y: float) -> None:
    """Apply an impulse [N s] to a body, at a point relative to its centre [m]; not for an index below 0."""
    if body < 0:
        return
    bodies = plane.bodies
    inv_mass, inv_inertia = inverse_masses(plane, body)
    bodies[body, SPEED_X] += impulse_x * inv_mass
    bodies[body, SPEED_Y] += impulse_y * inv_mass
    bodies[body, SPIN] += (x * impulse_y - y * impulse_x) * inv_inertia


@compilable
def substep_gap(distance: float) -> float:
    """Return the gap that a contact may close within a substep, from the distance of the surfaces [m]."""
    return distance if distance >= 0 else _SEPARATION_SHARE * distance


@compilable
def _speeds(plane: Plane, body: int) -> tuple[float, float, float]:
    bodies = plane.bodies
    return bodies[body, SPEED_X], bodies[body, SPEED_Y], bodies[body, SPIN]


@compilable
def _rotate_velocity(plane: Plane, body: int, cosine: float, sine: float) -> None:
    """Rotate the velocity of a body."""
    x, y, _ = _speeds(plane, body)
    plane.bodies[body, SPEED_X], plane.bodies[body, SPEED_Y] = x * cosine - y * sine, x * sine + y * cosine


@compilable
def _outer_radius(plane: Plane, obstacle: int) -> float:
    """Return the distance of an obstacle's farthest point from its centre [m]."""
    half_length, half_width = plane.obstacles[obstacle, HALF_LENGTH], plane.obstacles[obstacle, HALF_WIDTH]
    return half_length if half_width < 0 else math.sqrt(half_length * half_length + half_width * half_width)


@compilable
def _solve_floor(plane: Plane, body: int) -> float:
    """Iterate once over the floor's friction on a body; return the change of its impulse [N s]."""
    bodies, h = plane.bodies, plane.robot.substep
    inv_mass, inv_inertia = inverse_masses(plane, body)
    x, y, spin = _speeds(plane, body)
    force_x, force_y = bodies[body, FLOOR_X] - x / inv_mass, bodies[body, FLOOR_Y] - y / inv_mass
    torque = bodies[body, FLOOR_TORQUE] - spin / inv_inertia
    max_force, max_torque = bodies[body, planar.MAX_FORCE] * h, bodies[body, planar.MAX_TORQUE] * h
    force_ratio_square = (force_x * force_x + force_y * force_y) / (max_force * max_force)
    ratio = math.sqrt(force_ratio_square + torque * torque / (max_torque * max_torque))
    if ratio > 1:
        force_x, force_y, torque = force_x / ratio, force_y / ratio, torque / ratio
    change_x, change_y = force_x - bodies[body, FLOOR_X], force_y - bodies[body, FLOOR_Y]
    bodies[body, SPEED_X] += change_x * inv_mass
    bodies[body, SPEED_Y] += change_y * inv_mass
    bodies[body, SPIN] += (torque - bodies[body, FLOOR_TORQUE]) * inv_inertia
    bodies[body, FLOOR_X], bodies[body, FLOOR_Y], bodies[body, FLOOR_TORQUE] = force_x, force_y, torque
    return abs(change_x) + abs(change_y)


@compilable
def _solve_contact(plane: Plane, i: int) -> float:
    """Iterate once over a contact of two obstacles; return the change of its impulses [N s]."""
    bodies, contacts, h = plane.bodies, plane.obstacle_contacts, plane.robot.substep
    body, other_body = int(contacts[i, 0]), int(contacts[i, planar.OTHER_BODY])
    nx, ny, gap = contacts[i, 2], contacts[i, 3], contacts[i, 4]
    x, y, other_x, other_y = (contacts[i, 5], contacts[i, 6], contacts[i, 7], contacts[i, 8])
    inv_mass, inv_inertia = inverse_masses(plane, body)
    other_inv_mass, other_inv_inertia = inverse_masses(plane, other_body)
    friction, impulse_change = bodies[max(body, other_body), planar.FRICTION], 0.0
    for tangent in range(1, -1, -1):
        axis_x, axis_y = (-ny, nx) if tangent else (nx, ny)
        arm, other_arm = x * axis_y - y * axis_x, other_x * axis_y - other_y * axis_x
        total = inv_mass + other_inv_mass + arm * arm * inv_inertia
        total += other_arm * other_arm * other_inv_inertia
        speed_x, speed_y = speed_at(plane, body, x, y)
        other_speed_x, other_speed_y = speed_at(plane, other_body, other_x, other_y)
        speed = (speed_x - other_speed_x) * axis_x + (speed_y - other_speed_y) * axis_y
        old_impulse = contacts[i, 9 + tangent]
        if tangent:
            max_friction = friction * contacts[i, 9]
            new_impulse = min(max(old_impulse - speed / total, -max_friction), max_friction)
        else:
            new_impulse = max(old_impulse - (speed + gap / h) / total, 0.0)
        contacts[i, 9 + tangent], change = new_impulse, new_impulse - old_impulse
        apply_impulse(plane, body, x, y, change * axis_x, change * axis_y)
        apply_impulse(plane, other_body, other_x, other_y, -change * axis_x, -change * axis_y)
        impulse_change += abs(change)
    return impulse_change


@compilable
def _add_contacts(plane: Plane, count: int, obstacle: int, other: int, cosine: float, sine: float) -> int:
    """Add the contacts of two obstacles; return the number of contacts."""
    obstacles, axes = plane.obstacles, (cosine, sine)
    if obstacles[obstacle, HALF_WIDTH] < 0:
        return _add_contact(plane, count, obstacle, other, 0.0, 0.0, obstacles[obstacle, HALF_LENGTH], axes)
    if obstacles[other, HALF_WIDTH] < 0:
        return _add_contact(plane, count, other, obstacle, 0.0, 0.0, obstacles[other, HALF_LENGTH], axes)
    for order in range(2):
        corners, faces = (obstacle, other) if order == 0 else (other, obstacle)
        c, s = obstacles[corners, planar.COSINE], obstacles[corners, planar.SINE]
        for corner in range(4):
            along = obstacles[corners, HALF_LENGTH] * (1 if corner & 1 else -1)
            across = obstacles[corners, HALF_WIDTH] * (1 if corner & 2 else -1)
            dx, dy = along * c - across * s, along * s + across * c
            count = _add_contact(plane, count, corners, faces, dx, dy, 0.0, axes)
    return count


@compilable
def _add_contact(
    plane: Plane, count: int, obstacle: int, other: int, dx: float, dy: float, radius: float, axes: Pair
) -> int:
    """Add the contact of a disc of an obstacle, at an offset from its centre [m], with another obstacle."""
    obstacles, contacts = plane.obstacles, plane.obstacle_contacts
    c, s = axes
    x, y = obstacles[obstacle, CENTRE_X] + dx, obstacles[obstacle, CENTRE_Y] + dy
    nx, ny, distance = planar.normal_and_distance(obstacles, other, x, y)
    if distance - radius > _CONTACT_MARGIN or count == len(contacts):
        return count
    body, other_body = int(obstacles[obstacle, planar.BODY]), int(obstacles[other, planar.BODY])
    for index in (body, other_body):
        if index >= 0:
            plane.bodies[index, ACTIVE] = 1.0
    dx, dy = dx - radius * nx, dy - radius * ny
    from_x = obstacles[obstacle, CENTRE_X] + dx - obstacles[other, CENTRE_X]
    from_y = obstacles[obstacle, CENTRE_Y] + dy - obstacles[other, CENTRE_Y]
    contacts[count, 0], contacts[count, planar.OTHER_BODY] = body, other_body
    contacts[count, 2], contacts[count, 3] = c * nx + s * ny, c * ny - s * nx
    contacts[count, 4] = substep_gap(distance - radius)
    contacts[count, 5], contacts[count, 6] = c * dx + s * dy, c * dy - s * dx
    contacts[count, 7], contacts[count, 8] = c * from_x + s * from_y, c * from_y - s * from_x
    contacts[count, 9] = contacts[count, 10] = 0.0
    return count + 1
