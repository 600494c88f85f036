"""Bytes of the line as actions, repeated on particles."""

import numpy as np
import pytest
from twins import OPEN, SECOND, particles_at

from khep_twin.board import kernel
from khep_twin.shadow.actions import (
    CounterReply,
    CounterReset,
    ProximityReply,
    Restart,
    Silence,
    StateWrite,
    WheelCommand,
    apply_action,
)

LEFT_TARGET = kernel.LEFT + kernel.Wheel.POSITION


def test_time_passes_until_an_action_in_whole_ticks() -> None:
    particles = particles_at(OPEN)
    apply_action(WheelCommand(SECOND // 2 + 4_000_000, "D", 5, 5), particles)
    assert particles.twins.ticks == 50
    assert particles.twins.poses[0, 0] == 0.35
    apply_action(Silence(SECOND), particles)
    assert particles.twins.ticks == 100
    assert particles.twins.poses[0, 0] > 0.36
    x = particles.twins.poses[0, 0]
    # What is said to be earlier happens now.
    for action in (
        Silence(0),
        ProximityReply(SECOND // 4, np.zeros(8, np.int64)),
        CounterReply(0, np.zeros(2, np.int64)),
    ):
        apply_action(action, particles)
    assert particles.twins.ticks == 100
    assert particles.twins.poses[0, 0] == x


def test_a_command_in_doubt_is_obeyed_by_every_other_particle() -> None:
    particles = particles_at(*[OPEN] * 5)
    apply_action(WheelCommand(0, "D", 5, 5, is_unconfirmed=True), particles)
    apply_action(Silence(SECOND), particles)
    assert (particles.twins.poses[:, 0] > 0.36).tolist() == [True, False, True, False, True]


def test_a_command_whose_reply_is_late_is_executed_at_all_times_until_then() -> None:
    particles = particles_at(*[OPEN] * 4)
    apply_action(WheelCommand(0, "D", 5, 5, late_ns=60_000_000), particles)
    assert particles.twins.ticks == 6
    apply_action(Silence(SECOND // 2), particles)
    x = particles.twins.poses[:, 0]
    assert (np.diff(x) < 0).all()  # the later, the less far: 20 ms at 40 mm/s
    assert x[0] - x[3] == pytest.approx(0.0024, rel=0.1)


def test_registers_of_all_are_set_to_values() -> None:
    particles = particles_at(OPEN, OPEN)
    apply_action(StateWrite(0, np.array([LEFT_TARGET]), np.array([77])), particles)
    assert particles.twins.states[:, LEFT_TARGET].tolist() == [77, 77]


def test_after_a_restart_they_stand_and_counters_begin_anew() -> None:
    particles = particles_at(OPEN)
    apply_action(WheelCommand(0, "D", 5, 5), particles)
    apply_action(Silence(SECOND), particles)
    particles.follow_counters(np.array([600, 600]))
    apply_action(Restart(SECOND), particles)
    assert particles.twins.states[0, LEFT_TARGET] == 0
    apply_action(Silence(SECOND * 3 // 2), particles)
    x = float(particles.twins.poses[0, 0])
    apply_action(Silence(SECOND * 2), particles)
    assert particles.twins.poses[0, 0] == pytest.approx(x, abs=1e-6)
    assert particles.follow_counters(np.array([0, 0])).tolist() == [[0, 0]]
    assert particles.twins.poses[0, 0] == pytest.approx(x, abs=1e-6)


def test_counters_that_are_set_tell_nothing_of_the_motion() -> None:
    particles = particles_at(OPEN)
    particles.follow_counters(np.array([600, 600]))
    apply_action(WheelCommand(0, "G", -5, 20), particles)
    apply_action(CounterReset(0), particles)
    assert particles.follow_counters(np.array([-5, 20])).tolist() == [[0, 0]]
    assert particles.twins.poses[0, 0] == pytest.approx(0.35)
