"""Steps and pacing."""

import time

import pytest

from khep_twin import clock
from khep_twin.clock import Pacer, n_steps, to_ns


def test_a_duration_that_is_no_whole_number_of_steps_is_refused_with_both_numbers() -> None:
    assert n_steps(20_000_000, 2_500_000) == 8
    with pytest.raises(ValueError, match="21000000 ns is not a whole number of steps of 2500000 ns"):
        n_steps(21_000_000, 2_500_000)


def test_seconds_become_the_nearest_nanosecond() -> None:
    assert to_ns(0.1) == 100_000_000
    assert to_ns(1e-9 * 1.4) == 1


@pytest.fixture
def wall(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """A clock on the wall that the test sets."""
    now = [1_000]
    monkeypatch.setattr(clock.time, "monotonic_ns", lambda: now[0])
    return now


def test_the_pacer_is_due_by_speed(wall: list[int]) -> None:
    pacer = Pacer(2.0, 500)
    wall[0] += 1_000_000
    assert pacer.due_ns() == 500 + 2_000_000
    assert pacer.wait_s(500 + 4_000_000) == pytest.approx(0.001)


def test_the_pacer_gives_up_what_it_cannot_catch_up_with(wall: list[int]) -> None:
    pacer = Pacer(1.0, 0, tolerance_ns=1_000)
    wall[0] += 900
    assert pacer.slip(0) == 0
    wall[0] += 5_000
    assert pacer.slip(0) == 5_900
    assert (pacer.slips, pacer.slipped_ns) == (1, 5_900)
    assert pacer.due_ns() == 0


@pytest.mark.parametrize("speed", [0, -1, float("nan")])
def test_a_speed_that_is_not_above_zero_is_refused(speed: float) -> None:
    with pytest.raises(ValueError, match="expected a number above 0"):
        Pacer(speed, 0)


def test_the_pacer_reads_the_real_clock() -> None:
    pacer = Pacer(1.0, 0)
    time.sleep(0.002)
    assert pacer.due_ns() >= 2_000_000
