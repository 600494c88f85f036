"""Wheels that turn less than commanded, by the counters."""

from collections.abc import Sequence

import numpy as np
import pytest
from twins import SECOND

from khep_twin.log.shadow_channels import Alarm
from khep_twin.robots.khepera.model import KHEPERA_1
from khep_twin.shadow.wheel_watch import WheelWatch

STEP_NS = SECOND // 10


def watched(
    watch: WheelWatch,
    seconds: float,
    parts: Sequence[float],
    pulses: Sequence[float] = (50, 50),
    start_s: float = 0,
) -> list[Alarm]:
    """Count wheels that turn by parts of the pulses of each tenth of a second; return the ended alarms."""
    ended: list[Alarm] = []
    expected = np.array(pulses, np.float64)
    for step in range(round(seconds * 10)):
        time_ns = round(start_s * SECOND) + (step + 1) * STEP_NS
        ended += watch.update(time_ns, expected * np.array(parts), expected)
    return ended


@pytest.mark.parametrize("pulses", [(50, 50), (-50, 50), (-80, -60)])
@pytest.mark.parametrize(("side", "name"), [(0, "left"), (1, "right")])
@pytest.mark.parametrize(("part", "fault"), [(0.0, "dead motor or blocked wheel"), (0.4, "weak motor")])
def test_a_wheel_that_turns_less_is_named_with_its_side_and_ends(
    pulses: tuple[int, int], side: int, name: str, part: float, fault: str
) -> None:
    watch, parts = WheelWatch(KHEPERA_1.body.pulse_length, 0.05), [1.0, 1.0]
    assert watched(watch, 3, parts, pulses) == watch.alarms == []
    parts[side] = part
    assert {alarm.fault for alarm in watched(watch, 3, parts, pulses, 3)} <= {f"weak motor {name}"}
    (alarm,) = watch.alarms
    assert (alarm.fault, alarm.channel) == (f"{fault} {name}", "wheels")
    assert 2 * SECOND < alarm.since_ns < alarm.raised_ns < 6 * SECOND
    (ended,) = watched(watch, 3, (1, 1), pulses, 6)
    assert ended.fault == alarm.fault
    assert 6 * SECOND < (ended.ended_ns or 0) < 9 * SECOND
    assert watch.alarms == []


def test_sound_wheels_with_the_errors_of_a_line_are_no_fault() -> None:
    watch, rng = WheelWatch(KHEPERA_1.body.pulse_length, 0.05), np.random.default_rng(0)
    for step in range(600):
        expected = rng.uniform(-80, 80, 2)
        turned = np.rint(expected + rng.standard_normal(2))
        assert watch.update(step * STEP_NS, turned, expected) == ()
        assert watch.alarms == []


def test_wheels_that_are_told_to_stand_tell_nothing() -> None:
    watch = WheelWatch(KHEPERA_1.body.pulse_length, 0.05)
    watched(watch, 5, (0, 0), (0.2, -0.2))
    assert watch.alarms == []
    # Nor do they end what was raised.
    watched(watch, 3, (0, 1), start_s=5)
    raised = watch.alarms
    assert len(raised) == 1
    watched(watch, 5, (1, 1), (0.2, 0.2), start_s=8)
    assert watch.alarms == raised


def test_a_wheel_that_comes_to_a_stand_is_weak_until_it_stands() -> None:
    watch = WheelWatch(KHEPERA_1.body.pulse_length, 0.05)
    watched(watch, 3, (1, 1))
    ended = [alarm for part in (0.4, 0.0) for alarm in watched(watch, 2, (1, part), start_s=3 if part else 5)]
    (alarm,) = watch.alarms
    assert alarm.fault == "dead motor or blocked wheel right"
    assert [(alarm.fault, alarm.ended_ns) for alarm in ended] == [("weak motor right", alarm.raised_ns)]


def test_both_wheels_may_have_a_fault() -> None:
    watch = WheelWatch(KHEPERA_1.body.pulse_length, 0.05)
    watched(watch, 3, (0, 0.5))
    assert {alarm.fault for alarm in watch.alarms} == {"dead motor or blocked wheel left", "weak motor right"}


def test_speeds_of_slow_motors_that_change_are_not_judged() -> None:
    slow, steady = WheelWatch(KHEPERA_1.body.pulse_length, 0.2), np.full(2, 50.0)
    for turn in range(20):
        changing = steady * (1 + turn % 2)
        slow.update(turn * SECOND // 10, 0.7 * changing, changing)
    assert slow.alarms == []
    for turn in range(20, 40):
        slow.update(turn * SECOND // 10, 0.7 * steady, steady)
    assert [alarm.fault for alarm in slow.alarms] == ["weak motor left", "weak motor right"]
