"""Lithium polymer cells: voltage over charge."""

import pytest

from khep_twin.board.lithium_cells import VOLTAGES, cells_voltage, charge_level, used_charge


def test_the_voltage_is_linear_between_the_points_of_its_table() -> None:
    for level, voltage in VOLTAGES:
        assert cells_voltage(level) == pytest.approx(voltage)
    assert cells_voltage(0.4) == pytest.approx(7.45)
    levels = [cells_voltage(step / 100) for step in range(101)]
    assert levels == sorted(levels)


@pytest.mark.parametrize("capacity", [1.35 * 3600, 3.4 * 3600])
def test_the_level_is_the_rest_of_the_capacity(capacity: float) -> None:
    for used_min, level in ((None, 1), (0, 1), (75, 0.75), (300, 0), (400, 0)):
        assert charge_level(used_charge(capacity, used_min, 300), capacity) == pytest.approx(level)
