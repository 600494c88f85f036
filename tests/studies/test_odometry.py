"""Home by odometry and UMBmark."""

import math
from pathlib import Path

import numpy as np
import pytest

from khep_twin import units
from studies import home_test, umbmark


def test_the_nominal_robot_comes_home_and_one_with_other_wheels_does_not(tmp_path: Path) -> None:
    arena = home_test.open_arena(tmp_path)
    assert home_test.miss_distance(arena, 0, 1) < 0.015
    assert home_test.miss_distance(arena, 3, 2) > 0.1


@pytest.mark.parametrize(("wheels", "base"), [(1.0, 1.0), (1.002, 1.0), (1.0, 0.99), (0.998, 1.01)])
def test_a_square_tells_the_wheels_and_the_base(wheels: float, base: float) -> None:
    """Each side is an arc of the wheels' difference, each corner a turn by the base."""
    ends: list[float] = []
    for side in (1, -1):
        x = heading = 0.0
        for _ in range(4):
            bend = 2 * (wheels - 1) / (wheels + 1) * umbmark.SIDE / (base * units.WHEEL_BASE)
            x += umbmark.SIDE * float(np.sinc(bend / 2 / np.pi)) * math.cos(heading + bend / 2)
            heading += bend + side * math.pi / 2 / base
        ends.append(x)
    # The odometry takes the wheels as equal and the base as nominal, and itself as back at the start.
    assert umbmark.factors(*ends) == pytest.approx((wheels, base), abs=1e-3)


def test_squares_find_the_wheels_of_a_twin(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(umbmark, "RUNS", 2)
    with home_test.twin(home_test.open_arena(tmp_path), 1) as robot:
        result = umbmark.umbmark(robot)
    assert (result.wheels, result.base) == pytest.approx(umbmark.draw_wheels(1), abs=1e-3)
