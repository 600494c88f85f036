"""Surfaces: infrared reflectance, colour and resistance of walls and objects."""

from collections.abc import Mapping
from types import MappingProxyType
from typing import Annotated

from pydantic import Field

from khep_twin.files.toml_files import TomlTable

_Channel = Annotated[int, Field(ge=0, le=255)]
Colour = Annotated[tuple[_Channel, _Channel, _Channel], Field(description="three integers from 0 to 255")]


class Surface(TomlTable):
    """The material of an object.

    Attributes:
        reflectance: Infrared reflectance, relative to the calibration's reference wall.
        rgb: Colour, for rendering only.
        resistance_ohm: Resistance between two gripper fingers [ohm]; it does not conduct if not given.
    """

    reflectance: Annotated[float, Field(ge=0, le=2)]
    rgb: Colour
    resistance_ohm: Annotated[float | None, Field(ge=1, le=1e9)] = None

    @property
    def conductance(self) -> float:
        """Conductance between two fingers [S]."""
        return 0.0 if self.resistance_ohm is None else 1 / self.resistance_ohm


BUILT_IN_SURFACES: Mapping[str, Surface] = MappingProxyType(
    {
        "white": Surface(reflectance=1.0, rgb=(244, 243, 238)),
        "grey": Surface(reflectance=0.151, rgb=(138, 141, 145)),
        "black": Surface(reflectance=0.023, rgb=(38, 38, 42)),
        "wood": Surface(reflectance=0.98, rgb=(196, 154, 108)),
        "styropor": Surface(reflectance=0.913, rgb=(120, 178, 110)),
        "sponge": Surface(reflectance=0.575, rgb=(232, 150, 160)),
        "copper": Surface(reflectance=0.769, rgb=(190, 110, 64), resistance_ohm=1),
        "lego": Surface(reflectance=0.8, rgb=(196, 62, 48)),
    }
)
"""Built-in surfaces. White is the calibration's reference by definition. Grey and black plastic, wood, green
styropor, pink sponge and copper: fitted to the counts over distance in the manual's figure 11, with one gain
for all and for white plastic, to 7.7 counts rms (the manual's other wood is 0.82). Lego bricks of mixed
colours: assumed. Copper has the lowest resistance allowed."""
