"""What several tests need."""

import pytest

from khep_twin import playpen
from khep_twin.playpen import Playpen

FIELD = """
version = 1
name = "field"

[arena]
width_mm = 5000
height_mm = 5000

[[robot]]
x_mm = 1500
y_mm = 2500
heading_deg = 0
"""


@pytest.fixture
def field() -> Playpen:
    """A robot on a wide floor, 1.5 m from the nearest wall, looking along x."""
    return playpen.parse(FIELD, "field")
