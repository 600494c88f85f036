"""Figures of series and of branches.

A series is drawn as metrics over the runs, with mean and confidence interval. Branches of one run are drawn
as trajectories on the playpen, and as their spread over time.
"""

# matplotlib's own annotations leave keyword arguments open.
# pyright: reportUnknownMemberType=false

import math
from collections.abc import Sequence

import matplotlib.style
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from khep_twin.clock import NS_PER_S
from khep_twin.drawing.map import STYLE, blank_figure
from khep_twin.drawing.map import draw as draw_map
from khep_twin.drawing.symbols import INK
from khep_twin.lab.experiment.branch import BranchPlan, Trajectory
from khep_twin.lab.experiment.measures import UNITS
from khep_twin.lab.experiment.run_statistics import Floats
from khep_twin.lab.experiment.series_files import Row
from khep_twin.lab.experiment.series_statistics import finite_values, summarize
from khep_twin.log.reader import read_log
from khep_twin.log.recorded import read_changes
from khep_twin.ports.replay import Setup

_DEFAULT_COLUMNS = ("fitness", "distance_m", "collisions", "near_share", "light_gained", "coverage")
"""Columns drawn by default."""

_COLOURS = ("#2f6fb0", "#c2452d", "#3f8f4f", "#8a5fa8", "#b8862b", "#4a4a4a")
_COLUMN_WIDTH, _COLUMN_HEIGHT = 3.9, 2.5  # of a panel [inch]


def default_columns(names: Sequence[str]) -> list[str]:
    """Return the columns to draw by default."""
    return [name for name in _DEFAULT_COLUMNS if name in names] or list(names[:6])


def draw(labels: Sequence[str], series: Sequence[Sequence[Row]], names: Sequence[str]) -> Figure:
    """Draw columns of one or several series, one panel per column."""
    n_columns = min(len(names), 2 if len(names) < 5 else 3)
    n_rows = math.ceil(len(names) / n_columns)
    with matplotlib.style.context(STYLE):
        figure = blank_figure(_COLUMN_WIDTH * n_columns, _COLUMN_HEIGHT * n_rows + 0.4, "constrained")
        panels: list[Axes] = [figure.add_subplot(n_rows, n_columns, n + 1) for n in range(len(names))]
        for axes, name in zip(panels, names, strict=True):
            _draw_column(axes, labels, series, name)
        for axes in panels[-n_columns:]:
            axes.set_xlabel("run")
        title = "points are runs; at the right mean and 95 % confidence"
        handles, texts = panels[0].get_legend_handles_labels()
        figure.legend(handles, texts, loc="outside upper left", ncols=4, title=title, alignment="left")
    return figure


def _draw_column(axes: Axes, labels: Sequence[str], series: Sequence[Sequence[Row]], name: str) -> None:
    last_run = max(int(row["run"]) for rows in series for row in rows)
    for index, (label, rows) in enumerate(zip(labels, series, strict=True)):
        colour = _COLOURS[index % len(_COLOURS)]
        points = [(int(row["run"]), float(row[name])) for row in rows if finite_values([row], name)]
        if not points:
            continue
        runs, numbers = zip(*points, strict=True)
        axes.plot(runs, numbers, "o-", ms=3, lw=0.7, color=colour, label=label)
        statistics = summarize(numbers)
        x = last_run + max(1.0, last_run * 0.06) * (1 + 0.5 * index)
        ci95 = 0.0 if math.isnan(statistics.ci95) else statistics.ci95
        axes.errorbar([x], [statistics.mean], [ci95], fmt="D", ms=4, capsize=3, color=colour)
    axes.set_ylabel(f"{name} [{UNITS[name]}]" if UNITS.get(name) else name)
    ticks = MaxNLocator(integer=True).tick_values(1, max(last_run, 2))
    axes.set_xticks([tick for tick in ticks if 1 <= tick <= last_run])
    # The axis starts at 0 unless values are negative.
    low, high = (0.0 if axes.dataLim.y0 >= 0 else axes.get_ylim()[0]), axes.get_ylim()[1]
    axes.set_ylim(low, high + 0.05 * (high - low))


_SPREAD_WIDTH = 3.6
"""Width of the panel of the spread [inch]."""
_N_MARKS = 4
"""Number of times at which the positions of all runs are marked."""


def draw_fan(plan: BranchPlan, trajectories: Sequence[Trajectory]) -> Figure:
    """Draw branches of one run: a dark line up to the branch point, then each branch, and their spread."""
    run = read_log(plan.log)
    branch_s = plan.change.at_ns / NS_PER_S
    setup = Setup.of(plan.log)
    playpen = setup.playpen((*read_changes(plan.log, setup.label), plan.change))
    with matplotlib.style.context(STYLE):
        figure = draw_map(playpen, title=f"{plan.log.name}, {len(trajectories)} branches at {branch_s:g} s")
        axes = figure.axes[0]
        for robot_index, track in enumerate(run.robots.values()):
            past_poses = track.pose[track.times_ns <= plan.change.at_ns]
            axes.plot(1e3 * past_poses[:, 0], 1e3 * past_poses[:, 1], color=INK, lw=1.2, zorder=4)
            colour = _COLOURS[robot_index % len(_COLOURS)]
            opacity = max(min(8 / len(trajectories), 0.9), 0.12)
            for trajectory in trajectories:
                x, y = 1e3 * trajectory.poses[:, robot_index, :2].T
                axes.plot(x, y, color=colour, lw=0.8, alpha=opacity, zorder=4)
            axes.plot(*(1e3 * past_poses[-1, :2]), "o", ms=4.5, mfc="white", mec=INK, zorder=7)
        panel = _add_panel(figure)
        for robot_index, name in enumerate(run.robots):
            colour = _COLOURS[robot_index % len(_COLOURS)]
            times_s, rms, p95 = spread(trajectories, robot_index)
            panel.plot(times_s, 1e3 * rms, color=colour, lw=1.4, label=f"{name}, root mean square")
            panel.plot(times_s, 1e3 * p95, color=colour, lw=0.9, ls="--", label="95 % of the runs")
        _mark_times(axes, panel, trajectories)
        panel.set(xlabel="time [s]", ylabel="distance from the runs' mean [mm]")
        panel.set_ylim(bottom=0)
        panel.grid(color=INK, alpha=0.1, lw=0.5)
        panel.legend(framealpha=1.0, edgecolor="none", fontsize=8, loc="upper left")
    return figure


def spread(trajectories: Sequence[Trajectory], robot: int) -> tuple[Floats, Floats, Floats]:
    """Return the spread of trajectories, up to the end of the shortest one.

    Returns:
        Times (n,) [s], and the root mean square and 95th percentile of the distances from the mean positions
        (n,) [m].
    """
    length = min(len(trajectory.times_s) for trajectory in trajectories)
    positions = np.stack([trajectory.poses[:length, robot, :2] for trajectory in trajectories])
    distances = np.hypot(*np.moveaxis(positions - positions.mean(axis=0), 2, 0))
    rms: Floats = np.sqrt((distances * distances).mean(axis=0))
    p95 = np.asarray(np.percentile(distances, 95, axis=0), np.float64)
    return trajectories[0].times_s[:length], rms, p95


def _add_panel(figure: Figure) -> Axes:
    """Widen a figure and add a panel at its right."""
    width, height = figure.get_size_inches()
    width_share = width / (width + _SPREAD_WIDTH)
    boxes = [axes.get_position() for axes in figure.axes]
    figure.set_size_inches(width + _SPREAD_WIDTH, height)
    for axes, box in zip(figure.axes, boxes, strict=True):
        axes.set_position((box.x0 * width_share, box.y0, box.width * width_share, box.height))
    map_box = boxes[0]
    left = width_share + 0.55 / (width + _SPREAD_WIDTH)
    return figure.add_axes((left, map_box.y0, 1 - left - 0.15 / (width + _SPREAD_WIDTH), map_box.height))


def _mark_times(axes: Axes, panel: Axes, trajectories: Sequence[Trajectory]) -> None:
    """Mark the positions of all runs at a few times, in one colour per time."""
    length = min(len(trajectory.times_s) for trajectory in trajectories)
    samples = np.linspace(length / _N_MARKS, length - 1, _N_MARKS).astype(int).tolist()
    colours = matplotlib.colormaps["plasma"](np.linspace(0, 0.8, _N_MARKS))
    for sample, colour in zip(samples, colours, strict=True):
        x, y = 1e3 * np.concatenate([trajectory.poses[sample, :, :2] for trajectory in trajectories]).T
        axes.plot(x, y, "o", color=colour, ms=4, mec="white", mew=0.5, zorder=6)
        time_s = float(trajectories[0].times_s[sample])
        panel.axvline(time_s, color=colour, lw=1.0, ls=":", label=f"dots at {time_s:.1f} s")
