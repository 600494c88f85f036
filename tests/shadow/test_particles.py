"""Particles: drawn by their weights, moved by counters beyond the commands."""

import math

import numpy as np
import pytest
from twins import OPEN, particles_at, setup_of

from khep_twin import units
from khep_twin.shadow.particles import FORGETTING_S, Particles
from khep_twin.shadow.start import PUBLISHED, draw_particles


def four() -> Particles:
    return particles_at(*[(350.0 + 10 * i, 250.0, 0.0) for i in range(4)])


def places(particles: Particles) -> list[int]:
    """Return the index in `four` of the original of each particle."""
    return np.rint((particles.twins.poses[:, 0] - 0.35) * 100).astype(int).tolist()


@pytest.mark.parametrize("offset", [0.1, 0.5, 0.9])
def test_they_are_drawn_as_often_as_their_weights_say(offset: float) -> None:
    particles = four()
    assert places(particles.resample(4, offset)) == [0, 1, 2, 3]
    particles.log_weights = np.log([0.1, 0.2, 0.5, 0.2])
    drawn = particles.resample(1000, offset)
    assert len(drawn) == 1000
    assert np.bincount(places(drawn)) == pytest.approx([100, 200, 500, 200], abs=1)
    assert np.exp(drawn.log_weights) == pytest.approx(np.full(1000, 1 / 1000))
    # Weights count as they are to each other, however small.
    particles.log_weights = particles.log_weights - 2000
    assert places(particles.resample(1000, offset)) == places(drawn)


def test_one_that_alone_counts_is_all_that_is_drawn() -> None:
    particles = four()
    particles.log_weights = np.array([-50.0, 0.0, -50.0, -900.0])
    particles.traits[1], particles.wheels[1], particles.covariances[1] = 0.3, 1.01, 0.02
    particles.counter_offsets[1] = 7, 8
    drawn = particles.resample(6, 0.5)
    assert places(drawn) == [1] * 6
    assert (drawn.traits == 0.3).all()
    assert (drawn.wheels == 1.01).all()
    assert (drawn.covariances == 0.02).all()
    assert drawn.counter_offsets.tolist() == [[7, 8]] * 6


def test_copies_leave_the_others_alone() -> None:
    particles = four()
    copies = particles.select(np.array([0, 1, 2, 3]))
    copies.log_weights += 1
    copies.traits += 1
    copies.wheels *= 1.02
    copies.forget(1.0, np.random.default_rng(0))
    copies.twins.command("D", 9, 9)
    copies.twins.advance(20)
    copies.follow_counters(np.array([0, 0]))
    before = four()
    assert particles.log_weights.tolist() == before.log_weights.tolist()
    assert particles.traits.tolist() == before.traits.tolist()
    assert particles.twins.poses.tolist() == before.twins.poses.tolist()
    assert particles.twins.robots["left_wheel"].tolist() == before.twins.robots["left_wheel"].tolist()
    assert np.isnan(particles.counter_offsets).all()


def test_counters_move_them_by_what_the_commands_do_not_explain() -> None:
    particles = particles_at(OPEN, OPEN)
    planes = particles.twins
    # The first reply tells where the counters stand, and nothing of the motion.
    assert particles.follow_counters(np.array([5000, -300])).tolist() == [[0, 0]] * 2
    assert planes.poses[0, 0] == pytest.approx(0.35)
    planes.command("D", 5, 5)
    planes.advance(100)
    turned = planes.counters[0]
    x = float(planes.poses[0, 0])
    assert x > 0.36
    counters = np.array([5000, -300]) + turned
    assert particles.follow_counters(counters) == pytest.approx(np.zeros((2, 2)))
    assert planes.poses[0, 0] == pytest.approx(x)
    # The robot has gone farther than its twins.
    assert particles.follow_counters(counters + 40).tolist() == [[40, 40]] * 2
    way = 40 / units.PULSES_PER_TURN * math.tau * float(planes.robots["left_wheel"][0])
    assert planes.poses[:, 0] == pytest.approx([x + way] * 2)
    # This is told once.
    assert particles.follow_counters(counters + 40).tolist() == [[0, 0]] * 2


def test_what_was_learned_gives_way_to_what_was_known() -> None:
    particles = draw_particles(
        setup_of("workshop"), [(0.35, 0.25, 0.0)], PUBLISHED, 2000, np.random.default_rng(0)
    )
    particles.wheels[:], particles.covariances[:] = (1.02, 0.99, 1.01), 0
    particles.traits[:] = 0.1, 0.05, 40
    particles.traits[:, 3, 0] = 0.9
    particles.forget(FORGETTING_S, np.random.default_rng(0))
    decay = math.exp(-1)
    assert particles.wheels.mean(axis=0) == pytest.approx(1 + decay * np.array([0.02, -0.01, 0.01]), abs=1e-3)
    assert particles.wheels.std(axis=0) == pytest.approx(
        math.sqrt(1 - decay * decay) * particles.prior.wheels, rel=0.05
    )
    assert particles.traits[0, 2, 1:] == pytest.approx([0.05 * decay, 40 * decay])
    # All gains of a particle change by the same factor.
    common = particles.traits[:, 2, 0] - 0.1 * decay
    assert common.std() == pytest.approx(math.sqrt(1 - decay * decay) * PUBLISHED.gain, rel=0.05)
    assert particles.traits[:, 3, 0] - 0.9 * decay == pytest.approx(common)
    assert particles.covariances[0] == pytest.approx((1 - decay * decay) * particles.prior.traits)
    # The twins drive with these wheels.
    wheels = particles.twins.robots["left_wheel"]
    assert np.ptp(wheels / wheels.mean()) > 0.02
    # What passes in no time is nothing.
    before = particles.wheels.copy(), particles.traits.copy()
    particles.forget(0.0, np.random.default_rng(0))
    assert particles.wheels.tolist() == before[0].tolist()
    assert particles.traits == pytest.approx(before[1])


def test_gains_are_kept_while_nothing_is_in_sight() -> None:
    particles = draw_particles(
        setup_of("workshop"), [(0.35, 0.25, 0.0)], PUBLISHED, 10, np.random.default_rng(0)
    )
    wheels, traits, covariances = (particles.wheels, particles.traits.copy(), particles.covariances.copy())
    particles.forget(FORGETTING_S, np.random.default_rng(0), is_in_sight=False)
    assert particles.traits.tolist() == traits.tolist()
    assert particles.covariances.tolist() == covariances.tolist()
    assert particles.wheels.tolist() != wheels.tolist()
