"""Colours of sensors and wheels in plots over time, in rerun and on the page, for a dark background."""

from khep_twin.units import SENSOR_LABELS

Colour = tuple[int, int, int]

_WARM: list[Colour] = [(228, 87, 46), (242, 159, 5), (244, 211, 94)]
COLD: list[Colour] = [(64, 224, 208), (77, 171, 247), (92, 124, 250)]
_VIOLET: list[Colour] = [(177, 151, 252), (230, 153, 247)]

SENSORS = {label: colour for label, colour in zip(SENSOR_LABELS, [*_WARM, *COLD, *_VIOLET], strict=True)}
"""Colours of the sensors: warm on the left, cold on the right, violet at the back."""

ALL_SENSORS: dict[str, Colour] = SENSORS | {
    **dict(zip(("left", "front left", "front"), _WARM, strict=True)),
    **dict(zip(("front right", "right"), COLD, strict=False)),
    **{"back": (200, 200, 200), "ground left": (148, 216, 45), "ground front left": (200, 230, 110)},
    **{"ground front right": (56, 217, 169), "ground right": (18, 184, 134)},
}
"""Colours of the sensors of all models, by their names."""


def sensor_colour(name: str) -> Colour:
    """Return the colour of a sensor by its name; grey for another name."""
    return ALL_SENSORS.get(name, ALL_SENSORS["back"])


AXES: dict[str, Colour] = {"x": _WARM[0], "y": (148, 216, 45), "z": COLD[1]}
"""Colours of a vector's parts."""

WHEELS = {"left": _WARM[0], "right": COLD[1]}
"""Colours of the wheels."""
