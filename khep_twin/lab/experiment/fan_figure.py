"""Figure of branches of one run: the fan of their ways on the playpen, and how far they spread over time."""

# matplotlib's own annotations leave keyword arguments open.
# pyright: reportUnknownMemberType=false

from collections.abc import Sequence

import matplotlib.style
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Ellipse
from numpy.typing import NDArray

from khep_twin.clock import NS_PER_S
from khep_twin.drawing.map import STYLE, draw
from khep_twin.drawing.symbols import INK
from khep_twin.lab.experiment.branch import Plan, Way
from khep_twin.log.reader import read
from khep_twin.log.recorded import changes_of
from khep_twin.ports.replay import Setup

Floats = NDArray[np.float64]

_COLOURS = ("#2f6fb0", "#c2452d", "#3f8f4f", "#8a5fa8", "#b8862b", "#4a4a4a")
_PANEL = 3.6
"""Width of the panel of the spread [inch]."""

_MOMENTS = 4
"""Number of times at which the spread is drawn on the playpen."""

_COVERS_95 = 2.45
"""Radius of the circle that holds 95 % of a normal distribution in the plane, in standard deviations."""


def draw_fan(plan: Plan, ways: Sequence[Way]) -> Figure:
    """Draw branches of one run: before the moment a dark line, then each run; ellipses hold 95 % of them."""
    run = read(plan.log)
    at_s = plan.change.at_ns / NS_PER_S
    setup = Setup.of(plan.log)
    playpen = setup.playpen((*changes_of(plan.log, setup.label), plan.change))
    with matplotlib.style.context(STYLE):
        figure = draw(playpen, title=f"{plan.log.name}, {len(ways)} branches at {at_s:g} s")
        axes = figure.axes[0]
        for index, track in enumerate(run.robots.values()):
            before = track.pose[track.times_ns <= plan.change.at_ns]
            axes.plot(1e3 * before[:, 0], 1e3 * before[:, 1], color=INK, lw=1.2, zorder=4)
            colour = _COLOURS[index % len(_COLOURS)]
            strength = max(min(8 / len(ways), 0.9), 0.12)
            for way in ways:
                x, y = 1e3 * way.poses[:, index, :2].T
                axes.plot(x, y, color=colour, lw=0.8, alpha=strength, zorder=4)
            ends = 1e3 * np.array([way.poses[-1, index, :2] for way in ways])
            axes.plot(*ends.T, "o", color=colour, ms=2.5, zorder=5)
            axes.plot(*(1e3 * before[-1, :2]), "o", ms=4.5, mfc="white", mec=INK, zorder=7)
        panel = _panel_beside(figure)
        for index, name in enumerate(run.robots):
            _draw_spread(axes, panel, ways, index, _COLOURS[index % len(_COLOURS)], name, at_s)
        panel.set(xlabel="time [s]", ylabel="distance from the runs' mean [mm]")
        panel.set_ylim(bottom=0)
        panel.grid(color=INK, alpha=0.1, lw=0.5)
        if len(ways) > 1:
            panel.legend(frameon=False, fontsize=8, loc="upper left")
    return figure


def spread(ways: Sequence[Way], robot: int) -> tuple[Floats, Floats, Floats, Floats]:
    """Return how far ways spread, up to the end of the shortest one.

    Returns:
        Times (n,) [s], mean positions (n, 2) [m], and the root mean square and the 95th percentile of the
        distances from them (n,) [m].
    """
    length = min(len(way.times_s) for way in ways)
    places = np.stack([way.poses[:length, robot, :2] for way in ways])
    mean: Floats = places.mean(axis=0)
    away = np.hypot(*np.moveaxis(places - mean, 2, 0))
    rms: Floats = np.sqrt((away * away).mean(axis=0))
    most = np.asarray(np.percentile(away, 95, axis=0), np.float64)
    return ways[0].times_s[:length], mean, rms, most


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


def _draw_spread(
    axes: Axes, panel: Axes, ways: Sequence[Way], robot: int, colour: str, name: str, at_s: float
) -> None:
    if len(ways) < 2:
        return
    times_s, mean, rms, most = spread(ways, robot)
    panel.plot(times_s, 1e3 * rms, color=colour, lw=1.4, label=f"{name}, root mean square")
    panel.plot(times_s, 1e3 * most, color=colour, lw=0.9, ls="--", label="95 % of the runs")
    panel.axvline(at_s, color=INK, lw=0.6)
    length = len(times_s)
    for moment in np.linspace(length / _MOMENTS, length - 1, _MOMENTS).astype(int).tolist():
        places = np.stack([way.poses[moment, robot, :2] for way in ways])
        values, axes_of = np.linalg.eigh(np.cov(places.T))
        minor, major = 2e3 * _COVERS_95 * np.sqrt(np.maximum(values, 0))
        turn = np.degrees(np.arctan2(axes_of[1, 1], axes_of[0, 1]))
        x, y = (1e3 * mean[moment]).tolist()
        look = {"fill": False, "edgecolor": INK, "lw": 0.8, "ls": "--", "zorder": 6}
        axes.add_patch(Ellipse((x, y), major, minor, angle=turn, **look))
        axes.annotate(f"{times_s[moment]:.0f} s", (x, y), fontsize=7, color=INK, zorder=8, ha="center")
