"""The Khepera Toolbox's khepbase: the robot from above with bars for sensors and speeds, cycle by cycle.

    khepbase()                                       # once
    khepbase(rps(2), rls(2), rms(2))                 # in each cycle

At each sensor stands a pair of bars, proximity (0 to 1023) and ambient light (0 to 500, as counted: long in
the dark), beside each wheel its speed (0 to 20 pulses/10 ms, downwards when it drives backwards). It is a
window where there is a screen; else a picture that is written anew each time.
`khep_twin.sensing.bars` has what fills a bar.
"""

# matplotlib's own annotations leave keyword arguments open.
# pyright: reportUnknownMemberType=false

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from khep_twin.errors import KhepTwinError
from khep_twin.files.drawings import is_replaceable, write_drawing
from khep_twin.files.paths import StrPath
from khep_twin.sensing.bars import BARS
from khep_twin.toolbox.windows import refresh, show
from khep_twin.units import SENSOR_POSITIONS, WHEEL_BASE

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.patches import Rectangle

Floats = NDArray[np.float64]

_BAR, _WIDTH = 0.012, 0.0028
"""Height of a full bar, and width of any [m]."""

_PROXIMITY, _LIGHT, _SPEED, _EMPTY = "#e4572e", "#f4c846", "#4dabf7", "#f1f1ef"
_DPI = 90


def khepbase(
    prox_data: ArrayLike | None = None,
    light_data: ArrayLike | None = None,
    motor_speed: ArrayLike | None = None,
    *,
    picture: StrPath | None = None,
) -> Path | None:
    """Open the view of the robot, or update the readings and speeds in it.

    Args:
        prox_data: Proximity (8,), 0 to 1023; without any data the view is opened.
        light_data: Ambient light (8,), 0 to 500.
        motor_speed: Speeds of the left and the right wheel (2,) [pulses/10 ms], -20 to 20.
        picture: PNG to write instead of a window, when it is opened; without, "khepbase.png" where there
            is no screen.

    Returns:
        The picture that was written; None for a window.

    Raises:
        ValueError: Not all values are given, or there are too few of them.
        KhepTwinError: The view was not opened before, or the picture cannot be written.
    """
    given = [value is not None for value in (prox_data, light_data, motor_speed)]
    if not any(given):
        _views[:] = [_View(None if picture is None else Path(picture))]
    elif picture is not None:
        raise ValueError("khepbase: picture is for the call that opens it")
    elif not all(given):
        raise ValueError("khepbase: expected prox_data, light_data and motor_speed, or nothing to open it")
    elif not _views:
        raise KhepTwinError("khepbase: it is not open; expected khepbase() before")
    else:
        _views[-1].set(
            _values("prox_data", prox_data, 8),
            _values("light_data", light_data, 8),
            _values("motor_speed", motor_speed, 2),
        )
    return _views[-1].show()


class _View:
    """The drawing and its bars."""

    def __init__(self, picture: Path | None) -> None:
        self.figure, axes = _sheet()
        feet = np.array([(-left, forward) for forward, left in SENSOR_POSITIONS]) * 1.42
        aside = np.array([_WIDTH * 0.6, _BAR / 2])
        self._proximity = [_bar(axes, foot - aside, _PROXIMITY) for foot in feet]
        self._light = [_bar(axes, foot - aside * (-1, 1), _LIGHT) for foot in feet]
        beside = [(side * (WHEEL_BASE / 2 - 0.008), 0.0) for side in (-1, 1)]
        self._speed = [_bar(axes, np.array(foot), _SPEED, below=True) for foot in beside]
        self._picture = Path("khepbase.png") if picture is None else picture
        self._window = picture is None and show(self.figure, "khepbase")
        if picture is None and not self._window and not is_replaceable(self._picture):
            raise KhepTwinError(f"khepbase: {self._picture}: is there already; expected picture='NAME.png'")

    def set(self, proximity: Floats, light: Floats, speed: Floats) -> None:
        """Set the lengths of the bars."""
        for name, bars, values in (
            ("proximity", self._proximity, proximity),
            ("light", self._light, light),
            ("speed", self._speed, speed),
        ):
            for bar, value in zip(bars, values.tolist(), strict=True):
                bar.set_height(BARS[name].filled(value) * _BAR)

    def show(self) -> Path | None:
        """Draw it on the screen, or into its file."""
        if self._window:
            refresh(self.figure)
            return None
        from khep_twin.drawing import map as drawing

        write_drawing(self._picture, drawing.picture(self.figure, "png", _DPI))
        return self._picture


_views: list[_View] = []
"""View that is open."""


def _values(name: str, values: ArrayLike | None, count: int) -> Floats:
    row = np.asarray(values, np.float64).reshape(-1)
    if len(row) != count or not np.isfinite(row).all():
        raise ValueError(f"khepbase: {name} has {len(row)} values; expected {count} numbers")
    return row


def _sheet() -> "tuple[Figure, Axes]":
    """Return a drawing of the robot from above, ahead being up."""
    from matplotlib.lines import Line2D
    from matplotlib.patches import Circle, Polygon

    from khep_twin.drawing.map import sheet
    from khep_twin.drawing.symbols import INK
    from khep_twin.lab.sensor_test.sensor_figure import draw_body

    figure = sheet(4.2, 4.4)
    axes = figure.add_axes((0, 0.06, 1, 0.94))
    draw_body(axes)
    axes.set(xlim=(-0.047, 0.047), ylim=(-0.045, 0.049))
    nose = [(-0.003, 0.011), (0.003, 0.011), (0, 0.016)]
    axes.add_patch(Polygon(nose, facecolor=INK, lw=0))
    for forward, left in SENSOR_POSITIONS:
        axes.add_patch(Circle((-left, forward), 0.0013, facecolor=INK, lw=0))
    colours = zip(BARS.values(), (_PROXIMITY, _LIGHT, _SPEED), strict=True)
    handles = [Line2D([], [], color=colour, lw=5, label=bar.legend) for bar, colour in colours]
    figure.legend(
        handles=handles,
        loc="lower center",
        ncols=3,
        frameon=False,
        fontsize=6.8,
        columnspacing=0.8,
        handlelength=1.2,
    )
    return figure, axes


def _bar(axes: "Axes", foot: Floats, colour: str, *, below: bool = False) -> "Rectangle":
    """Return an empty bar in its frame, which goes down from its foot, too, if it can be negative."""
    from matplotlib.patches import Rectangle

    left = float(foot[0]) - _WIDTH / 2
    bottom, height = (float(foot[1]) - _BAR, 2 * _BAR) if below else (float(foot[1]), _BAR)
    frame = Rectangle((left, bottom), _WIDTH, height, facecolor=_EMPTY, edgecolor="#b8b8b8", lw=0.6)
    bar = Rectangle((left, float(foot[1])), _WIDTH, 0, facecolor=colour, lw=0)
    axes.add_patch(frame)
    axes.add_patch(bar)
    return bar
