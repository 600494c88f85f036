"""The Khepera Toolbox's khepbase: the robot from above with bars for sensors and speeds, cycle by cycle.

    khepbase()                                       # once
    khepbase(rps(2), rls(2), rms(2))                 # in each cycle

Each sensor has a pair of bars, proximity (0 to 1023) and ambient light (0 to 500 counts, long in the dark).
Each wheel has a bar for its speed (0 to 20 pulses/10 ms, downwards when it drives backwards). The view is a
window where there is a screen, or a picture that each call rewrites. `khep_twin.robots.bars` defines the
ranges of the bars.
"""

# matplotlib's own annotations leave keyword arguments open.
# pyright: reportUnknownMemberType=false

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from khep_twin import drawing
from khep_twin.errors import KhepTwinError
from khep_twin.files.drawings import is_replaceable, write_drawing
from khep_twin.files.paths import StrPath
from khep_twin.robots.registry import default_model
from khep_twin.toolbox.windows import refresh, show
from khep_twin.units import SENSOR_POSITIONS, WHEEL_BASE

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.patches import Rectangle

Floats = NDArray[np.float64]

_BAR_HEIGHT, _BAR_WIDTH = 0.012, 0.0028
"""Height of a full bar, and width of a bar [m]."""

_PROXIMITY, _LIGHT, _SPEED, _EMPTY = "#e4572e", "#f4c846", "#4dabf7", "#f1f1ef"
_DPI = 90
_BARS = default_model().bars

_open_view: "list[_View]" = []
"""View that is open, or empty."""


def khepbase(
    prox_data: ArrayLike | None = None,
    light_data: ArrayLike | None = None,
    motor_speed: ArrayLike | None = None,
    *,
    picture: StrPath | None = None,
) -> Path | None:
    """Open the view of the robot, or update the readings and speeds in it.

    Args:
        prox_data: Proximity (8,), 0 to 1023; the call without data opens the view.
        light_data: Ambient light (8,), 0 to 500.
        motor_speed: Speeds of the left and the right wheel (2,) [pulses/10 ms], -20 to 20.
        picture: PNG to write instead of a window, for the call that opens the view; by default
            "khepbase.png" where there is no screen.

    Returns:
        The picture that was written; None for a window.

    Raises:
        ValueError: An argument is missing or has a wrong number of values.
        KhepTwinError: The view is not open, or the picture cannot be written.
    """
    has_values = [value is not None for value in (prox_data, light_data, motor_speed)]
    if not any(has_values):
        _open_view[:] = [_View(None if picture is None else Path(picture))]
    elif picture is not None:
        raise ValueError("khepbase: picture is for the call that opens it")
    elif not all(has_values):
        raise ValueError("khepbase: expected prox_data, light_data and motor_speed, or nothing to open it")
    elif not _open_view:
        raise KhepTwinError("khepbase: it is not open; expected khepbase() before")
    else:
        _open_view[-1].set(
            _to_array("prox_data", prox_data, 8),
            _to_array("light_data", light_data, 8),
            _to_array("motor_speed", motor_speed, 2),
        )
    return _open_view[-1].show()


class _View:
    """The drawing and its bars."""

    def __init__(self, picture: Path | None) -> None:
        self.figure, axes = _draw_robot()
        bar_feet = np.array([(-left, forward) for forward, left in SENSOR_POSITIONS]) * 1.42
        offset = np.array([_BAR_WIDTH * 0.6, _BAR_HEIGHT / 2])
        wheel_feet = [(side * (WHEEL_BASE / 2 - 0.008), 0.0) for side in (-1, 1)]
        self._bars = {
            "proximity": [_add_bar(axes, foot - offset, _PROXIMITY) for foot in bar_feet],
            "light": [_add_bar(axes, foot - offset * (-1, 1), _LIGHT) for foot in bar_feet],
            "speed": [_add_bar(axes, np.array(foot), _SPEED, is_signed=True) for foot in wheel_feet],
        }
        self._picture = Path("khepbase.png") if picture is None else picture
        self._window = picture is None and show(self.figure, "khepbase")
        if picture is None and not self._window and not is_replaceable(self._picture):
            raise KhepTwinError(f"khepbase: {self._picture}: is there already; expected picture='NAME.png'")

    def set(self, proximity: Floats, light: Floats, speed: Floats) -> None:
        """Set the lengths of the bars."""
        for (name, bars), values in zip(self._bars.items(), (proximity, light, speed), strict=True):
            for bar, value in zip(bars, values.tolist(), strict=True):
                bar.set_height(_BARS[name].filled_part(value) * _BAR_HEIGHT)

    def show(self) -> Path | None:
        """Draw the view on the screen, or write its file."""
        if self._window:
            refresh(self.figure)
            return None
        write_drawing(self._picture, drawing.picture(self.figure, "png", _DPI))
        return self._picture


def _to_array(name: str, values: ArrayLike | None, count: int) -> Floats:
    row = np.asarray(values, np.float64).reshape(-1)
    if len(row) != count or not np.isfinite(row).all():
        raise ValueError(f"khepbase: {name} has {len(row)} values; expected {count} numbers")
    return row


def _draw_robot() -> "tuple[Figure, Axes]":
    """Return a drawing of the robot from above, with its front up."""
    from matplotlib.lines import Line2D
    from matplotlib.patches import Circle, Polygon

    from khep_twin.drawing.map import blank_figure
    from khep_twin.drawing.symbols import INK
    from khep_twin.lab.sensor_test.sensor_figure import draw_body

    figure = blank_figure(4.2, 4.4)
    axes = figure.add_axes((0, 0.06, 1, 0.94))
    draw_body(axes)
    axes.set(xlim=(-0.047, 0.047), ylim=(-0.045, 0.049))
    nose = [(-0.003, 0.011), (0.003, 0.011), (0, 0.016)]
    axes.add_patch(Polygon(nose, facecolor=INK, lw=0))
    for forward, left in SENSOR_POSITIONS:
        axes.add_patch(Circle((-left, forward), 0.0013, facecolor=INK, lw=0))
    colours = zip(_BARS.values(), (_PROXIMITY, _LIGHT, _SPEED), strict=True)
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


def _add_bar(axes: "Axes", foot: Floats, colour: str, *, is_signed: bool = False) -> "Rectangle":
    """Return an empty bar in its frame, which also extends below its foot if the value is signed."""
    from matplotlib.patches import Rectangle

    left = float(foot[0]) - _BAR_WIDTH / 2
    bottom = float(foot[1]) - (_BAR_HEIGHT if is_signed else 0)
    height = 2 * _BAR_HEIGHT if is_signed else _BAR_HEIGHT
    frame = Rectangle((left, bottom), _BAR_WIDTH, height, facecolor=_EMPTY, edgecolor="#b8b8b8", lw=0.6)
    bar = Rectangle((left, float(foot[1])), _BAR_WIDTH, 0, facecolor=colour, lw=0)
    axes.add_patch(frame)
    axes.add_patch(bar)
    return bar
