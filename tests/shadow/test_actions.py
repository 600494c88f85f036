"""What crossed the line, repeated on particles."""

import numpy as np
import pytest
from twins import OPEN, SECOND, particles_at

from khep_twin.board import kernel
from khep_twin.shadow.actions import Commanded, Configured, Counted, Restarted, Seen, Waited, repeat
from khep_twin.shadow.wheel_commands import POSITION, SPEED

LEFT_TARGET = kernel.LEFT + kernel.Wheel.POSITION


def test_time_passes_until_an_action_in_whole_ticks() -> None:
    particles = particles_at(OPEN)
    repeat(Commanded(SECOND // 2 + 4_000_000, SPEED, 5, 5), particles)
    assert particles.planes.ticks == 50
    assert particles.planes.poses[0, 0] == 0.35
    repeat(Waited(SECOND), particles)
    assert particles.planes.ticks == 100
    assert particles.planes.poses[0, 0] > 0.36
    x = particles.planes.poses[0, 0]
    # What is said to be earlier happens now.
    for action in (Waited(0), Seen(SECOND // 4, np.zeros(8, np.int64)), Counted(0, np.zeros(2, np.int64))):
        repeat(action, particles)
    assert particles.planes.ticks == 100
    assert particles.planes.poses[0, 0] == x


def test_a_command_in_doubt_is_obeyed_by_every_other_particle() -> None:
    particles = particles_at(*[OPEN] * 5)
    repeat(Commanded(0, SPEED, 5, 5, doubtful=True), particles)
    repeat(Waited(SECOND), particles)
    assert (particles.planes.poses[:, 0] > 0.36).tolist() == [True, False, True, False, True]


def test_a_command_whose_reply_is_late_is_executed_at_all_times_until_then() -> None:
    particles = particles_at(*[OPEN] * 4)
    repeat(Commanded(0, SPEED, 5, 5, late_ns=60_000_000), particles)
    assert particles.planes.ticks == 6
    repeat(Waited(SECOND // 2), particles)
    x = particles.planes.poses[:, 0]
    assert (np.diff(x) < 0).all()  # the later, the less far: 20 ms at 40 mm/s
    assert x[0] - x[3] == pytest.approx(0.0024, rel=0.1)


def test_registers_of_all_are_set_to_values() -> None:
    particles = particles_at(OPEN, OPEN)
    repeat(Configured(0, np.array([LEFT_TARGET]), np.array([77])), particles)
    assert particles.planes.registers[:, LEFT_TARGET].tolist() == [77, 77]


def test_after_a_restart_they_stand_and_counters_begin_anew() -> None:
    particles = particles_at(OPEN)
    repeat(Commanded(0, SPEED, 5, 5), particles)
    repeat(Waited(SECOND), particles)
    particles.count(np.array([600, 600]))
    repeat(Restarted(SECOND), particles)
    assert particles.planes.registers[0, LEFT_TARGET] == 0
    repeat(Waited(SECOND * 3 // 2), particles)
    x = float(particles.planes.poses[0, 0])
    repeat(Waited(SECOND * 2), particles)
    assert particles.planes.poses[0, 0] == pytest.approx(x, abs=1e-6)
    assert particles.count(np.array([0, 0])).tolist() == [[0, 0]]
    assert particles.planes.poses[0, 0] == pytest.approx(x, abs=1e-6)


def test_counters_that_are_set_tell_nothing_of_the_motion() -> None:
    particles = particles_at(OPEN)
    particles.count(np.array([600, 600]))
    repeat(Commanded(0, POSITION, -5, 20), particles)
    assert particles.count(np.array([-5, 20])).tolist() == [[0, 0]]
    assert particles.planes.poses[0, 0] == pytest.approx(0.35)
