"""Contact impulses by warm-started projected Gauss-Seidel: slipping tyres and things that push the robot.

A tyre slips beyond its share of friction x load, along or across; the load on the rear support during an
acceleration is taken off the tyres. Things push along the line to the disc's centre, with friction across.
All impulses of a substep are solved together, in repeated rounds.

Left out: tilt, hopping tyres, soft contacts.
"""

# Type checkers cannot infer speeds that depend on each other in a loop.
# pyright: reportUnknownVariableType=false, reportUnknownArgumentType=false

import math

from khep_twin.rollout.planar import plane as flat
from khep_twin.rollout.planar.plane import (
    ACROSS,
    ALONG,
    ANCHOR_X,
    ANCHOR_Y,
    DISTANCE,
    HEADING,
    HEADING_COSINE,
    HEADING_SINE,
    LEFT_ANGLE,
    RIGHT_ANGLE,
    SLIPS,
    TOUCHED,
    Plane,
    X,
    Y,
)

_ROUNDS = 8
"""Most rounds of the solver in each 2.5 ms; it starts from the last impulses."""

_SETTLED = 1e-6
"""Change of speed in a round below which the solver stops [m/s]."""

_GRIPS = 1e-5
"""Slip below which a tyre counts as gripping [m/s]."""

_NEAR = 1e-4
"""Distance within which a thing counts as touched [m]."""

_PASSES = 4
"""Passes that push the disc out of things one by one; between two things it takes several."""


def slide(plane: Plane) -> None:
    """Advance by one step in which tyres may slip and things may push."""
    robot, things = plane.robot, plane.things
    joints, speeds, grips, h = robot.joints, robot.speeds, robot.grips, robot.substep
    x: float = joints[X]
    y: float = joints[Y]
    heading: float = joints[HEADING]
    forward: float = speeds[0]
    aside: float = speeds[1]
    spin: float = speeds[2]
    left: float = robot.wheel * speeds[LEFT_ANGLE]
    right: float = robot.wheel * speeds[RIGHT_ANGLE]
    left_aim: float = robot.free_speed * robot.ctrl[0]
    right_aim: float = robot.free_speed * robot.ctrl[1]
    half, lightness, nimbleness = robot.track / 2, 1 / robot.mass, 1 / robot.inertia
    heft = robot.spin + h * robot.damping
    rim: float = robot.wheel * robot.wheel / heft
    lag: float = robot.spin / heft
    tyre = 1 / (lightness + half * half * nimbleness + rim)
    scrape = 1 / (lightness + robot.radius * robot.radius * nimbleness)
    slips = touches = False
    c, s = robot.last[HEADING_COSINE], robot.last[HEADING_SINE]
    for _ in range(robot.n_substeps):
        reach = robot.radius + h * (abs(forward) + abs(aside)) + _NEAR
        count = _gather(plane, x, y, c, s, reach)
        left += (left_aim - left) * (1 - lag)
        right += (right_aim - right) * (1 - lag)
        grip_left: float = grips[0]
        grip_right: float = grips[1]
        grip_aside: float = grips[2]
        forward += (grip_left + grip_right) * lightness
        aside += grip_aside * lightness
        spin += (grip_right - grip_left) * half * nimbleness
        left -= grip_left * rim
        right -= grip_right * rim
        for i in range(count):
            thing = int(robot.contacts[i, 3])
            along, across = things[thing, ALONG], things[thing, ACROSS]
            nx, ny = robot.contacts[i, 0], robot.contacts[i, 1]
            forward += (along * nx - across * ny) * lightness
            aside += (along * ny + across * nx) * lightness
            spin -= across * robot.radius * nimbleness
        for _ in range(_ROUNDS):
            change_left: float = -(forward - half * spin - left) * tyre
            change_right: float = -(forward + half * spin - right) * tyre
            change_aside: float = -aside * robot.mass
            # Each tyre's impulse along and across is limited by its grip.
            new_left, new_right = grip_left + change_left, grip_right + change_right
            new_aside = grip_aside + change_aside
            most = max(robot.grip * h - robot.relief * lightness * abs(grip_left + grip_right), 0.0)
            both = new_aside * new_aside / 4
            left_aside = right_aside = new_aside / 2
            size = new_left * new_left + both
            if size > most * most:
                part = most / math.sqrt(size)
                new_left, left_aside = new_left * part, left_aside * part
            size = new_right * new_right + both
            if size > most * most:
                part = most / math.sqrt(size)
                new_right, right_aside = new_right * part, right_aside * part
            change_left, change_right = new_left - grip_left, new_right - grip_right
            change_aside = left_aside + right_aside - grip_aside
            grip_left, grip_right, grip_aside = new_left, new_right, left_aside + right_aside
            forward += (change_left + change_right) * lightness
            aside += change_aside * lightness
            spin += (change_right - change_left) * half * nimbleness
            left -= change_left * rim
            right -= change_right * rim
            most_changed = abs(change_left) + abs(change_right) + abs(change_aside)
            for i in range(count):
                thing = int(robot.contacts[i, 3])
                nx, ny, gap = robot.contacts[i, 0], robot.contacts[i, 1], robot.contacts[i, 2]
                across = things[thing, ACROSS]
                side = robot.friction * things[thing, ALONG]
                new = across - (aside * nx - forward * ny - robot.radius * spin) * scrape
                new = min(max(new, -side), side)
                things[thing, ACROSS] = new
                change = new - across
                forward -= change * ny * lightness
                aside += change * nx * lightness
                spin -= change * robot.radius * nimbleness
                along = things[thing, ALONG]
                new = max(along - (forward * nx + aside * ny + gap / h) * robot.mass, 0.0)
                things[thing, ALONG] = new
                most_changed += abs(change) + abs(new - along)
                forward += (new - along) * nx * lightness
                aside += (new - along) * ny * lightness
            if most_changed * lightness < _SETTLED:
                break
        grips[0], grips[1], grips[2] = grip_left, grip_right, grip_aside
        x += h * (forward * c - aside * s)
        y += h * (forward * s + aside * c)
        joints[LEFT_ANGLE] += h * left / robot.wheel
        joints[RIGHT_ANGLE] += h * right / robot.wheel
        turn = h * spin
        heading += turn
        slip = abs(forward - half * spin - left) + abs(forward + half * spin - right) + abs(aside)
        slips = count > 0 or slip > _GRIPS
        # The body's velocity is constant in space while the body turns.
        turn_c, turn_s = flat.turned(turn)
        c, s = c * turn_c - s * turn_s, s * turn_c + c * turn_s
        forward, aside = forward * turn_c + aside * turn_s, aside * turn_c - forward * turn_s
        touches = touches or count > 0
    if touches:
        x, y = _out(plane, x, y)
    joints[X], joints[Y], joints[HEADING] = x, y, heading
    speeds[0], speeds[1], speeds[2] = forward, aside, spin
    speeds[LEFT_ANGLE], speeds[RIGHT_ANGLE] = left / robot.wheel, right / robot.wheel
    robot.last[SLIPS] = 1.0 if slips else 0.0
    if not slips:
        grips[0] = grips[1] = grips[2] = 0.0


def _gather(plane: Plane, x: float, y: float, c: float, s: float, reach: float) -> int:
    """Fill in the contacts within reach of a point [m], normals in the robot's frame; return their number."""
    robot, things, count = plane.robot, plane.things, 0
    dx, dy = x - robot.last[ANCHOR_X], y - robot.last[ANCHOR_Y]
    moved = math.sqrt(dx * dx + dy * dy)
    for i in range(len(plane.order)):
        if things[plane.order[i], DISTANCE] - moved > reach or count == len(robot.contacts):
            break
        thing = plane.order[i]
        if not things[thing, TOUCHED]:
            continue
        nx, ny, away = flat.nearest(things, thing, x, y)
        if away > reach:
            things[thing, ALONG] = things[thing, ACROSS] = 0.0
            continue
        robot.contacts[count, 3] = thing
        robot.contacts[count, 0], robot.contacts[count, 1] = c * nx + s * ny, c * ny - s * nx
        robot.contacts[count, 2] = max(away - robot.radius, 0.0)
        count += 1
    return count


def _out(plane: Plane, x: float, y: float) -> tuple[float, float]:
    """Return a position pushed out of all things that the disc overlaps."""
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
