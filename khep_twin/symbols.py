"""Symbols: how the parts of a playpen look in a drawing, to scale, on axes in mm.

Walls and objects have their surface's colour; what can be moved is hatched, with a dashed edge. The floor
glows where light of the lamps comes to (`illumination`). The white wedge on a robot is its front.
"""

# matplotlib's own annotations leave keyword arguments open.
# pyright: reportUnknownMemberType=false

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.lines import Line2D
from matplotlib.patches import Circle, Patch, Polygon, Rectangle
from matplotlib.patheffects import withStroke

from khep_twin import footprint, playpen_parts
from khep_twin.illumination import illumination
from khep_twin.outline import walls_around
from khep_twin.playpen import BULB_RADIUS_MM, Block, Cylinder, Lamp, Playpen, Robot, Spot, Wall
from khep_twin.units import BODY_RADIUS, WHEEL_BASE, WHEEL_RADIUS, WHEEL_WIDTH

INK = "#2b2f36"
"""Of lines and text."""

_FLOOR = "#faf8f2"
_BOARD = "#2f7d5b"
_FILAMENT = "#9a6b00"
_GLOW = (1.0, 0.72, 0.12)

_HALF_GLOW = 3e-4
"""Light at which the glow has half its strength [W/mm^2]: that of 7 W in 15 cm."""

_GLOW_CELLS = 480
"""The glow's resolution along the longer side."""


def draw_arena(axes: Axes, playpen: Playpen) -> None:
    """Walls, and the floor in the light of the lamps."""
    arena = playpen.arena
    wall, width, height = arena.wall_thickness_mm, arena.width_mm, arena.height_mm
    colour = surface_colour(playpen, arena.surface)
    floor = Polygon(np.array(arena.corners), facecolor=_FLOOR, edgecolor=INK, lw=0.8)
    if arena.outline_mm:
        for shape in walls_around(arena.outline_mm, wall):
            _draw_shape(axes, shape, facecolor=colour, edgecolor=INK, lw=0.8)
    else:
        axes.add_patch(
            Rectangle(
                (-wall, -wall), width + 2 * wall, height + 2 * wall, facecolor=colour, edgecolor=INK, lw=0.8
            )
        )
    axes.add_patch(floor)
    if playpen.lamps:
        step = max(width, height) / _GLOW_CELLS
        columns, rows = max(round(width / step), 1), max(round(height / step), 1)
        x, y = np.meshgrid(
            (np.arange(columns) + 0.5) * width / columns, (np.arange(rows) + 0.5) * height / rows
        )
        light = illumination(playpen, x, y)
        glow = np.empty((rows, columns, 4))
        glow[..., :3] = _GLOW
        glow[..., 3] = 0.75 * light / (light + _HALF_GLOW)
        extent = (0.0, width, 0.0, height)
        image = axes.imshow(glow, extent=extent, origin="lower", interpolation="bilinear", zorder=1.5)
        image.set_clip_path(floor)


def draw_object(axes: Axes, playpen: Playpen, item: Block | Cylinder) -> None:
    """A block or cylinder from above."""
    look = surface_look(playpen, item.surface, item.movable)
    _draw_shape(axes, item.footprint, zorder=3, **look)


def draw_wall(axes: Axes, playpen: Playpen, wall: Wall) -> None:
    """A wall that stands on the floor, in one colour and with an edge around all of it."""
    colour = surface_colour(playpen, wall.surface)
    for shape in wall.footprints:
        _draw_shape(axes, shape, zorder=2.8, facecolor=colour, edgecolor=INK, lw=1.6)
    for shape in wall.footprints:
        _draw_shape(axes, shape, zorder=2.9, facecolor=colour, lw=0)


def draw_patch(axes: Axes, playpen: Playpen, patch: playpen_parts.Patch) -> None:
    """A part of the floor."""
    look = {"facecolor": surface_colour(playpen, patch.surface), "lw": 0}
    floor = Polygon(np.array(playpen.arena.corners), transform=axes.transData)
    _draw_shape(axes, patch.footprint, zorder=1.2, **look).set_clip_path(floor)


def draw_spot(axes: Axes, spot: Spot) -> None:
    """A place where a robot may start: its outline, its heading and its name."""
    radius, heading = 1000 * BODY_RADIUS, np.radians(spot.heading_deg)
    axes.add_patch(
        Circle(
            (spot.x_mm, spot.y_mm), radius, fill=False, edgecolor=_BOARD, lw=0.9, ls=(0, (2, 2)), zorder=4.5
        )
    )
    tip = radius * np.array((np.cos(heading), np.sin(heading)))
    axes.add_line(
        Line2D(
            [spot.x_mm, spot.x_mm + tip[0]], [spot.y_mm, spot.y_mm + tip[1]], color=_BOARD, lw=1.2, zorder=4.5
        )
    )
    write_below(axes, spot.x_mm, spot.y_mm - radius - 4, spot.name)


def _draw_shape(axes: Axes, shape: footprint.Footprint, **look: Any) -> Patch:
    patch: Patch
    if isinstance(shape, footprint.Circle):
        patch = Circle((shape.x_mm, shape.y_mm), shape.radius_mm, **look)
    else:
        corner = (shape.x_mm - shape.length_mm / 2, shape.y_mm - shape.width_mm / 2)
        patch = Rectangle(
            corner,
            shape.length_mm,
            shape.width_mm,
            angle=shape.angle_deg,
            rotation_point="center",
            **look,
        )
    axes.add_patch(patch)
    return patch


def draw_lamp(axes: Axes, lamp: Lamp) -> None:
    """A bulb with rays, and its power."""
    x, y, radius = lamp.x_mm, lamp.y_mm, BULB_RADIUS_MM
    colour = tuple(part / 255 for part in lamp.rgb)
    axes.add_patch(Circle((x, y), radius, facecolor=colour, edgecolor=_FILAMENT, lw=0.9, zorder=6))
    for angle in np.radians(np.arange(0, 360, 45)):
        along = np.array((1.35, 1.8)) * radius
        ray = Line2D(x + along * np.cos(angle), y + along * np.sin(angle), color=_FILAMENT, lw=0.9, zorder=6)
        axes.add_line(ray)
    write_below(axes, x, y - 2.2 * radius, f"{lamp.power_w * lamp.dim:g} W")


def draw_robot(axes: Axes, robot: Robot, name: str) -> None:
    """A robot with its wheels, its front and its name."""
    radius = 1000 * robot.body.radius
    heading = np.radians(robot.heading_deg)
    centre = np.array((robot.x_mm, robot.y_mm))
    ahead = np.array((np.cos(heading), np.sin(heading)))
    left = np.array((-ahead[1], ahead[0]))
    axes.add_patch(
        Circle((robot.x_mm, robot.y_mm), radius, facecolor=_BOARD, edgecolor=INK, lw=0.9, zorder=5)
    )
    tyre = 1000 * np.array(
        [(a * WHEEL_RADIUS, b * WHEEL_WIDTH / 2) for a, b in ((-1, -1), (1, -1), (1, 1), (-1, 1))]
    )
    for side in (1, -1):
        offset = centre + side * 500 * WHEEL_BASE * left
        axes.add_patch(Polygon(offset + tyre @ np.array((ahead, left)), facecolor=INK, zorder=5))
    wedge = radius * np.array(((0.88, 0.0), (0.42, 0.34), (0.42, -0.34)))
    axes.add_patch(Polygon(centre + wedge @ np.array((ahead, left)), facecolor="white", zorder=6))
    write_below(axes, robot.x_mm, robot.y_mm - radius - 4, name)


def write_below(axes: Axes, x_mm: float, y_mm: float, text: str) -> None:
    """Text below a point, held apart from what it lies on by a pale rim."""
    rim = withStroke(linewidth=2.2, foreground=(1, 1, 1, 0.8))
    axes.text(x_mm, y_mm, text, ha="center", va="top", fontsize=7.5, color=INK, zorder=8, path_effects=[rim])


def surface_look(playpen: Playpen, surface: str, movable: bool) -> dict[str, Any]:
    """Fill and edge of a patch for something of this surface."""
    look: dict[str, Any] = {"facecolor": surface_colour(playpen, surface), "edgecolor": INK, "lw": 0.8}
    if movable:
        look |= {"lw": 1.0, "ls": (0, (3, 2)), "hatch": "/////"}
    return look


def surface_colour(playpen: Playpen, surface: str) -> tuple[float, float, float]:
    """Red, green and blue from 0 to 1."""
    red, green, blue = playpen.surface(surface).rgb
    return red / 255, green / 255, blue / 255
