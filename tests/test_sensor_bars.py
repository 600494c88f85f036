"""Bars of sensors and motors, the same wherever they are drawn."""

import numpy as np
import pytest

from khep_twin.log import khepbase
from khep_twin.sensor_bars import BARS


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
    assert BARS[name].filled(value) == pytest.approx(part)


def test_a_recorded_bar_of_light_is_full_in_the_dark_and_short_where_it_is_bright() -> None:
    parts = khepbase._filled("light", np.array([[500.0, 50.0], [0.0, 250.0]]))
    assert parts == pytest.approx(np.array([[1, 0.1], [0, 0.5]]))
