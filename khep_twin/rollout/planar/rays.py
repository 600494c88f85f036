"""Intersections of a sensor's rays with upright boxes and cylinders in a plane, vectorized."""

import math
from collections.abc import Sequence

from khep_twin.compilable import compilable
from khep_twin.rollout.planar.plane import CENTRE_X, CENTRE_Y, COSINE, LENGTH, SINE, WIDTH, PlanarRobot, Plane
from khep_twin.sensing.buffers import Matrix


@compilable
def in_cone(things: Matrix, thing: int, x: float, y: float, cone: tuple[float, float, float, float]) -> bool:
    """Return whether an obstacle reaches into a cone; its edges are given as unit normals to its inside."""
    right_x, right_y, left_x, left_y = cone
    dx, dy = things[thing, CENTRE_X] - x, things[thing, CENTRE_Y] - y
    length, width = things[thing, LENGTH], things[thing, WIDTH]
    if width < 0:
        return dx * right_x + dy * right_y + length >= 0 and dx * left_x + dy * left_y + length >= 0
    c, s = things[thing, COSINE], things[thing, SINE]
    most = length * abs(c * right_x + s * right_y) + width * abs(c * right_y - s * right_x)
    if dx * right_x + dy * right_y + most < 0:
        return False
    most = length * abs(c * left_x + s * left_y) + width * abs(c * left_y - s * left_x)
    return dx * left_x + dy * left_y + most >= 0


@compilable
def meet_box(plane: Plane, thing: int, x: float, y: float) -> None:
    """Update a sensor's rays with their hits on a box, if nearer than their hits so far."""
    things, robot = plane.things, plane.robot
    looks, lengths, hits = robot.looks, robot.lengths, robot.hits
    n_wide = len(hits)
    c, s = things[thing, COSINE], things[thing, SINE]
    length, width = things[thing, LENGTH], things[thing, WIDTH]
    dx, dy = x - things[thing, CENTRE_X], y - things[thing, CENTRE_Y]
    along, across = dx * c + dy * s, dy * c - dx * s
    # From a point at most one end face and one side face are visible, with these normals:
    end, side = math.copysign(1.0, along), math.copysign(1.0, across)
    end_x, end_y, side_x, side_y = end * c, end * s, -side * s, side * c
    an_end, a_side = 4 * thing + (0 if end > 0 else 1), 4 * thing + (2 if side > 0 else 3)
    along, across = abs(along), abs(across)
    before_end, before_side = along - length, across - width
    if before_end <= 0 and before_side <= 0:
        # A point inside, possible only by rounding, counts as on the nearer face.
        before_end, before_side = (0.0, -1.0) if before_end > before_side else (-1.0, 0.0)
    # No branch skips a ray, so that the compiled loop is vectorized.
    for ray in range(n_wide):
        way_x, way_y = looks[ray], looks[n_wide + ray]
        to_end, to_side = -(way_x * end_x + way_y * end_y), -(way_x * side_x + way_y * side_y)
        # Test whether the ray crosses the face within its extent.
        at_end, at_side = across * to_end - before_end * to_side, along * to_side - before_side * to_end
        by_end = (to_end > 0) & (before_end >= 0) & (abs(at_end) <= width * to_end)
        by_side = (to_side > 0) & (before_side >= 0) & (abs(at_side) <= length * to_side)
        end_hit = before_end / to_end if by_end else math.inf
        side_hit = before_side / to_side if by_side else math.inf
        hit, best = min(end_hit, side_hit), lengths[ray]
        lengths[ray] = min(best, hit)
        face = an_end if end_hit <= side_hit else a_side
        hits[ray] = face if hit < best else hits[ray]


@compilable
def meet_circle(plane: Plane, thing: int, x: float, y: float) -> None:
    """Update a sensor's rays with their hits on a cylinder, if nearer than their hits so far."""
    things, robot = plane.things, plane.robot
    looks, lengths, hits = robot.looks, robot.lengths, robot.hits
    n_wide = len(hits)
    dx, dy = x - things[thing, CENTRE_X], y - things[thing, CENTRE_Y]
    outside = dx * dx + dy * dy - things[thing, LENGTH] * things[thing, LENGTH]
    # From inside, possible only by rounding, the far side is hit.
    sign, least = (1.0, 0.0) if outside > 0 else (-1.0, -math.inf)
    for ray in range(n_wide):
        towards = -(dx * looks[ray] + dy * looks[n_wide + ray])
        square, best = towards * towards - outside, lengths[ray]
        ray_direction = towards - sign * math.sqrt(max(square, 0.0))
        hit = ray_direction if (square >= 0) & (towards >= least) else math.inf
        lengths[ray] = min(best, hit)
        hits[ray] = 4 * thing if hit < best else hits[ray]


@compilable
def most(robot: PlanarRobot, weights: Sequence[float], offset: float, rest: float) -> float:
    """Return an upper bound of the light coming back [1/m^2]: all hits head-on, all else at `rest` [m]."""
    for ray in range(len(robot.shares)):
        path = min(robot.lengths[ray], rest) + offset
        robot.shares[ray] = 1 / (path * path)
    total = 0.0
    for ray in range(len(weights)):
        total += weights[ray] * robot.shares[ray]
    return total
