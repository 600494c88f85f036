"""Labels of a drawing: each beside its object, without overlap and within the axes."""

# The annotations of matplotlib leave keyword arguments untyped.
# pyright: reportUnknownMemberType=false

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.patheffects import withStroke
from matplotlib.text import Text
from matplotlib.transforms import Bbox
from numpy.typing import NDArray

SEARCH_LIMIT = 200
"""Largest number of labels whose positions are optimised; with more, each is below its object."""

_LINES = 4
"""Number of distances to try, in lines of text."""

_Position = tuple[float, float, Literal["left", "center", "right"], Literal["top", "center", "bottom"]]


@dataclass(frozen=True, slots=True)
class _Label:
    x_mm: float
    y_mm: float
    clearance_mm: float
    text: str


class Labels:
    """Labels on axes in mm, collected while objects are drawn, and written when the limits are final.

    Args:
        axes: Axes in mm.
        ink: Colour of the text.
    """

    def __init__(self, axes: Axes, ink: str) -> None:
        self._axes = axes
        self._ink = ink
        self._labels: list[_Label] = []

    def add(self, x_mm: float, y_mm: float, clearance_mm: float, text: str) -> None:
        """Request a label beside a point, at least `clearance_mm` away from it."""
        self._labels.append(_Label(x_mm, y_mm, clearance_mm, text))

    def write(self) -> None:
        """Write all labels; later ones avoid earlier ones."""
        figure = self._axes.get_figure(root=True)
        if figure is None or not isinstance(figure.canvas, FigureCanvasAgg):
            raise TypeError("labels expected a figure with an Agg canvas")
        renderer = figure.canvas.get_renderer()
        limits = np.array(self._axes.get_window_extent(renderer).extents)
        is_searched = len(self._labels) <= SEARCH_LIMIT
        occupied = np.empty((0, 4))
        for label in self._labels:
            text = self._draw_below(label)
            if not is_searched:
                continue
            best_position, least_overlap = None, np.inf
            for position in _positions(label, self._to_height_mm(text.get_window_extent(renderer))):
                _set_position(text, position)
                overlap = _overlap(np.array(text.get_window_extent(renderer).extents), occupied, limits)
                if overlap < least_overlap:
                    best_position, least_overlap = position, overlap
                if overlap == 0:
                    break
            if best_position is not None:
                _set_position(text, best_position)
            occupied = np.vstack((occupied, text.get_window_extent(renderer).extents))

    def _draw_below(self, label: _Label) -> Text:
        # A pale outline keeps the text legible on top of other objects.
        outline = withStroke(linewidth=2.2, foreground=(1, 1, 1, 0.8))
        at = label.x_mm, label.y_mm - label.clearance_mm
        return self._axes.text(
            *at,
            label.text,
            ha="center",
            va="top",
            fontsize=7.5,
            color=self._ink,
            zorder=8,
            path_effects=[outline],
        )

    def _to_height_mm(self, box: Bbox) -> float:
        (_, low), (_, high) = self._axes.transData.inverted().transform([(0, box.y0), (0, box.y1)])
        return float(high - low)


def _positions(label: _Label, line_mm: float) -> Iterator[_Position]:
    """Yield positions and alignments of a label, best first: below, above, right, left, then farther away."""
    x, y, clearance = label.x_mm, label.y_mm, label.clearance_mm
    for line in range(_LINES):
        extra = 1.1 * line * line_mm
        yield x, y - clearance - extra, "center", "top"
        yield x, y + clearance + extra, "center", "bottom"
        for shift in {extra: None, -extra: None}:
            yield x + clearance, y + shift, "left", "center"
            yield x - clearance, y + shift, "right", "center"


def _set_position(text: Text, position: _Position) -> None:
    text.set_position(position[:2])
    text.set_horizontalalignment(position[2])
    text.set_verticalalignment(position[3])


def _overlap(box: NDArray[np.float64], occupied: NDArray[np.float64], limits: NDArray[np.float64]) -> float:
    """Return the area of a box (x0, y0, x1, y1) that overlaps boxes (n, 4) or is outside of `limits`."""
    shared = np.minimum(box[2:], occupied[:, 2:]) - np.maximum(box[:2], occupied[:, :2])
    inside = np.minimum(box[2:], limits[2:]) - np.maximum(box[:2], limits[:2])
    outside = np.prod(box[2:] - box[:2]) - np.prod(np.maximum(inside, 0))
    return float(np.prod(np.maximum(shared, 0), axis=1).sum() + outside)
