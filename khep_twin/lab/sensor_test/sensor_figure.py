"""Figures of sensor tests: all sensors, a Khepera's arranged as on the robot, or one; of one or more runs.

Line images are drawn as a strip over the path, with the left pixel at the top; a single pixel like a sensor.

The abscissa of a straight drive is the distance to its end, 0 cm at the right. A turn is shown in degrees,
positive counter-clockwise. Several runs are thin lines, with their mean and a band of one standard deviation
on either side, over the common part of their paths.
"""

# matplotlib's own annotations leave keyword arguments open.
# pyright: reportUnknownMemberType=false

import textwrap
from collections.abc import Sequence

import matplotlib.style
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Circle, Rectangle
from matplotlib.ticker import MaxNLocator, MultipleLocator
from numpy.typing import NDArray

from khep_twin.drawing.map import STYLE, blank_figure
from khep_twin.drawing.symbols import INK, Look
from khep_twin.errors import SensorTestError
from khep_twin.lab.sensor_test.sensor_test import SensorRun
from khep_twin.robots.registry import find_family
from khep_twin.units import (
    BODY_RADIUS,
    SENSOR_LABELS,
    SENSOR_POSITIONS,
    WHEEL_BASE,
    WHEEL_RADIUS,
    WHEEL_WIDTH,
)

Floats = NDArray[np.float64]

AMBIENT_LIMIT = 525
"""Upper limit of the axis of ambient light [counts]; in the dark a sensor reads about 500."""

_GRID_POINTS = 400
_RUN, _MEAN = "#2f6fb0", "#c2452d"
_CELLS = ((1, 0), (0, 0), (0, 1), (0, 2), (0, 3), (1, 3), (2, 2), (2, 1))
"""Row and column of each sensor's axes, in the manual's order; the robot's front is up."""

_UNITS = {"linear": "distance to the end [cm]", "rotational": "turned counter-clockwise [degrees]"}


def draw(
    runs: Sequence[SensorRun], *, sensor: str | None = None, y_min: int = 0, grid: bool = False
) -> Figure:
    """Draw one or more runs of the same kind.

    Args:
        runs: Runs to draw, at least one.
        sensor: Name of a single sensor or pixel, e.g. "left 10"; by default all.
        y_min: Lower limit of the axis of counts.
        grid: If true, draw grid lines.

    Raises:
        SensorTestError: The sensor is unknown, the runs differ in kind, or there are no data.
    """
    check(runs, sensor=sensor, y_min=y_min)
    with matplotlib.style.context(STYLE):
        if sensor is not None:
            figure = blank_figure(6.4, 4.4)
            axes = figure.add_axes((0.11, 0.12, 0.86, 0.79 if len(runs) == 1 else 0.73))
            _draw_sensor(axes, runs, _names(runs).index(sensor), y_min, grid)
            axes.set_xlabel(_UNITS[runs[0].test.motion])
            axes.set_ylabel(runs[0].test.quantity.title)
            title = f"{sensor}: {', '.join(_facts(runs))}"
            axes.set_title(title, loc="left", fontsize=10, pad=6 if len(runs) == 1 else 25)
            if len(runs) > 1:
                # Above the axes, clear of the data.
                legend_style: Look = {"loc": "lower left", "bbox_to_anchor": (-0.015, 0.99)}
                axes.legend(ncols=3, fontsize=8, frameon=False, **legend_style)
        elif runs[0].test.what == "vision":
            figure = _draw_images(runs)
        else:
            figure = _draw_all(runs, y_min, grid)
    return figure


def check(runs: Sequence[SensorRun], *, sensor: str | None = None, y_min: int = 0) -> None:
    """Raise the errors of `draw`."""
    kinds = list(dict.fromkeys(f"{run.test.what}, {run.test.motion}" for run in runs))
    if len(kinds) != 1:
        raise SensorTestError(
            f"runs of {' and of '.join(kinds) or 'no kind'}; expected runs of one kind in a figure"
        )
    if sensor is not None and sensor not in (names := _names(runs)):
        problem = f"sensor = {sensor}: no such sensor"
        raise SensorTestError(problem, key="sensor", value=sensor, expected=names)
    if not all(len(run.dv) for run in runs):
        raise SensorTestError("a run without rows; expected runs with rows")
    if not 0 <= y_min < _limit(runs[0]):
        raise SensorTestError(f"y-min = {y_min}; expected 0 to {_limit(runs[0]) - 1} for {runs[0].test.what}")
    if len(runs) > 1:
        _common_range(runs)


def positions(run: SensorRun) -> Floats:
    """Return the rows' x values in the figure (n,): distance to the end [cm] or angle turned [degrees]."""
    if run.test.motion == "rotational":
        return run.travelled
    return abs(run.test.amount) - run.travelled * np.sign(run.test.amount)


def draw_strip(axes: Axes, strip: NDArray[np.generic], ends: tuple[float, float]) -> None:
    """Draw line images side by side, their left pixel at the top.

    Args:
        axes: Axes.
        strip: Greys, 0 to 255 (n_pixels, n).
        ends: Abscissas of the left and right end.
    """
    extent = (*ends, len(strip) - 0.5, -0.5)
    axes.imshow(strip, cmap="gray", vmin=0, vmax=255, aspect="auto", interpolation="none", extent=extent)
    axes.set_yticks([0, len(strip) - 1])


def mean_and_spread(runs: Sequence[SensorRun]) -> tuple[Floats, Floats, Floats]:
    """Return mean and spread of several runs, over their common range.

    Returns:
        Abscissas (m,) as in `positions`, mean readings (m, n), and sample standard deviations (m, n).

    Raises:
        SensorTestError: The runs do not overlap.
    """
    x = np.linspace(*_common_range(runs), _GRID_POINTS)
    counts = np.empty((len(runs), len(x), len(_names(runs))))
    for index, run in enumerate(runs):
        order = np.argsort(positions(run), kind="stable")
        for sensor in range(counts.shape[2]):
            counts[index, :, sensor] = np.interp(x, positions(run)[order], run.dv[order, 2 + sensor])
    return x, counts.mean(axis=0), counts.std(axis=0, ddof=min(len(runs) - 1, 1))


def _common_range(runs: Sequence[SensorRun]) -> tuple[float, float]:
    low = max(float(positions(run).min()) for run in runs)
    high = min(float(positions(run).max()) for run in runs)
    if not low < high:
        raise SensorTestError("the runs have no part of the path in common; expected runs over the same path")
    return low, high


def draw_body(axes: Axes) -> None:
    """Draw a robot's body and wheels [m], seen from above with the front up, on axes without a frame."""
    axes.set_axis_off()
    axes.set_aspect("equal")
    axes.add_patch(Circle((0, 0), BODY_RADIUS, facecolor="#eef2ee", edgecolor=INK, lw=0.9))
    for side in (-1, 1):
        corner = (side * WHEEL_BASE / 2 - WHEEL_WIDTH / 2, -WHEEL_RADIUS)
        axes.add_patch(Rectangle(corner, WHEEL_WIDTH, 2 * WHEEL_RADIUS, facecolor=INK, lw=0))


def _draw_all(runs: Sequence[SensorRun], y_min: int, grid: bool) -> Figure:
    """Draw all sensors around a Khepera, or row by row those of another robot, and the description."""
    names = _names(runs)
    is_khepera = names == SENSOR_LABELS
    places = _CELLS if is_khepera else [divmod(index, 4) for index in range(len(names))]
    n_rows = 3 if is_khepera else len(names) // 4 + 1
    figure = blank_figure(10.5, 7.6 / 3 * n_rows)
    edges = {"left": 0.07, "right": 0.985, "bottom": 0.225 / n_rows, "top": 1 - 0.135 / n_rows}
    cells = figure.add_gridspec(n_rows, 4, hspace=0.42, wspace=0.26, **edges)
    free = cells[n_rows - 1, 3].get_position(figure)
    for index, (name, (row, column)) in enumerate(zip(names, places, strict=True)):
        axes = figure.add_subplot(cells[row, column])
        _draw_sensor(axes, runs, index, y_min, grid)
        axes.set_title(name, fontsize=10)
        if column == 0 or (is_khepera and name == "back left"):
            axes.set_ylabel(runs[0].test.quantity.title)
        if row > 0 or not is_khepera:
            axes.set_xlabel(_UNITS[runs[0].test.motion], fontsize=8)
        if index == 0 and len(runs) > 1:
            handles, labels = axes.get_legend_handles_labels()
            # In the free cell of another robot, the description is below.
            corner = (0.985, 0.06) if is_khepera else (free.x0, free.y1)
            place = "lower right" if is_khepera else "upper left"
            figure.legend(handles, labels, loc=place, frameon=False, bbox_to_anchor=corner)
    if is_khepera:
        _draw_robot(figure.add_subplot(cells[1, 1:3]))
    text_place = (0.07, edges["bottom"]) if is_khepera else (free.x0, free.y0)
    text = figure.text(*text_place, "\n".join(_description(runs)), va="bottom", fontsize=9, linespacing=1.4)
    text.set_parse_math(False)  # a dollar in the text is a dollar
    return figure


def _draw_images(runs: Sequence[SensorRun]) -> Figure:
    """Draw the line images of each run over its path."""
    figure = blank_figure(8.0, 1.0 + 1.9 * len(runs))
    all_axes = [figure.add_subplot(len(runs), 1, row) for row in range(1, len(runs) + 1)]
    for axes, run in zip(all_axes, runs, strict=True):
        x = positions(run)
        order = np.argsort(x, kind="stable")
        ends = float(x.min()), float(x.max())
        grid_x = np.linspace(*ends, _GRID_POINTS)
        # Each column has the nearest reading.
        nearest = np.abs(x[order][None, :] - grid_x[:, None]).argmin(axis=1)
        strip = run.dv[order[nearest], 2:].T
        draw_strip(axes, strip, ends)
        axes.set_ylabel("pixel")
        if run.test.motion == "linear":
            axes.invert_xaxis()
    all_axes[0].set_title(", ".join(_facts(runs)), loc="left", fontsize=10)
    all_axes[-1].set_xlabel(_UNITS[runs[0].test.motion])
    figure.tight_layout()
    return figure


def _draw_sensor(axes: Axes, runs: Sequence[SensorRun], sensor: int, y_min: int, grid: bool) -> None:
    """Draw one sensor's counts over the path."""
    is_single = len(runs) == 1
    look: Look = {"lw": 1.1, "alpha": 1.0, "marker": "o"} if is_single else {"lw": 0.7, "alpha": 0.45}
    for number, run in enumerate(runs):
        label = f"{len(runs)} runs" if number == 0 else None
        axes.plot(positions(run), run.dv[:, 2 + sensor], color=_RUN, ms=2.6, label=label, **look)
    if not is_single:
        x, mean, spread = mean_and_spread(runs)
        low, high = mean[:, sensor] - spread[:, sensor], mean[:, sensor] + spread[:, sensor]
        axes.fill_between(x, low, high, color=_MEAN, alpha=0.22, lw=0, label="± 1 standard deviation")
        axes.plot(x, mean[:, sensor], color=_MEAN, lw=1.5, label="mean")
    amounts = [run.test.amount for run in runs]
    if runs[0].test.motion == "linear":
        longest = max(abs(amount) for amount in amounts)
        axes.set_xlim(1.02 * longest, -0.02 * longest)
        axes.xaxis.set_major_locator(MaxNLocator(nbins=7, steps=[1, 2, 5, 10]))
    else:
        low, high = min(*amounts, 0.0), max(*amounts, 0.0)
        axes.set_xlim(low - 0.02 * (high - low), high + 0.02 * (high - low))
        step = next(step for step in (15, 30, 90, 180) if high - low <= 4 * step)
        axes.xaxis.set_major_locator(MultipleLocator(step))
    # A margin keeps readings at the limits clear of the frame.
    margin = 0.02 * (_limit(runs[0]) - y_min)
    axes.set_ylim(y_min - margin, _limit(runs[0]) + margin)
    axes.yaxis.set_major_locator(MaxNLocator(nbins=6, steps=[1, 2, 5, 10]))
    axes.spines[["top", "right"]].set_visible(False)
    if grid:
        axes.grid(color=INK, alpha=0.16, lw=0.6)
        axes.set_axisbelow(True)


def _draw_robot(axes: Axes) -> None:
    """Draw the robot with its sensors, seen from above with the front up."""
    draw_body(axes)
    axes.set(xlim=(-0.07, 0.07), ylim=(-0.035, 0.036))
    for name, (forward, left) in zip(SENSOR_LABELS, SENSOR_POSITIONS, strict=True):
        axes.add_patch(Circle((-left, forward), 0.0016, facecolor=_RUN, lw=0))
        # Names are beside lateral sensors, and before or behind the others.
        if abs(left) > 0.012:
            axes.text(-1.22 * left, 1.4 * forward, name, ha="right" if left > 0 else "left", va="center")
        else:
            axes.text(-1.9 * left, 1.28 * forward, name, ha="center", va="center")
    for text in axes.texts:
        text.set_fontsize(8)


def _facts(runs: Sequence[SensorRun]) -> list[str]:
    """Return the settings of the test as short texts."""
    test = runs[0].test
    amounts = _span([round(run.test.amount, 1) for run in runs])
    speeds = [run.test.speed for run in runs if run.test.speed is not None]
    speed_facts = [f"speed {_span(speeds)}"] if len(speeds) == len(runs) else []
    return [test.what, f"{test.motion} {amounts} {test.unit}", *speed_facts]


def _description(runs: Sequence[SensorRun]) -> list[str]:
    """Return the settings of the test and the runs' text, if it is the same, as short lines."""
    text = runs[0].text if len({run.text for run in runs}) == 1 else ""
    return [*_facts(runs), *textwrap.wrap(text, 26, max_lines=5, placeholder=" …")]


def _span(values: Sequence[float]) -> str:
    low, high = min(values), max(values)
    return f"{low:g}" if low == high else f"{low:g} to {high:g}"


def _names(runs: Sequence[SensorRun]) -> tuple[str, ...]:
    return runs[0].test.quantity.names


def _limit(run: SensorRun) -> int:
    if run.test.what == "light":
        return round(AMBIENT_LIMIT / 500 * find_family(run.test.model).bars["light"].full)
    return run.test.quantity.limit
