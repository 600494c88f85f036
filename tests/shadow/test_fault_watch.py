"""Faults that are suspected, raised, settled, and end."""

from collections.abc import Mapping
from typing import Any, cast

import numpy as np
import pytest
from twins import SECOND

from khep_twin.shadow.changes import FaultChange
from khep_twin.shadow.fault_watch import AmbiguityGroup, FaultWatch
from khep_twin.shadow.hypotheses import Hypothesis
from khep_twin.shadow.thing_faults import Missing
from khep_twin.shadow.wheel_faults import SlippingWheel, WeakMotor

WEAK: Hypothesis = WeakMotor(0)
SLIP: Hypothesis = SlippingWheel(0)
MISSING: Hypothesis = Missing("block4", (0,))


class Tracker:
    """The probabilities of a filter, made up."""

    def __init__(self, probabilities: Mapping[Hypothesis, float], *, begins: bool = True) -> None:
        self.changes = [FaultChange(fault, begins) for fault in probabilities]
        self.probabilities = np.array([1 - sum(probabilities.values()), *probabilities.values()])

    def since_ns(self, number: int) -> int:
        return SECOND


def see(
    watch: FaultWatch, seconds: float, probabilities: Mapping[Hypothesis, float], *, begins: bool = True
) -> AmbiguityGroup | None:
    """Take two replies with the same probabilities, the second one at a time."""
    tracker = cast(Any, Tracker(probabilities, begins=begins))
    watch.update(round((seconds - 0.1) * SECOND), tracker)
    return watch.update(round(seconds * SECOND), tracker)


def test_one_reply_tells_nothing_however_long_it_takes() -> None:
    watch = FaultWatch()
    assert watch.update(1 * SECOND, cast(Any, Tracker({WEAK: 0.99}))) is None
    assert watch.update(5 * SECOND, cast(Any, Tracker({WEAK: 0.99}))) is None
    assert watch.update(6 * SECOND, cast(Any, Tracker({WEAK: 0.99}))) is not None


def test_faults_that_look_alike_decide_together_and_have_all_names_if_nothing_tells_them_apart() -> None:
    watch, probabilities = FaultWatch(), {WEAK: 0.57, SLIP: 0.4, MISSING: 0.01}
    assert see(watch, 2.0, probabilities) is None  # not for long enough
    certain = see(watch, 2.5, probabilities)
    assert certain is not None
    assert certain.probability == pytest.approx(0.97)
    assert [suspicion.faults for suspicion in watch.suspected] == [("weak motor left", "slipping wheel left")]
    assert not watch.is_distinguished(certain, 2 * SECOND)
    assert watch.is_distinguished(certain, 3 * SECOND)
    watch.raise_alarm(certain, 4 * SECOND)
    (alarm,) = watch.alarms
    assert (alarm.fault, alarm.channel) == ("weak motor left or slipping wheel left", "wheels")
    assert alarm.sureness == pytest.approx(0.97)
    see(watch, 5.0, probabilities)
    assert watch.suspected == ()  # it has its alarm
    told_apart = see(watch, 6.0, {WEAK: 0.95, SLIP: 0.03})
    assert told_apart is not None
    assert watch.rename(told_apart)
    assert [alarm.fault for alarm in watch.alarms] == ["weak motor left"]
    assert not watch.rename(told_apart)


def test_one_that_is_told_apart_has_its_name_and_its_own_probability() -> None:
    watch, probabilities = FaultWatch(), {WEAK: 0.95, SLIP: 0.03}
    see(watch, 2.0, probabilities)
    certain = see(watch, 3.0, probabilities)
    assert certain is not None
    assert watch.is_distinguished(certain, 3 * SECOND)
    watch.raise_alarm(certain, 3 * SECOND)
    assert [(alarm.fault, round(alarm.sureness, 2)) for alarm in watch.alarms] == [("weak motor left", 0.95)]
    assert not watch.is_refuted(cast(Any, Tracker({SLIP: 0.5})))
    assert watch.is_refuted(cast(Any, Tracker({MISSING: 0.9})))
    (ended,) = watch.drop_leading(5 * SECOND)
    assert (ended.fault, ended.ended_ns) == ("weak motor left", 5 * SECOND)


def settled(fault: Hypothesis) -> FaultWatch:
    """Return a watch with one settled fault."""
    watch = FaultWatch()
    see(watch, 2.0, {fault: 0.99})
    certain = see(watch, 3.0, {fault: 0.99})
    assert certain is not None
    watch.raise_alarm(certain, 3 * SECOND)
    watch.settle(certain)
    return watch


def test_a_fault_that_has_ended_is_known_to_a_search_that_begins_before() -> None:
    watch = settled(SLIP)
    assert watch.settled_since(8 * SECOND) == [SLIP]
    watch.end_settled(9 * SECOND, cast(Any, Tracker({SLIP: 0.99}, begins=False)))
    assert watch.settled_since(8 * SECOND) == [SLIP]
    assert watch.settled_since(9 * SECOND) == []


def test_a_settled_fault_ends_when_its_end_is_certain() -> None:
    watch = settled(MISSING)
    assert watch.end_settled(4 * SECOND, cast(Any, Tracker({MISSING: 0.9}, begins=False))) == (0, ())
    number, (ended,) = watch.end_settled(5 * SECOND, cast(Any, Tracker({MISSING: 0.99}, begins=False)))
    assert (number, ended.fault, ended.ended_ns) == (1, "missing block4", 5 * SECOND)
    assert watch.alarms == []
