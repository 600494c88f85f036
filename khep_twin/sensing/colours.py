"""Colours of sensors and wheels in plots over time, in rerun and on the page, for a dark background."""

import colorsys
import math
from itertools import starmap

from khep_twin.robots.body import Body
from khep_twin.units import SENSOR_LABELS

Colour = tuple[int, int, int]

_WARM: list[Colour] = [(228, 87, 46), (242, 159, 5), (244, 211, 94)]
COLD: list[Colour] = [(64, 224, 208), (77, 171, 247), (92, 124, 250)]
_VIOLET: list[Colour] = [(177, 151, 252), (230, 153, 247)]

ALL_SENSORS: dict[str, Colour] = {
    **dict(zip(SENSOR_LABELS, [*_WARM, *COLD, *_VIOLET], strict=True)),
    **dict(zip(("left", "front left", "front"), _WARM, strict=True)),
    **dict(zip(("front right", "right"), COLD, strict=False)),
    **{"back": (200, 200, 200), "ground left": (148, 216, 45), "ground front left": (200, 230, 110)},
    **{"ground front right": (56, 217, 169), "ground right": (18, 184, 134)},
}
"""Colours of sensors of common names: warm on the left, cold on the right, violet at the back."""


def sensor_colour(name: str) -> Colour:
    """Return the colour of a sensor by its name; grey for another name."""
    return ALL_SENSORS.get(name, ALL_SENSORS["back"])


def sensor_colours(body: Body) -> dict[str, Colour]:
    """Return the colours of a robot's infrared sensors; a name without one has a hue by its bearing."""
    hues = dict(zip(body.ring_sensors, starmap(_hue, body.sensor_positions), strict=True))
    return {name: ALL_SENSORS.get(name) or hues.get(name) or ALL_SENSORS["back"] for name in body.sensors}


def _hue(forward: float, left: float) -> Colour:
    """Return the colour of a bearing: green ahead, warm on the left, cold on the right, violet behind."""
    red, green, blue = colorsys.hsv_to_rgb((1 / 3 - math.atan2(left, forward) / math.tau) % 1, 0.65, 0.95)
    return round(255 * red), round(255 * green), round(255 * blue)


AXES: dict[str, Colour] = {"x": _WARM[0], "y": (148, 216, 45), "z": COLD[1]}
"""Colours of a vector's parts."""

WHEELS = {"left": _WARM[0], "right": COLD[1]}
"""Colours of the wheels."""
