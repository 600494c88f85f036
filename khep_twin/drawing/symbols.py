"""Symbols: parts of a playpen in a drawing, to scale, on axes in mm.

Walls and objects have the colour of their surface; movable objects are hatched, with a dashed edge. An arrow
points up a ramp; a table has a dashed edge and no walls. The floor is tinted by the light of the lamps
(`illumination`). The white wedge on a robot is its front.
"""

# The annotations of matplotlib leave keyword arguments untyped.
# pyright: reportUnknownMemberType=false

from collections import defaultdict
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.lines import Line2D
from matplotlib.patches import Circle, FancyArrowPatch, Patch, Polygon, Rectangle

from khep_twin.drawing.labels import Labels
from khep_twin.drawing.light_map import Floats, illumination
from khep_twin.playpen import (
    BULB_RADIUS_MM,
    Block,
    Cylinder,
    Lamp,
    Playpen,
    RobotEntry,
    Spot,
    Wall,
    footprint,
    parts,
)
from khep_twin.playpen.polygon import walls_around
from khep_twin.units import BODY_RADIUS

Look = dict[str, Any]
"""Keyword arguments of matplotlib's artists, of any types."""

INK = "#2b2f36"
"""Colour of lines and text."""

_FLOOR = "#faf8f2"
_BOARD = "#2f7d5b"
FILAMENT = "#9a6b00"
"""Colour of the lines of a lamp."""

_GLOW = (1.0, 0.72, 0.12)

_HALF_GLOW = 3e-4
"""Light at which the tint has half its strength [W/mm^2]: that of 7 W at 15 cm."""

_GLOW_CELLS = 480
"""Resolution of the tint along the longer side."""


def draw_arena(axes: Axes, playpen: Playpen) -> None:
    """Draw the walls, and the floor in the light of the lamps."""
    arena = playpen.arena
    wall, width, height = arena.wall_thickness_mm, arena.width_mm, arena.height_mm
    colour = surface_colour(playpen, arena.surface)
    look: Look = {"ls": (0, (6, 3)), "lw": 1.2} if arena.table else {"lw": 0.8}
    floor = Polygon(np.array(arena.corners), facecolor=_FLOOR, edgecolor=INK, **look)
    if arena.outline_mm and not arena.table:
        for shape in walls_around(arena.outline_mm, wall):
            _draw_shape(axes, shape, facecolor=colour, edgecolor=INK, lw=0.8)
    elif not arena.table:
        outside: Look = {"facecolor": colour, "edgecolor": INK, "lw": 0.8}
        axes.add_patch(Rectangle((-wall, -wall), width + 2 * wall, height + 2 * wall, **outside))
    axes.add_patch(floor)
    if playpen.lamps:
        step = max(width, height) / _GLOW_CELLS
        columns, rows = max(round(width / step), 1), max(round(height / step), 1)
        xs, ys = (np.arange(columns) + 0.5) * width / columns, (np.arange(rows) + 0.5) * height / rows
        x, y = np.meshgrid(xs, ys)
        light = _light_at_start(playpen, x, y)
        glow = np.empty((rows, columns, 4))
        glow[..., :3] = _GLOW
        glow[..., 3] = 0.75 * light / (light + _HALF_GLOW)
        extent = (0.0, width, 0.0, height)
        image = axes.imshow(glow, extent=extent, origin="lower", interpolation="bilinear", zorder=1.5)
        image.set_clip_path(floor)


def _light_at_start(playpen: Playpen, x_mm: Floats, y_mm: Floats) -> Floats:
    """Return the light of the lamps that are on at the start [W/mm^2]; of a random lamp, the mean."""
    if playpen.lighting.mode == "sequenced":
        playpen = playpen.model_copy(update={"lamps": playpen.lamps[:1]})
    light = illumination(playpen, x_mm, y_mm)
    return light / len(playpen.lamps) if playpen.lighting.mode == "random" else light


def draw_object(axes: Axes, playpen: Playpen, item: Block | Cylinder) -> Patch:
    """Draw a block or cylinder from above."""
    look = surface_look(playpen, item.surface, item.movable)
    if isinstance(item, Block) and item.ramp:
        along = 0.35 * item.length_mm * np.array([np.cos(turn := np.radians(item.angle_deg)), np.sin(turn)])
        foot, top = (tuple(np.array((item.x_mm, item.y_mm)) + offset) for offset in (-along, along))
        arrow = FancyArrowPatch(foot, top, arrowstyle="-|>", mutation_scale=14, lw=1.2, color=INK, zorder=3.1)
        axes.add_patch(arrow)
    return _draw_shape(axes, item.footprint, zorder=3, **look)


def draw_wall(axes: Axes, playpen: Playpen, wall: Wall) -> None:
    """Draw a free-standing wall, in one colour and with one edge around it."""
    colour = surface_colour(playpen, wall.surface)
    for shape in wall.footprints:
        _draw_shape(axes, shape, zorder=2.8, facecolor=colour, edgecolor=INK, lw=1.6)
    for shape in wall.footprints:
        _draw_shape(axes, shape, zorder=2.9, facecolor=colour, lw=0)


def draw_stripes(axes: Axes, playpen: Playpen) -> None:
    """Draw the stripes on walls and objects, as lines along their sides."""
    stripes = list(playpen.panels)
    if not stripes:
        return
    lines = LineCollection(
        [panel.ends for panel in stripes],
        colors=[surface_colour(playpen, panel.surface) for panel in stripes],
        linewidths=2.4,
        capstyle="butt",
        zorder=3.2,
    )
    axes.add_collection(lines, autolim=False)


def draw_patch(axes: Axes, playpen: Playpen, patch: parts.Patch) -> None:
    """Draw a part of the floor with another surface."""
    look = {"facecolor": surface_colour(playpen, patch.surface), "lw": 0}
    floor = Polygon(np.array(playpen.arena.corners), transform=axes.transData)
    _draw_shape(axes, patch.footprint, zorder=1.2, **look).set_clip_path(floor)


def draw_spot(axes: Axes, labels: Labels, spot: Spot) -> None:
    """Draw a spot, a start pose of robots: outline, heading and name."""
    radius, heading = 1000 * BODY_RADIUS, np.radians(spot.heading_deg)
    outline = Circle((spot.x_mm, spot.y_mm), radius, fill=False, edgecolor=_BOARD, lw=0.9, ls=(0, (2, 2)))
    axes.add_patch(outline).set_zorder(4.5)
    tip_x, tip_y = spot.x_mm + radius * np.cos(heading), spot.y_mm + radius * np.sin(heading)
    axes.add_line(Line2D([spot.x_mm, tip_x], [spot.y_mm, tip_y], color=_BOARD, lw=1.2, zorder=4.5))
    labels.add(spot.x_mm, spot.y_mm, radius + 4, spot.name)


def _draw_shape(axes: Axes, shape: footprint.Footprint, **look: Any) -> Patch:
    patch: Patch
    if isinstance(shape, footprint.Circle):
        patch = Circle((shape.x_mm, shape.y_mm), shape.radius_mm, **look)
    else:
        corner = (shape.x_mm - shape.length_mm / 2, shape.y_mm - shape.width_mm / 2)
        patch = Rectangle(
            corner, shape.length_mm, shape.width_mm, angle=shape.angle_deg, rotation_point="center", **look
        )
    axes.add_patch(patch)
    return patch


def draw_lamps(axes: Axes, labels: Labels, playpen: Playpen) -> None:
    """Draw bulbs with their power; lamps that are on at the start have rays.

    Sequenced lamps have their number before the power, and arrows from each to the next.
    """
    lamps, mode = playpen.lamps, playpen.lighting.mode
    texts: defaultdict[tuple[float, float], list[str]] = defaultdict(list)  # by position of the lamps
    for index, lamp in enumerate(lamps):
        power = f"{lamp.power_w * lamp.dim:g} W"
        _draw_lamp(axes, lamp, on=mode == "all" or (mode == "sequenced" and index == 0))
        texts[lamp.x_mm, lamp.y_mm].append(f"{index + 1}: {power}" if mode == "sequenced" else power)
        if mode == "sequenced" and len(lamps) > 1:
            next_lamp = lamps[(index + 1) % len(lamps)]
            ends = (lamp.x_mm, lamp.y_mm), (next_lamp.x_mm, next_lamp.y_mm)
            # Curved, so that the arrows between two lamps do not coincide.
            look: Look = {"arrowstyle": "-|>", "mutation_scale": 8, "shrinkA": 9, "shrinkB": 9}
            look["connectionstyle"] = "arc3,rad=0.08"
            arrow = FancyArrowPatch(*ends, ls=(0, (4, 3)), lw=0.9, color=FILAMENT, **look)
            axes.add_patch(arrow).set_zorder(3.5)
    for (x_mm, y_mm), lamp_texts in texts.items():
        text_counts = {text: lamp_texts.count(text) for text in lamp_texts}
        label = ", ".join(text if count == 1 else f"{count} x {text}" for text, count in text_counts.items())
        labels.add(x_mm, y_mm, 2.2 * BULB_RADIUS_MM, label)


def _draw_lamp(axes: Axes, lamp: Lamp, *, on: bool) -> None:
    """Draw a bulb: filled and with rays if it is on, otherwise empty and dotted."""
    x, y, radius = lamp.x_mm, lamp.y_mm, BULB_RADIUS_MM
    colour = tuple(channel / 255 for channel in lamp.rgb) if on else "white"
    bulb = Circle((x, y), radius, facecolor=colour, edgecolor=FILAMENT, lw=0.9, ls="-" if on else ":")
    axes.add_patch(bulb).set_zorder(6)
    for angle in np.radians(np.arange(0, 360, 45)) if on else ():
        radii = np.array((1.35, 1.8)) * radius
        ray = Line2D(x + radii * np.cos(angle), y + radii * np.sin(angle), color=FILAMENT, lw=0.9, zorder=6)
        axes.add_line(ray)


def draw_robot(axes: Axes, robot: RobotEntry) -> list[Patch]:
    """Draw a robot with its wheels and its front; return its parts."""
    radius = 1000 * robot.body.radius
    heading = np.radians(robot.heading_deg)
    centre = np.array((robot.x_mm, robot.y_mm))
    forward = np.array((np.cos(heading), np.sin(heading)))
    left = np.array((-forward[1], forward[0]))
    patches: list[Patch] = [
        Circle((robot.x_mm, robot.y_mm), radius, facecolor=_BOARD, edgecolor=INK, lw=0.9, zorder=5)
    ]
    body = robot.body
    tyre = 1000 * np.array(
        [(a * body.wheel_radius, b * body.wheel_width / 2) for a, b in ((-1, -1), (1, -1), (1, 1), (-1, 1))]
    )
    for side in (1, -1):
        wheel_centre = centre + side * 500 * body.wheel_base * left
        patches.append(Polygon(wheel_centre + tyre @ np.array((forward, left)), facecolor=INK, zorder=5))
    wedge = radius * np.array(((0.88, 0.0), (0.42, 0.34), (0.42, -0.34)))
    patches.append(Polygon(centre + wedge @ np.array((forward, left)), facecolor="white", zorder=6))
    for patch in patches:
        axes.add_patch(patch)
    return patches


def surface_look(playpen: Playpen, surface: str, movable: bool) -> Look:
    """Return fill and edge of a patch of this surface."""
    look: Look = {"facecolor": surface_colour(playpen, surface), "edgecolor": INK, "lw": 0.8}
    if movable:
        look |= {"lw": 1.0, "ls": (0, (3, 2)), "hatch": "/////"}
    return look


def surface_colour(playpen: Playpen, surface: str) -> tuple[float, float, float]:
    """Return red, green and blue of a surface, 0 to 1."""
    red, green, blue = playpen.surface(surface).rgb
    return red / 255, green / 255, blue / 255
