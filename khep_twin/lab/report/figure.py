"""Figures of a report: sensors and wheels over time, red during contact."""

# matplotlib's own annotations leave keyword arguments open.
# pyright: reportUnknownMemberType=false

from collections.abc import Iterable, Sequence
from functools import partial
from textwrap import fill

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

from khep_twin.drawing.symbols import INK, Look
from khep_twin.lab.experiment.run_statistics import NEAR_COUNTS, Floats
from khep_twin.lab.report.report import RobotReport
from khep_twin.lab.sensor_test.sensor_figure import AMBIENT_LIMIT, draw_strip
from khep_twin.log.reader import TimeSeries

POINT_LIMIT = 2000
"""Largest number of points of a curve; longer ones are drawn as the extremes of this many intervals."""

_SENSOR_HEIGHT, WHEEL_HEIGHT, VISION_HEIGHT, EXTRA_HEIGHT = 0.6125, 2.9, 1.9, 4.6
"""Heights of a sensor and of the figures [inch]."""

_PROXIMITY, _AMBIENT = "#2f6fb0", "#b8860b"
_SPEED, _SETPOINT, _CONTACT = "#2f7d5b", "#2b2f36", "#c2452d"
_MAX_MARKS = 300

Values = NDArray[np.int64] | Floats

WIDTH = 7.1
"""Width of the figures and of a page's text [inch]."""


def draw_sensors(figure: Figure, robot: RobotReport, corner: tuple[float, float]) -> None:
    """Draw proximity and ambient light, a strip for each sensor; the corner is the lower left [inch]."""
    sensor_kinds = (
        ("proximity", robot.proximity, _PROXIMITY, (0, robot.model.bars["proximity"].full)),
        ("ambient", robot.ambient, _AMBIENT, (0, max(AMBIENT_LIMIT, _max_value(robot.ambient)))),
    )
    titles = [f"{name} [counts]" for name, *_ in sensor_kinds]
    names = [fill(name, 12) for name in robot.model.body.sensors]
    columns = sensor_panels(figure, corner, sensor_height(names), titles, -0.11, names)
    for panels, (name, series, colour, limits) in zip(columns, sensor_kinds, strict=True):
        for sensor, axes in enumerate(panels):
            if series is not None:
                _draw_sensor_curve(axes, series, sensor, colour, None if name == "proximity" else robot.dark)
            axes.set(ylim=limits, yticks=limits if sensor == 0 else [], xlim=_time_limits(robot))
            _mark_contacts(axes, robot)
            if series is None and sensor == 3:
                axes.text(0.5, 0.5, "not in this log", transform=axes.transAxes, ha="center", va="center")


def sensor_height(names: Sequence[str]) -> float:
    """Return the height of the figure of sensors with these names [inch]."""
    return _SENSOR_HEIGHT * len(names)


def draw_extra(figure: Figure, robot: RobotReport, corner: tuple[float, float]) -> None:
    """Draw the further sensors of a robot's model; the corner is the lower left [inch]."""
    grid = axes_edges(figure, corner, EXTRA_HEIGHT, left=0.7, right=0.1)
    cells = figure.add_gridspec(len(robot.extra), 1, hspace=0.35, **grid)
    for row, (name, series) in enumerate(robot.extra.items()):
        axes = figure.add_subplot(cells[row, 0])
        style_time_axes(axes)
        times_s, values = series.times_ns / 1e9, series.values.astype(np.float64)
        if name == "ultrasonic" and robot.model.body.sonar is not None:
            values[np.isin(values, robot.model.body.sonar.codes)] = np.nan
        columns = robot.model.channels[name]
        for (column, _), curve in zip(columns, values.T, strict=True):
            label = column.removeprefix(f"{name}_").replace("_", " ")
            axes.plot(*thin_curve(times_s, curve), lw=0.8, label=label)
        axes.set_title(f"{name} [{columns[0][1]}]", fontsize=9, loc="left", color=INK)
        axes.set_xlim(_time_limits(robot))
        legend_style: Look = {"loc": "lower right", "bbox_to_anchor": (1, 0.98), "ncols": len(columns)}
        axes.legend(fontsize=8, frameon=False, borderpad=0, **legend_style)
        axes.tick_params(labelbottom=row == len(robot.extra) - 1)
    figure.axes[-1].set_xlabel("time [s]", fontsize=8)


def draw_wheels(figure: Figure, robot: RobotReport, corner: tuple[float, float]) -> None:
    """Draw both wheels' speeds with their setpoints; the corner is the lower left [inch]."""
    grid = axes_edges(figure, corner, WHEEL_HEIGHT, left=0.7, right=0.57)
    cells = figure.add_gridspec(2, 1, hspace=0.2, **grid)
    model = robot.model
    scale = 1 if model.interface is None else model.interface.speed_per_pulse
    mm_s_per_speed, unit = 1e5 * model.body.pulse_length / scale, model.channels["speed"][0][1]
    for side, name in enumerate(("left", "right")):
        axes = figure.add_subplot(cells[side, 0])
        if robot.speed is not None:
            times_s, values = robot.speed.times_ns / 1e9, robot.speed.values
            look: Look = {"lw": 0.9, "drawstyle": "steps-post"}
            axes.plot(*thin_curve(times_s, values[:, side]), color=_SPEED, label="speed", **look)
            setpoint = thin_curve(times_s, values[:, 2 + side])
            axes.plot(*setpoint, color=_SETPOINT, ls=(0, (4, 2)), label="setpoint", **look)
        _mark_contacts(axes, robot)
        axes.set_xlim(_time_limits(robot))
        axes.set_ylabel(f"{name}\n[{unit}]", fontsize=8)
        axes.tick_params(labelsize=7, length=2)
        axes.spines[["top", "right"]].set_visible(False)
        axes.grid(color=INK, alpha=0.1, lw=0.5)
        axes.yaxis.set_major_locator(MaxNLocator(5, integer=True))
        functions = partial(np.multiply, mm_s_per_speed), partial(np.multiply, 1 / mm_s_per_speed)
        right_axis = axes.secondary_yaxis("right", functions=functions)
        right_axis.set_ylabel("[mm/s]", fontsize=8)
        right_axis.tick_params(labelsize=7, length=2)
        right_axis.spines["right"].set_visible(False)
        if side == 0:
            axes.tick_params(labelbottom=False)
            axes.set_title("wheel speeds", fontsize=9, loc="left", color=INK)
            handles, labels = axes.get_legend_handles_labels()
            legend_style: Look = {"loc": "lower right", "bbox_to_anchor": (1, 0.98)}
            axes.legend(handles, labels, ncols=3, fontsize=8, frameon=False, borderpad=0, **legend_style)
        else:
            axes.set_xlabel("time [s]", fontsize=8)


def draw_vision(figure: Figure, robot: RobotReport, corner: tuple[float, float]) -> None:
    """Draw the line images over time, their left pixel at the top; the corner is the lower left [inch]."""
    if robot.vision is None:
        return
    grid = axes_edges(figure, corner, VISION_HEIGHT, left=0.7, right=0.57)
    axes = figure.add_subplot(figure.add_gridspec(1, 1, **grid)[0, 0])
    start_s, end_s = _time_limits(robot)
    # Each column is the last image before its time.
    column_times_ns = np.linspace(start_s, end_s, POINT_LIMIT) * 1e9
    rows = np.searchsorted(robot.vision.times_ns, column_times_ns, side="right") - 1
    images = np.where(rows[:, None] >= 0, robot.vision.values[np.maximum(rows, 0)], 0)
    draw_strip(axes, images.T, (start_s, end_s))
    axes.set_title("line image [greys, left pixel at the top]", fontsize=9, loc="left", color=INK)
    axes.set_ylabel("pixel", fontsize=8)
    axes.set_xlabel("time [s]", fontsize=8)
    axes.tick_params(labelsize=7, length=2)


def sensor_panels(
    figure: Figure,
    corner: tuple[float, float],
    height: float,
    titles: Sequence[str],
    label_x: float,
    names: Sequence[str],
) -> list[list[Axes]]:
    """Return axes for each sensor over time, in a column for each title.

    Args:
        figure: Figure to draw in.
        corner: Lower left corner [inch].
        height: Total height [inch].
        titles: Titles of both columns.
        label_x: Abscissa of the sensors' names, in widths of the axes.
        names: Names of the sensors, in lines that fit.
    """
    grid = axes_edges(figure, corner, height, left=0.98, right=0.1)
    cells = figure.add_gridspec(len(names), 2, hspace=0.22, wspace=0.14, **grid)
    rows = range(len(names))
    columns = [[figure.add_subplot(cells[row, column]) for row in rows] for column in range(2)]
    for panels, title in zip(columns, titles, strict=True):
        panels[0].set_title(title, fontsize=9, loc="left", color=INK)
        panels[-1].set_xlabel("time [s]", fontsize=8)
        for axes in panels:
            style_time_axes(axes)
            axes.tick_params(labelbottom=axes is panels[-1])
    label_style: Look = {"rotation": 0, "ha": "right", "va": "center", "fontsize": 8}
    for axes, name in zip(columns[0], names, strict=True):
        axes.set_ylabel(name, **label_style)
        axes.yaxis.set_label_coords(label_x, 0.5)
    return columns


def style_time_axes(axes: Axes) -> None:
    """Set small ticks at round times on axes, and remove their frame."""
    axes.tick_params(labelsize=7, length=2)
    axes.spines[["top", "right"]].set_visible(False)
    axes.xaxis.set_major_locator(MaxNLocator(7, steps=[1, 2, 5, 10]))


def axes_edges(
    figure: Figure, corner: tuple[float, float], height: float, *, left: float, right: float
) -> dict[str, float]:
    """Return the relative edges of axes in a figure, with margins for labels [inch]."""
    figure_width, figure_height = figure.get_size_inches().tolist()
    x, y = corner
    return {
        "left": (x + left) / figure_width,
        "right": (x + WIDTH - right) / figure_width,
        "bottom": (y + 0.48) / figure_height,
        "top": (y + height - 0.32) / figure_height,
    }


def _draw_sensor_curve(axes: Axes, series: TimeSeries, sensor: int, colour: str, dark: float | None) -> None:
    """Draw one sensor: proximity filled from below, ambient light from the dark level."""
    times_s, values = thin_curve(series.times_ns / 1e9, series.values[:, sensor])
    base = 0.0 if dark is None else dark
    axes.fill_between(times_s, values, base, color=colour, alpha=0.4, lw=0)
    axes.plot(times_s, values, color=colour, lw=0.7)
    axes.axhline(NEAR_COUNTS if dark is None else dark, color=INK, alpha=0.4, lw=0.5, ls=":")


def thin_curve(times_s: Floats, values: Values) -> tuple[Floats, Values]:
    """Return a curve with at most two points, the extremes, for each of `POINT_LIMIT` intervals."""
    if len(values) <= 2 * POINT_LIMIT:
        return times_s, values
    interval_starts = np.linspace(0, len(values), POINT_LIMIT + 1).astype(int)[:-1]
    low, high = np.minimum.reduceat(values, interval_starts), np.maximum.reduceat(values, interval_starts)
    return np.repeat(times_s[interval_starts], 2), np.column_stack([low, high]).ravel()


def _mark_contacts(axes: Axes, robot: RobotReport) -> None:
    spans: Iterable[list[float]] = robot.contact[:_MAX_MARKS].tolist()
    for number, (start_s, end_s) in enumerate(spans):
        label = "in touch with something" if number == 0 else None
        axes.axvspan(start_s, end_s, color=_CONTACT, alpha=0.18, lw=0.6, label=label, zorder=0)


def _time_limits(robot: RobotReport) -> tuple[float, float]:
    """Return the times of the run's start and the last value [s]."""
    all_series = (robot.proximity, robot.ambient, robot.speed)
    ends_s = (float(series.times_ns[-1]) / 1e9 for series in all_series if series is not None)
    last_s = max(ends_s, default=0.0)
    return 0.0, last_s or 1.0


def _max_value(series: TimeSeries | None) -> int:
    return 0 if series is None else int(series.values.max(initial=0))
