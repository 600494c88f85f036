"""Options of one episode, or of all episodes of a batch."""

import operator
from collections.abc import Sequence
from dataclasses import dataclass
from typing import SupportsIndex

import numpy as np
from numpy.typing import NDArray

from khep_twin import units
from khep_twin.episodes.line import LineTimes, check_line
from khep_twin.errors import value_text
from khep_twin.playpen import Lamp
from khep_twin.playpen.starts import Start
from khep_twin.sensing.noise import check_scale

Home = tuple[float, float, float, float]
"""Home of a robot: x, y, radius and duration of a battery charge [s]."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class EpisodeOptions:
    """Options of an episode besides its seed.

    Attributes:
        noise: Whether sensors are noisy, or a scale of their noise.
        vary: Whether to draw each robot's parameters at random around its calibration.
        start: Start x, y [mm] and heading [deg], or one for each robot; None for the playpen's.
        lamps: Lamps that replace those of the playpen.
        genes: Genome of the controller (n_genes,), or of each robot's (n_robots, n_genes).
        home: Home x, y, radius [mm] and time for which a full battery lasts [s], for the metric "homing".
        line: Line between controller and robot, as a speed [baud] or a `MeasuredCycle`; None for exchanges
            that take no time.

    Raises:
        ValueError: The noise, the home or the line is invalid.
    """

    noise: float = True
    vary: bool = False
    start: Start | Sequence[Start] | None = None
    lamps: Sequence[Lamp] | None = None
    genes: Sequence[float] | NDArray[np.float64] = ()
    home: Home | None = None
    line: LineTimes = None

    def __post_init__(self) -> None:
        """Check noise, home and line."""
        check_scale(self.noise)
        check_line(self.line)
        if self.home is not None:
            check_numbers("home", self.home, "x, y, radius [mm] and duration of a charge [s]", (4,))
            if self.home[2] <= 0 or self.home[3] <= 0:
                raise ValueError(f"home = {self.home}; expected a radius and a charge above 0")

    @property
    def home_in_metres(self) -> Home:
        """Home with lengths in metres; zeros for none."""
        if self.home is None:
            return 0.0, 0.0, 0.0, 0.0
        x_mm, y_mm, radius_mm, charge_s = self.home
        return units.metres(x_mm), units.metres(y_mm), units.metres(radius_mm), charge_s


DEFAULT_OPTIONS = EpisodeOptions()
"""Options of an episode by default."""


def check_numbers(name: str, value: object, description: str, shape: tuple[int, ...]) -> None:
    """Raise a `ValueError` unless a value consists of finite numbers of a shape."""
    try:
        numbers = np.asarray(value, np.float64)
        fits = numbers.shape == shape and bool(np.isfinite(numbers).all())
    except (TypeError, ValueError, OverflowError):
        fits = False
    if not fits:
        count = " x ".join(map(str, shape))
        raise ValueError(f"{name} = {value_text(value)}; expected {description}, {count} finite numbers")


def as_integer(value: object) -> int | None:
    """Return an integer of Python or NumPy as Python's; None for other values."""
    try:
        return operator.index(value) if isinstance(value, SupportsIndex) else None
    except TypeError:  # an array that is no integer
        return None


def check_count(value: object, label: str) -> int:
    """Return a count; raise a `ValueError`, which contains the label, unless it is an integer from 1."""
    if (count := as_integer(value)) is not None and count >= 1:
        return count
    raise ValueError(f"{value_text(value)} {label}; expected a whole number, 1 or more")
