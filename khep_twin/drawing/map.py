"""Drawings: a playpen from above, to scale, with the paths of robots.

Lamps, objects and robots are drawn to scale (`symbols`), robots at their start. Several named paths have
a colour each; paths of one robot, or of many, are coloured by time. The robot's outline at the end of a path
is dashed. The same arguments give the same bytes, independent of the configuration of matplotlib.
"""

# The annotations of matplotlib leave keyword arguments untyped.
# pyright: reportUnknownMemberType=false

from collections.abc import Iterator, Mapping, Sequence
from io import BytesIO
from itertools import chain
from pathlib import Path
from typing import Literal

import matplotlib.style
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.cm import ScalarMappable
from matplotlib.collections import LineCollection
from matplotlib.colors import Colormap, LinearSegmentedColormap, Normalize
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Circle, Patch
from matplotlib.ticker import MaxNLocator
from matplotlib.transforms import Bbox

from khep_twin.drawing.labels import Labels
from khep_twin.drawing.paths import DrawnPath, Paths, drawn_paths
from khep_twin.drawing.symbols import (
    FILAMENT,
    INK,
    Look,
    draw_arena,
    draw_lamps,
    draw_object,
    draw_patch,
    draw_robot,
    draw_spot,
    draw_stripes,
    draw_wall,
    surface_look,
)
from khep_twin.errors import KhepTwinError
from khep_twin.files.drawings import write_drawing
from khep_twin.files.paths import StrPath
from khep_twin.playpen import Playpen, PlaypenLike, Wall
from khep_twin.robots.model import robot_name
from khep_twin.units import BODY_RADIUS

POINT_LIMIT = 20_000
"""Largest number of drawn points of a path; longer paths are subsampled evenly."""

STYLE: list[str | dict[str, object]] = [
    "default",
    {
        "font.size": 9,
        "text.color": INK,
        "axes.labelcolor": INK,
        "axes.linewidth": 0.6,
        "xtick.color": INK,
        "ytick.color": INK,
        "xtick.major.width": 0.6,
        "ytick.major.width": 0.6,
        "hatch.linewidth": 0.6,
        # Without a salt, element names in an SVG would differ each time.
        "svg.hashsalt": "khep_twin",
    },
]
"""Style of drawings, independent of matplotlib's configuration; for `matplotlib.style.context`."""

_START_MARKER: Look = {"marker": "o", "ms": 4.5, "mfc": "white", "mec": INK, "mew": 1.1}
_END_MARKER: Look = {"marker": "s", "ms": 4.5, "mfc": INK, "mec": "white", "mew": 0.8}
METADATA: dict[str, dict[str, None]] = {
    "png": {"Software": None},
    "svg": {"Date": None, "Creator": None},
    "pdf": {"CreationDate": None, "Creator": None, "Producer": None},
}
"""Metadata by kind of file that omit the version and time of matplotlib."""

LONGER_SIDE = 6.2
"""Longer side of the playpen on paper [inch]."""

_ENTRY = 1.0
"""Width of a legend entry [inch]."""

_COLOURS = (
    *("#2f6fb0", "#d81b82", "#14808c", "#5b2a86", "#8c564b"),
    *("#c2452d", "#5d6d1e", "#1f9fd6", "#e07b00", "#6b7280"),
)
"""Colours of named paths; with more names, paths are coloured by time."""


def draw(
    playpen: PlaypenLike, paths: Paths = (), *, title: str | None = None, longer_side: float = LONGER_SIDE
) -> Figure:
    """Draw a playpen at its start, and the paths of robots.

    Args:
        playpen: Playpen to draw, or its name or path.
        paths: Paths of robots: arrays of positions or poses [m], by name if they have names, or `DrawnPath`s.
            Up to ten names have a colour each; otherwise all are coloured by time, if times are known.
        title: Title above the drawing; by default the playpen's name.
        longer_side: Longer side of the playpen on paper [inch]; the text keeps its size.

    Raises:
        PlaypenError: The playpen cannot be used.
        ValueError: An array has another shape, or is not in metres.
    """
    playpen, tracks = Playpen.load(playpen), drawn_paths(paths)
    colours, time_scale = _colours_by_name(tracks), _time_scale(tracks)
    with matplotlib.style.context(STYLE):
        legend = list(_legend(playpen, colours, bool(tracks)))
        has_scale = time_scale is not None and not colours
        figure, axes, columns = _make_axes(playpen, longer_side, has_scale=has_scale, n_entries=len(legend))
        labels = Labels(axes, INK)
        axes.set_title(playpen.name if title is None else title, loc="left", fontsize=11, pad=8)
        limits = axes.axis()
        draw_arena(axes, playpen)
        for patch in playpen.patches:
            draw_patch(axes, playpen, patch)
        for item in chain(*playpen.obstacles.values()):
            if isinstance(item, Wall):
                draw_wall(axes, playpen, item)
            else:
                draw_object(axes, playpen, item)
        draw_stripes(axes, playpen)
        for spot in playpen.spots:
            draw_spot(axes, labels, spot)
        for index, robot in enumerate(playpen.robots):
            if robot.spots:
                continue  # Its spot is not yet known.
            draw_robot(axes, robot)
            labels.add(robot.x_mm, robot.y_mm, 1000 * robot.body.radius + 4, robot_name(index))
        draw_lamps(axes, labels, playpen)
        radii = {robot_name(index): robot.body.radius for index, robot in enumerate(playpen.robots)}
        for index, track in enumerate(tracks):
            default = None if time_scale is not None else _COLOURS[index % len(_COLOURS)]
            colour = colours.get(track.robot, default)
            _draw_path(axes, track, 1000 * radii.get(track.robot, BODY_RADIUS), colour, time_scale)
            if len(tracks) > 1 and track.robot and not colours:
                x_mm, y_mm = track.xy_mm[-1].tolist()
                labels.add(x_mm, y_mm, 1000 * radii.get(track.robot, BODY_RADIUS) + 4, track.robot)
        if has_scale and time_scale is not None:
            _draw_time_scale(figure, axes, time_scale)
        axes.axis(limits)
        labels.write()
        if len(legend) > 1:
            figure.legend(handles=legend, loc="lower center", ncols=columns, frameon=False, fontsize=8)
    return figure


def save(figure: Figure, file: StrPath, replace: bool = True) -> None:
    """Write a drawing as PNG, SVG or PDF, by the file's suffix; `replace` as for `write_drawing`.

    Raises:
        KhepTwinError: The suffix is not one of these, or the file cannot be written.
    """
    file = Path(file)
    kind = file.suffix.lower().removeprefix(".")
    if kind not in METADATA:
        raise KhepTwinError(f"{file}: expected a name that ends in .png, .svg or .pdf")
    write_drawing(file, picture(figure, kind), replace)


def picture(figure: Figure, kind: str, dpi: float = 160, box: Bbox | None = None) -> bytes:
    """Return a drawing, or a box of it [inch], as a file's bytes; `kind` is "png", "svg" or "pdf"."""
    data = BytesIO()
    with matplotlib.style.context(STYLE):
        figure.savefig(data, format=kind, dpi=dpi, bbox_inches=box, metadata=METADATA[kind])
    return data.getvalue()


def thumbnail(playpen: Playpen, longer_side: int = 200) -> bytes:
    """Return a small map without text, as PNG; the longer side in pixels."""
    figure = draw(playpen)
    axes = figure.axes[0]
    axes.set_axis_off()
    axes.set_title("", loc="left")
    figure.legends.clear()
    for text in list(axes.texts):
        text.remove()
    box = axes.get_window_extent().transformed(figure.dpi_scale_trans.inverted())
    return picture(figure, "png", longer_side / LONGER_SIDE, box)


def blank_figure(width: float, height: float, layout: Literal["constrained"] | None = None) -> Figure:
    """Return an empty figure of a size [inch]."""
    figure = Figure(figsize=(width, height), facecolor="white", layout=layout)
    FigureCanvasAgg(figure)
    return figure


def _make_axes(
    playpen: Playpen, longer_side: float, *, has_scale: bool, n_entries: int
) -> tuple[Figure, Axes, int]:
    """Return a figure, its axes in mm with margins, and the columns of its legend of `n_entries`."""
    arena = playpen.arena
    margin_mm = arena.wall_thickness_mm + 2
    width_mm, height_mm = arena.width_mm + 2 * margin_mm, arena.height_mm + 2 * margin_mm
    inch_per_mm = longer_side / max(width_mm, height_mm)
    width, height = max(width_mm * inch_per_mm, 2.5), max(height_mm * inch_per_mm, 1.0)
    left, right, top = 0.65, 0.95 if has_scale else 0.2, 0.42
    columns = max(min(n_entries, int((left + width + right) / _ENTRY)), 1)
    bottom = 0.65 + 0.2 * -(-n_entries // columns) if n_entries > 1 else 0.55
    size = left + width + right, bottom + height + top
    figure = blank_figure(*size)
    axes = figure.add_axes((left / size[0], bottom / size[1], width / size[0], height / size[1]))
    axes.set(xlim=(-margin_mm, arena.width_mm + margin_mm), ylim=(-margin_mm, arena.height_mm + margin_mm))
    axes.set(xlabel="x [mm]", ylabel="y [mm]", aspect="equal")
    axes.spines[:].set_visible(False)
    for axis, inches in ((axes.xaxis, width), (axes.yaxis, height)):
        axis.set_major_locator(MaxNLocator(nbins=max(round(1.5 * inches), 3), steps=[1, 2, 5, 10]))
    axes.grid(color=INK, alpha=0.10, lw=0.5)
    axes.set_axisbelow(False)
    return figure, axes, columns


def _colours_by_name(tracks: Sequence[DrawnPath]) -> dict[str, str]:
    """Return the colour of each name; empty for one name, or for too many."""
    names = dict.fromkeys(track.robot for track in tracks)
    return dict(zip(names, _COLOURS, strict=False)) if 1 < len(names) <= len(_COLOURS) else {}


def _time_scale(tracks: Sequence[DrawnPath]) -> Normalize | None:
    """Return the time scale of all paths; None if the times of one are unknown."""
    times = [track.time_s for track in tracks if track.time_s is not None]
    if not tracks or len(times) < len(tracks):
        return None
    first, last = min(float(time_s[0]) for time_s in times), max(float(time_s[-1]) for time_s in times)
    return Normalize(first, last if last > first else first + 1)


def _draw_path(
    axes: Axes, track: DrawnPath, radius_mm: float, colour: str | None, time_scale: Normalize | None
) -> None:
    """Draw a path in a colour, or if None by time, with its start, its end, and the robot's outline there."""
    subset = slice(None, None, -(-len(track.xy_mm) // POINT_LIMIT))
    points = track.xy_mm[subset]
    segments = list(np.stack((points[:-1], points[1:]), axis=1))
    if colour is None and track.time_s is not None:
        lines = LineCollection(segments, cmap=_time_colours(), norm=time_scale, lw=1.4, zorder=4)
        lines.set_array(track.time_s[subset][:-1])
    else:
        lines = LineCollection(segments, colors=colour, lw=1.4, zorder=4)
    lines.set_capstyle("round")
    axes.add_collection(lines, autolim=False)
    (start_x, start_y), (end_x, end_y) = track.xy_mm[[0, -1]].tolist()
    outline = Circle((end_x, end_y), radius_mm, fill=False, edgecolor=colour or INK, lw=0.9, ls="--")
    axes.add_patch(outline).set_zorder(6)
    axes.add_line(Line2D([start_x], [start_y], zorder=7, **_START_MARKER))
    look: Look = _END_MARKER | ({"mfc": colour} if colour else {})
    axes.add_line(Line2D([end_x], [end_y], zorder=7, **look))


def _time_colours() -> Colormap:
    # Plasma without its yellow end, which has too little contrast to an illuminated floor.
    plasma = matplotlib.colormaps["plasma"]
    return LinearSegmentedColormap.from_list("time", list(plasma(np.linspace(0, 0.8, 64))))


def _draw_time_scale(figure: Figure, axes: Axes, time_scale: Normalize) -> None:
    """Draw the time scale beside the playpen."""
    box, width = axes.get_position(), figure.get_figwidth()
    bar_axes = figure.add_axes((box.x1 + 0.12 / width, box.y0, 0.13 / width, box.height))
    scale = figure.colorbar(ScalarMappable(time_scale, _time_colours()), cax=bar_axes)
    scale.set_label("time [s]")
    bar_axes.spines[:].set_visible(False)


def _legend(playpen: Playpen, colours: Mapping[str, str], has_paths: bool) -> Iterator[Line2D | Patch]:
    obstacles = list(chain(*playpen.obstacles.values()))
    painted = (*obstacles, *playpen.patches)
    striped = (playpen.arena, *obstacles)
    stripes = (surface for part in striped for _, surface in part.stripes)
    surfaces = (
        *([] if playpen.arena.table else [playpen.arena.surface]),
        *(item.surface for item in painted),
        *stripes,
    )
    for surface in dict.fromkeys(surfaces):
        yield Patch(label=surface, **surface_look(playpen, surface, movable=False))
    if any(item.movable for item in obstacles):
        yield Patch(label="movable", **surface_look(playpen, "white", movable=True))
    if len(playpen.lamps) > 1 and playpen.lighting.mode != "all":
        order = "in sequence" if playpen.lighting.mode == "sequenced" else "at random"
        look: Look = {"marker": "o", "ms": 6, "mfc": "white", "mec": FILAMENT, "mew": 0.9, "ls": ""}
        yield Line2D([], [], label=f"one lamp on, {order}", **look)
    for name, colour in colours.items():
        yield Line2D([], [], label=name, color=colour, lw=1.4)
    if has_paths:
        yield Line2D([], [], label="start", ls="", **_START_MARKER)
        yield Line2D([], [], label="end", ls="", **_END_MARKER)
