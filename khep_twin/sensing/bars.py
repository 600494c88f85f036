"""Bars for a robot's sensors and speeds, as `khepbase` of the Khepera Toolbox for Matlab draws them.

A bar of ambient light shows the sensor's count, which decreases with the light: it is full in the dark, and
empty in bright light.
"""

from dataclasses import dataclass

from khep_twin.units import BODIES, COUNTS_LIMIT, Body


@dataclass(frozen=True, slots=True)
class Bar:
    """A kind of bar.

    Attributes:
        full: Value that fills the bar.
        legend: Entry in the legend.
        lowest: Smallest part; below 0 if negative values fill the bar downwards.
    """

    full: int
    legend: str
    lowest: float = 0.0

    def filled_part(self, value: float) -> float:
        """Return the part of the bar that a value fills, at most 1."""
        return min(max(value / self.full, self.lowest), 1.0)


BARS = {
    "proximity": Bar(COUNTS_LIMIT, f"proximity, 0 to {COUNTS_LIMIT}"),
    "light": Bar(500, "light, 500 dark to 0 bright"),
    "speed": Bar(20, "speed, -20 to 20", lowest=-1.0),
}
"""Kinds of bars by name [counts, counts, pulses/10 ms]; the limits are the toolbox's."""

BARS4 = BARS | {
    "light": Bar(980, "light, 980 dark to 0 bright"),
    "speed": Bar(500, "speed, -500 to 500", lowest=-1.0),
}
"""Kinds of bars of a Khepera IV, whose pulses have another length."""


def bars_of(body: Body) -> dict[str, Bar]:
    """Return the bars of a robot with this body."""
    return BARS4 if body is BODIES["khepera4"] else BARS
