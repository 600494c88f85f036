"""Surfaces: what walls and objects are made of, as the infrared sensors and the eye see it."""

from collections.abc import Mapping
from types import MappingProxyType
from typing import Annotated

from pydantic import Field

from khep_twin.toml_files import Table

Colour = Annotated[int, Field(ge=0, le=255)]


class Surface(Table):
    """What something is made of.

    Attributes:
        reflectance: infrared, relative to the calibration's reference wall.
        rgb: its colour, for looks only.
    """

    reflectance: Annotated[float, Field(ge=0, le=2)]
    rgb: Annotated[tuple[Colour, Colour, Colour], Field(description="three whole numbers from 0 to 255")]


BUILT_IN_SURFACES: Mapping[str, Surface] = MappingProxyType(
    {
        "white": Surface(reflectance=1.0, rgb=(244, 243, 238)),
        "grey": Surface(reflectance=0.15, rgb=(138, 141, 145)),
        "black": Surface(reflectance=0.024, rgb=(38, 38, 42)),
        "lego": Surface(reflectance=0.8, rgb=(196, 62, 48)),
    }
)
"""White is the calibration's reference by definition. Grey and black plastic, beside white plastic: from the
counts over distance in the manual's figure 11. Lego bricks of mixed colours: assumed."""
