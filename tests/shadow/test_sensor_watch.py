"""Sensors that are stuck or dead, and those that only look like it."""

from collections.abc import Callable, Sequence

import numpy as np
import pytest
from numpy.typing import NDArray
from twins import SECOND

from khep_twin.log.shadow_channels import Alarm
from khep_twin.shadow.actions import ProximityReply
from khep_twin.shadow.sensor_watch import SensorWatch

LIMIT = 1023
FULL_RANGE, EXPECTED = np.ones(8), np.zeros(8)
Integers = NDArray[np.int64]


class Watched:
    """A watch that sees replies every 60 ms: sound ones have noise, like those of a robot that drives."""

    def __init__(self, levels: Sequence[float], has_lamps: bool = False) -> None:
        self.watch = SensorWatch(len(levels), 20.0, LIMIT, has_lamps)
        self._levels, self._rng = np.array(levels), np.random.default_rng(0)
        self.time_ns = 0
        self.ended: list[Alarm] = []

    def see(
        self,
        seconds: float,
        change: Callable[[Integers], None] = lambda readings: None,
        *,
        range_left: NDArray[np.float64] = FULL_RANGE,
        surprise: NDArray[np.float64] = EXPECTED,
    ) -> list[Alarm]:
        """See replies for a time, changed by a function; return the alarms that last."""
        for _ in range(round(seconds / 0.06)):
            noisy = self._levels * self._rng.normal(1, 0.04, len(self._levels))
            quiet = self._rng.exponential(2.0, len(self._levels))  # as the robot's, with nothing in reach
            readings = np.where(self._levels > 0, noisy, quiet).astype(np.int64).clip(0, LIMIT)
            change(readings)
            self.time_ns += 60_000_000
            self.ended += self.watch.update(ProximityReply(self.time_ns, readings), range_left, surprise)
        return self.watch.alarms


BUSY = 200, 300, 400, 300, 200, 300, 400, 100


def holding(sensor: int, value: int) -> Callable[[Integers], None]:
    def change(readings: Integers) -> None:
        readings[sensor] = value

    return change


@pytest.mark.parametrize(("value", "fault"), [(311, "stuck sensor 2"), (0, "dead sensor 2")])
def test_a_sensor_that_repeats_itself_among_others_that_do_not_is_named_until_it_changes(
    value: int, fault: str
) -> None:
    watched = Watched(BUSY)
    assert watched.see(5) == []
    (alarm,) = watched.see(5, holding(2, value))
    assert (alarm.fault, alarm.channel) == (fault, "proximity")
    assert 5 * SECOND < alarm.since_ns < alarm.raised_ns < 8 * SECOND
    assert 0.9 < alarm.sureness <= 1
    assert watched.watch.is_sound.tolist() == [sensor != 2 for sensor in range(8)]
    assert watched.see(1) == []
    (ended,) = watched.ended
    assert (ended.fault, ended.since_ns) == (fault, alarm.since_ns)
    assert 10 * SECOND < (ended.ended_ns or 0) < 10.2 * SECOND
    assert watched.watch.is_sound.all()


def test_a_robot_may_have_nine_sensors() -> None:
    watched = Watched((*BUSY, 250))
    nine = {"range_left": np.ones(9), "surprise": np.zeros(9)}
    assert watched.see(5, **nine) == []
    assert [alarm.fault for alarm in watched.see(5, holding(8, 311), **nine)] == ["stuck sensor 8"]
    assert len(watched.watch.is_sound) == 9


def test_two_sensors_may_be_stuck() -> None:
    def change(readings: Integers) -> None:
        readings[[0, 5]] = 123, 0

    watched = Watched(BUSY)
    watched.see(5)
    assert {alarm.fault for alarm in watched.see(5, change)} == {"stuck sensor 0", "dead sensor 5"}


def test_sound_sensors_are_never_named_while_some_see_nothing() -> None:
    assert Watched((0, 0, 300, 0, 0, 0, 700, 0)).see(150) == []
    assert Watched((0,) * 8).see(150) == []


def test_a_robot_that_stands_with_nothing_in_reach_repeats_itself_with_all_sensors() -> None:
    watched = Watched((0,) * 8)

    def change(readings: Integers) -> None:
        readings[:] = 0

    assert watched.see(60, change) == []


def test_a_sensor_at_its_limit_is_stuck_only_where_something_else_is_expected() -> None:
    watched = Watched(BUSY)
    assert watched.see(60, holding(3, LIMIT)) == []
    surprise = EXPECTED.copy()
    surprise[3] = 3.0
    (alarm,) = watched.see(10, holding(3, LIMIT), surprise=surprise)
    assert alarm.fault == "stuck sensor 3"


@pytest.mark.parametrize("value", [0, 150])
def test_a_sensor_that_a_lamp_blinds_is_neither_dead_nor_stuck(value: int) -> None:
    blinded = FULL_RANGE.copy()
    blinded[1] = 0.1
    watched = Watched(BUSY)
    watched.see(5)
    assert watched.see(60, holding(1, value), range_left=blinded) == []
    # In the dark the same replies tell.
    assert [alarm.fault[-8:] for alarm in watched.see(5, holding(1, value))] == ["sensor 1"]


def test_sensors_that_read_0_at_once_are_blinded_where_there_are_lamps() -> None:
    def change(readings: Integers) -> None:
        readings[[2, 3]] = 0

    for has_lamps, faults in ((True, []), (False, ["dead sensor 2", "dead sensor 3"])):
        watched = Watched(BUSY, has_lamps)
        watched.see(5)
        assert [alarm.fault for alarm in watched.see(5, change)] == faults
    # One alone is dead there, too.
    watched = Watched(BUSY, has_lamps=True)
    watched.see(5)
    assert [alarm.fault for alarm in watched.see(5, holding(2, 0))] == ["dead sensor 2"]


def test_sensors_that_repeat_bright_readings_at_once_are_at_their_limit_where_there_are_lamps() -> None:
    def hold(readings: Integers) -> None:
        readings[2:4] = 471, 721

    assert [alarm.fault for alarm in Watched(BUSY).see(4, hold)] == ["stuck sensor 2", "stuck sensor 3"]
    watched = Watched(BUSY, has_lamps=True)
    assert watched.see(4, hold) == []
    assert [alarm.fault for alarm in watched.see(4, holding(2, 471))] == ["stuck sensor 2"]


@pytest.mark.parametrize(("left", "names"), [(0.8, []), (1.0, ["dead sensor 3"])])
def test_where_a_lamp_may_shine_more_than_expected_a_sensor_that_reads_0_is_not_dead(
    left: float, names: list[str]
) -> None:
    watched = Watched([0] * 8, has_lamps=True)
    alarms = watched.see(4, holding(3, 0), range_left=np.where(np.arange(8) == 3, left, 1.0))
    assert [alarm.fault for alarm in alarms] == names
