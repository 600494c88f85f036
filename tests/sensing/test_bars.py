"""Bars of sensors and motors, the same wherever they are drawn."""

from typing import Any

import numpy as np
import pytest

from khep_twin.log.viewer import robot_panel
from khep_twin.log.viewer.collected import Samples
from khep_twin.log.viewer.robot_panel import panel_chunks
from khep_twin.robots.model import bars_of
from khep_twin.robots.registry import default_model


@pytest.mark.parametrize(
    ("name", "value", "part"),
    [
        ("proximity", 0, 0),
        ("proximity", 1023, 1),
        ("light", 500, 1),
        ("light", 512, 1),
        ("light", 50, 0.1),
        ("light", -1, 0),
        ("speed", 10, 0.5),
        ("speed", -40, -1),
    ],
)
def test_a_bar_is_filled_by_its_value(name: str, value: float, part: float) -> None:
    assert default_model().bars[name].filled_part(value) == pytest.approx(part)


def test_a_bar_of_12_bits_is_full_at_their_largest_count_and_empty_below_0() -> None:
    bar = bars_of(dark=4000, speed=500, largest=4095)["proximity"]
    assert [bar.filled_part(value) for value in (4095, -2)] == [1, 0]
    assert bar.legend == "proximity, 0 to 4095"


def test_a_recorded_bar_of_light_is_full_in_the_dark_and_short_where_it_is_bright() -> None:
    counts = np.full((1, 8), 500.0)
    counts[0, 3] = 50
    track = Samples(np.array([0]), np.zeros((1, 8)), counts, np.zeros((1, 2)))
    chunks = panel_chunks("khepera0", track, default_model())
    (light,) = (chunk for chunk in chunks if chunk.entity_path.endswith("/light"))
    strips: Any = light.to_record_batch()["LineStrips2D:strips"][0].as_py()
    heights = [strip[0][1] - strip[1][1] for strip in strips]
    lengths = [height + 2 * robot_panel._LINE_RADIUS for height in heights]  # a line ends round
    assert lengths[3] == pytest.approx(0.1 * lengths[0], rel=1e-3)
    assert lengths[0] == pytest.approx(robot_panel._BAR_LENGTH, rel=1e-4)
