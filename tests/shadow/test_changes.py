"""Changes that a filter considers: some twins undergo them, and the weights tell whether they happened."""

import numpy as np
import pytest
from twins import AT_THE_CRATE, SECOND, particles_at, setup_of

from khep_twin.shadow.changes import FaultChange, resample_changes
from khep_twin.shadow.hypotheses import QUOTA
from khep_twin.shadow.particles import Particles
from khep_twin.shadow.thing_faults import Missing, obstacle_rows
from khep_twin.shadow.wheel_faults import MAX_STRENGTH, MIN_STRENGTH, StandingWheel, WeakMotor

STANDS, WEAK = FaultChange(StandingWheel(0), True), FaultChange(WeakMotor(1), True)


def mix(particles: Particles, *changes: FaultChange, count: int = 100, passed_s: float = 0.5) -> Particles:
    return resample_changes(particles, changes, count, passed_s, SECOND, np.random.default_rng(0))


def shares(particles: Particles, changes: int) -> list[float]:
    """Probabilities of no change and of each one."""
    return np.bincount(particles.changes, np.exp(particles.log_weights), changes + 1).tolist()


def test_some_twins_undergo_each_change_with_the_probability_of_that_time() -> None:
    mixture = mix(particles_at(*[AT_THE_CRATE] * 50), STANDS, WEAK)
    assert np.bincount(mixture.changes).tolist() == [100 + QUOTA, QUOTA, QUOTA]
    _, stands, weak = shares(mixture, 2)
    assert stands == pytest.approx(STANDS.rate * 0.5)
    assert weak == pytest.approx(WEAK.rate * 0.5)
    strength = mixture.twins.strength
    assert (strength[mixture.changes == 0] == 1).all()
    assert (strength[mixture.changes == 1, 0] <= 0).all()
    assert (strength[mixture.changes == 2, 1] < 1).all()
    assert (mixture.since_ns == np.where(mixture.changes, SECOND, 0)).all()


def test_a_change_that_the_weights_favour_gets_the_twins_and_keeps_when_it_began() -> None:
    mixture = mix(particles_at(*[AT_THE_CRATE] * 50), STANDS, WEAK)
    mixture.log_weights[mixture.changes == 1] += 20
    mixture.since_ns[mixture.changes == 1] = 7
    later = mix(mixture, STANDS, WEAK)
    assert (later.changes == 1).sum() == 100 + QUOTA
    assert shares(later, 2)[1] > 0.9
    assert (later.twins.strength[later.changes == 1, 0] <= 0).all()
    assert np.median(later.since_ns[later.changes == 1]) == 7


def test_twins_without_a_change_any_more_are_sound_again() -> None:
    mixture = mix(particles_at(*[AT_THE_CRATE] * 50), STANDS)
    mixture.log_weights[mixture.changes == 0] -= 1000
    later = mix(mixture, STANDS)
    sound = later.changes == 0
    assert sound.sum() == QUOTA
    assert (later.twins.strength[sound] == 1).all()
    assert 0 < shares(later, 1)[0] < 0.1


def test_an_end_takes_the_fault_from_twins_that_have_it() -> None:
    particles = particles_at(*[AT_THE_CRATE] * 50)
    particles.twins.strength[:, 0] = 0
    mixture = mix(particles, FaultChange(StandingWheel(0), False))
    assert (mixture.twins.strength[:, 0] == mixture.changes).all()
    assert mixture.changes.any()


def test_what_may_have_happened_unseen_has_the_probability_of_that_time_once() -> None:
    missing = FaultChange(
        Missing("block1", obstacle_rows(setup_of("workshop"))["block1"]), True, unseen_s=60.0
    )
    mixture = mix(particles_at(*[AT_THE_CRATE] * 50), missing)
    assert shares(mixture, 1)[1] == pytest.approx(missing.rate * 60.5, rel=0.02)
    later = mix(mixture, missing)
    assert shares(later, 1)[1] == pytest.approx(missing.rate * 61, rel=0.05)


@pytest.mark.parametrize("begins", [True, False])
def test_twins_that_keep_a_fault_differ_a_little_from_those_they_were_drawn_of(begins: bool) -> None:
    weak, particles = WeakMotor(1), particles_at(*[AT_THE_CRATE] * 50)
    weak.begin(particles, np.random.default_rng(0))
    particles.changes[:] = begins
    before = particles.twins.strength[:, 1].copy()
    mixture = mix(particles, FaultChange(weak, begins), count=1000)
    has = mixture.twins.strength[mixture.changes == int(begins), 1]
    assert len(np.unique(has)) > 1000
    assert has.mean() == pytest.approx(before.mean(), abs=0.01)
    assert has.std() == pytest.approx(before.std(), rel=0.1)
    assert MIN_STRENGTH <= has.min() < has.max() <= MAX_STRENGTH
    # Those that have it no more, or are not to have it, are whole.
    assert (mixture.twins.strength[mixture.changes != int(begins), 1] == 1).all()


def test_without_changes_twins_are_drawn_by_their_weights() -> None:
    particles = particles_at(AT_THE_CRATE, (100.0, 371.0, 0.0))
    particles.log_weights[:] = np.log([0.25, 0.75])
    mixture = mix(particles, count=40)
    assert len(mixture) == 40
    assert (mixture.twins.poses[:, 0] > 0.09).sum() == 30
