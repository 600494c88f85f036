"""Figures of series and of branches.

Of a series: metrics over the runs, with mean and confidence interval. Of branches of one run: trajectories
on the playpen, and how far they spread over time.
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
from khep_twin.drawing.map import STYLE, sheet
from khep_twin.drawing.map import draw as draw_map
from khep_twin.drawing.symbols import INK
from khep_twin.lab.experiment.branch import BranchPlan, Trajectory
from khep_twin.lab.experiment.measures import UNITS
from khep_twin.lab.experiment.run_statistics import Floats
from khep_twin.lab.experiment.series_files import Row
from khep_twin.lab.experiment.series_statistics import summary, values
from khep_twin.log.reader import read_log
from khep_twin.log.recorded import changes_of
from khep_twin.ports.replay import Setup

_SHOWN = ("fitness", "distance_m", "collisions", "near_share", "light_gained", "coverage")
"""Columns drawn by default."""

_COLOURS = ("#2f6fb0", "#c2452d", "#3f8f4f", "#8a5fa8", "#b8862b", "#4a4a4a")
_WIDTH, _HEIGHT = 3.9, 2.5


def shown(names: Sequence[str]) -> list[str]:
    """Return those of these columns that are drawn by default."""
    return [name for name in _SHOWN if name in names] or list(names[:6])


def draw(labels: Sequence[str], series: Sequence[Sequence[Row]], names: Sequence[str]) -> Figure:
    """Draw columns of one series or several, a panel each."""
    across = min(len(names), 2 if len(names) < 5 else 3)
    down = math.ceil(len(names) / across)
    with matplotlib.style.context(STYLE):
        figure = sheet(_WIDTH * across, _HEIGHT * down + 0.4, "constrained")
        panels: list[Axes] = [figure.add_subplot(down, across, place) for place in range(1, len(names) + 1)]
        for axes, name in zip(panels, names, strict=True):
            _panel(axes, labels, series, name)
        for axes in panels[-across:]:
            axes.set_xlabel("run")
        title = "points are runs; at the right mean and 95 % confidence"
        handles, texts = panels[0].get_legend_handles_labels()
        figure.legend(handles, texts, loc="outside upper left", ncols=4, title=title, alignment="left")
    return figure


def _panel(axes: Axes, labels: Sequence[str], series: Sequence[Sequence[Row]], name: str) -> None:
    last = max(int(row["run"]) for rows in series for row in rows)
    for index, (label, rows) in enumerate(zip(labels, series, strict=True)):
        colour = _COLOURS[index % len(_COLOURS)]
        found = [(int(row["run"]), float(row[name])) for row in rows if values([row], name)]
        if not found:
            continue
        runs, numbers = zip(*found, strict=True)
        axes.plot(runs, numbers, "o-", ms=3, lw=0.7, color=colour, label=label)
        told = summary(numbers)
        place = last + max(1.0, last * 0.06) * (1 + 0.5 * index)
        ci95 = 0.0 if math.isnan(told.ci95) else told.ci95
        axes.errorbar([place], [told.mean], [ci95], fmt="D", ms=4, capsize=3, color=colour)
    axes.set_ylabel(f"{name} [{UNITS[name]}]" if UNITS.get(name) else name)
    ticks = MaxNLocator(integer=True).tick_values(1, max(last, 2))
    axes.set_xticks([tick for tick in ticks if 1 <= tick <= last])
    # From 0, if nothing lies below.
    low, high = (0.0 if axes.dataLim.y0 >= 0 else axes.get_ylim()[0]), axes.get_ylim()[1]
    axes.set_ylim(low, high + 0.05 * (high - low))


_PANEL = 3.6
"""Width of the panel of the spread [inch]."""

_MOMENTS = 4
"""Number of times at which the places of all runs are marked."""


def draw_fan(plan: BranchPlan, trajectories: Sequence[Trajectory]) -> Figure:
    """Draw branches of one run: a dark line up to the moment, then each run, and how far they spread."""
    run = read_log(plan.log)
    at_s = plan.change.at_ns / NS_PER_S
    setup = Setup.of(plan.log)
    playpen = setup.playpen((*changes_of(plan.log, setup.label), plan.change))
    with matplotlib.style.context(STYLE):
        figure = draw_map(playpen, title=f"{plan.log.name}, {len(trajectories)} branches at {at_s:g} s")
        axes = figure.axes[0]
        for index, track in enumerate(run.robots.values()):
            before = track.pose[track.times_ns <= plan.change.at_ns]
            axes.plot(1e3 * before[:, 0], 1e3 * before[:, 1], color=INK, lw=1.2, zorder=4)
            colour = _COLOURS[index % len(_COLOURS)]
            strength = max(min(8 / len(trajectories), 0.9), 0.12)
            for trajectory in trajectories:
                x, y = 1e3 * trajectory.poses[:, index, :2].T
                axes.plot(x, y, color=colour, lw=0.8, alpha=strength, zorder=4)
            axes.plot(*(1e3 * before[-1, :2]), "o", ms=4.5, mfc="white", mec=INK, zorder=7)
        panel = _panel_beside(figure)
        for index, name in enumerate(run.robots):
            colour, (times_s, rms, most) = _COLOURS[index % len(_COLOURS)], spread(trajectories, index)
            panel.plot(times_s, 1e3 * rms, color=colour, lw=1.4, label=f"{name}, root mean square")
            panel.plot(times_s, 1e3 * most, color=colour, lw=0.9, ls="--", label="95 % of the runs")
        _mark_moments(axes, panel, trajectories)
        panel.set(xlabel="time [s]", ylabel="distance from the runs' mean [mm]")
        panel.set_ylim(bottom=0)
        panel.grid(color=INK, alpha=0.1, lw=0.5)
        panel.legend(framealpha=1.0, edgecolor="none", fontsize=8, loc="upper left")
    return figure


def spread(trajectories: Sequence[Trajectory], robot: int) -> tuple[Floats, Floats, Floats]:
    """Return how far trajectories spread, up to the end of the shortest one.

    Returns:
        Times (n,) [s], and the root mean square and the 95th percentile of the distances from the mean
        positions (n,) [m].
    """
    length = min(len(trajectory.times_s) for trajectory in trajectories)
    places = np.stack([trajectory.poses[:length, robot, :2] for trajectory in trajectories])
    away = np.hypot(*np.moveaxis(places - places.mean(axis=0), 2, 0))
    rms: Floats = np.sqrt((away * away).mean(axis=0))
    most = np.asarray(np.percentile(away, 95, axis=0), np.float64)
    return trajectories[0].times_s[:length], rms, most


def _panel_beside(figure: Figure) -> Axes:
    """Widen a figure by a panel at the right of what is there."""
    width, height = figure.get_size_inches()
    share = width / (width + _PANEL)
    boxes = [axes.get_position() for axes in figure.axes]
    figure.set_size_inches(width + _PANEL, height)
    for axes, box in zip(figure.axes, boxes, strict=True):
        axes.set_position((box.x0 * share, box.y0, box.width * share, box.height))
    lowest = boxes[0]
    left = share + 0.55 / (width + _PANEL)
    return figure.add_axes((left, lowest.y0, 1 - left - 0.15 / (width + _PANEL), lowest.height))


def _mark_moments(axes: Axes, panel: Axes, trajectories: Sequence[Trajectory]) -> None:
    """Mark where all runs are at some moments, in a colour each."""
    length = min(len(trajectory.times_s) for trajectory in trajectories)
    moments = np.linspace(length / _MOMENTS, length - 1, _MOMENTS).astype(int).tolist()
    colours = matplotlib.colormaps["plasma"](np.linspace(0, 0.8, _MOMENTS))
    for moment, colour in zip(moments, colours, strict=True):
        x, y = 1e3 * np.concatenate([trajectory.poses[moment, :, :2] for trajectory in trajectories]).T
        axes.plot(x, y, "o", color=colour, ms=4, mec="white", mew=0.5, zorder=6)
        time_s = float(trajectories[0].times_s[moment])
        panel.axvline(time_s, color=colour, lw=1.0, ls=":", label=f"dots at {time_s:.1f} s")
