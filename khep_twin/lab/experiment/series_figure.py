"""Figures of series: metrics over the runs, with mean and confidence interval."""

# matplotlib's own annotations leave keyword arguments open.
# pyright: reportUnknownMemberType=false

import math
from collections.abc import Sequence

import matplotlib.style
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from khep_twin.drawing.map import STYLE
from khep_twin.lab.experiment.measures import UNITS
from khep_twin.lab.experiment.series_files import Row
from khep_twin.lab.experiment.series_statistics import summary, values

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
        figure = Figure(figsize=(_WIDTH * across, _HEIGHT * down + 0.4), layout="constrained")
        FigureCanvasAgg(figure)
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
