"""Polygons around an arena, and walls along lines within it. Lengths in mm."""

import math
from collections.abc import Iterator, Sequence
from itertools import combinations, product

from khep_twin.playpen.footprint import Circle, Footprint, Rectangle

Point = tuple[float, float]
Edge = tuple[Point, Point]


def edges(points: Sequence[Point], *, closed: bool) -> list[Edge]:
    """Return the edges from each point to the next; in a closed line also from the last to the first."""
    end_points = [*points[1:], points[0]] if closed else points[1:]
    return list(zip(points, end_points, strict=False))


def area(points: Sequence[Point]) -> float:
    """Return the area of a polygon [mm^2]; negative if its points run clockwise."""
    return sum(x0 * y1 - x1 * y0 for (x0, y0), (x1, y1) in edges(points, closed=True)) / 2


def find_crossing(points: Sequence[Point]) -> tuple[int, int] | None:
    """Return the numbers from 1 of the first two edges of a polygon that meet outside its corners."""
    numbered = list(enumerate(edges(points, closed=True)))
    for (i, one), (k, other) in combinations(numbered, 2):
        if k - i in (1, len(points) - 1):
            # Adjacent edges share a corner, but must not fold back onto each other.
            corner, start, end = (one[1], one[0], other[1]) if k - i == 1 else (one[0], one[1], other[0])
            dot_product = sum((start[axis] - corner[axis]) * (end[axis] - corner[axis]) for axis in (0, 1))
            if dot_product > 0 and _side((corner, start), end) == 0:
                return i + 1, k + 1
        elif _edges_meet(one, other):
            return i + 1, k + 1
    return None


def rectangle_corners(shape: Rectangle) -> list[Point]:
    """Return the corners of a rectangle, counter-clockwise."""
    (ahead_x, ahead_y), (left_x, left_y) = shape.axes()
    half_length, half_width = shape.length_mm / 2, shape.width_mm / 2
    return [
        (
            shape.x_mm + along * half_length * ahead_x + across * half_width * left_x,
            shape.y_mm + along * half_length * ahead_y + across * half_width * left_y,
        )
        for along, across in ((-1, -1), (1, -1), (1, 1), (-1, 1))
    ]


def contains(points: Sequence[Point], x: float, y: float) -> bool:
    """Return whether a point lies in a polygon or on its edge."""
    inside = False
    for (x0, y0), (x1, y1) in edges(points, closed=True):
        if _is_on_edge(((x0, y0), (x1, y1)), (x, y)):
            return True
        if (y0 > y) != (y1 > y) and x < x0 + (y - y0) * (x1 - x0) / (y1 - y0):
            inside = not inside
    return inside


def distance(points: Sequence[Point], x: float, y: float) -> float:
    """Return the distance from a point to a polygon's nearest edge [mm]."""
    return min(_edge_distance(edge, (x, y)) for edge in edges(points, closed=True))


def walls_around(points: Sequence[Point], thickness_mm: float) -> list[Rectangle]:
    """Return a wall along each edge of a polygon, outside it, with closed corners."""
    ring = list(points) if area(points) > 0 else list(reversed(points))
    lines = edges(ring, closed=True)
    walls: list[Rectangle] = []
    for index, ((x0, y0), (x1, y1)) in enumerate(lines):
        length = math.hypot(x1 - x0, y1 - y0)
        along = (x1 - x0) / length, (y1 - y0) / length
        start_turn = _turn_angle(lines[index - 1], lines[index])
        end_turn = _turn_angle(lines[index], lines[(index + 1) % len(lines)])
        # At convex corners, extend both walls to where their outer faces meet.
        start, end = (thickness_mm * min(math.tan(max(turn, 0) / 2), 2.0) for turn in (start_turn, end_turn))
        shift = (end - start) / 2
        normal = along[1], -along[0]
        walls.append(
            Rectangle(
                (x0 + x1) / 2 + shift * along[0] + thickness_mm / 2 * normal[0],
                (y0 + y1) / 2 + shift * along[1] + thickness_mm / 2 * normal[1],
                length + start + end,
                thickness_mm,
                math.degrees(math.atan2(along[1], along[0])),
            )
        )
    return walls


def corner_before(points: Sequence[Point], wall: int) -> int:
    """Return the number from 1 of the corner after which a wall of `walls_around`, from 0, stands."""
    return wall + 1 if area(points) > 0 else (len(points) - 1 - wall) or len(points)


def find_inner_walls(points: Sequence[Point], thickness_mm: float) -> list[int]:
    """Return the numbers from 1 of the edges whose walls (`walls_around`) overlap the polygon."""
    ring = list(points) if area(points) > 0 else list(reversed(points))
    corners: list[int] = []
    for index, wall in enumerate(walls_around(points, thickness_mm)):
        (ahead_x, ahead_y), (left_x, left_y) = wall.axes()
        for step, side in product(range(-9, 10), (-0.45, 0.0, 0.4)):
            along, across = step / 10 * wall.length_mm / 2, side * thickness_mm
            x = wall.x_mm + along * ahead_x + across * left_x
            y = wall.y_mm + along * ahead_y + across * left_y
            if contains(ring, x, y) and distance(ring, x, y) > 1e-6:
                corners.append(corner_before(points, index))
                break
    return sorted(corners)


def wall_pieces(points: Sequence[Point], thickness_mm: float, *, closed: bool) -> Iterator[Footprint]:
    """Yield a wall along a line as rectangles, with round corners between them."""
    for (x0, y0), (x1, y1) in edges(points, closed=closed):
        angle_deg = math.degrees(math.atan2(y1 - y0, x1 - x0))
        length = math.hypot(x1 - x0, y1 - y0)
        yield Rectangle((x0 + x1) / 2, (y0 + y1) / 2, length, thickness_mm, angle_deg)
    for x, y in points if closed else points[1:-1]:
        yield Circle(x, y, thickness_mm / 2)


def _turn_angle(previous: Edge, edge: Edge) -> float:
    """Return the angle by which an edge turns left from the previous one [rad]."""
    x0, y0 = previous[1][0] - previous[0][0], previous[1][1] - previous[0][1]
    x1, y1 = edge[1][0] - edge[0][0], edge[1][1] - edge[0][1]
    return math.atan2(x0 * y1 - y0 * x1, x0 * x1 + y0 * y1)


def _side(edge: Edge, point: Point) -> float:
    """Return a positive number if a point lies left of an edge, 0 if on its line."""
    (x0, y0), (x1, y1) = edge
    return (x1 - x0) * (point[1] - y0) - (y1 - y0) * (point[0] - x0)


def _is_on_edge(edge: Edge, point: Point) -> bool:
    (x0, y0), (x1, y1) = edge
    within = min(x0, x1) <= point[0] <= max(x0, x1) and min(y0, y1) <= point[1] <= max(y0, y1)
    return within and _side(edge, point) == 0


def _edges_meet(one: Edge, other: Edge) -> bool:
    """Return whether two edges have a common point."""
    if any(_is_on_edge(one, point) for point in other) or any(_is_on_edge(other, point) for point in one):
        return True
    sides = _side(one, other[0]) * _side(one, other[1]), _side(other, one[0]) * _side(other, one[1])
    return sides[0] < 0 and sides[1] < 0


def _edge_distance(edge: Edge, point: Point) -> float:
    """Return the distance from a point to an edge [mm]."""
    (x0, y0), (x1, y1) = edge
    dx, dy = x1 - x0, y1 - y0
    fraction = ((point[0] - x0) * dx + (point[1] - y0) * dy) / (dx * dx + dy * dy)
    clamped = max(0.0, min(1.0, fraction))
    return math.hypot(x0 + clamped * dx - point[0], y0 + clamped * dy - point[1])
