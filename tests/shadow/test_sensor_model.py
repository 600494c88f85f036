"""The likelihood of proximity readings, and the learning of gains, headings and thresholds."""

import math

import numpy as np
import pytest
from twins import ALL, AT_THE_CRATE, Pose, metric, particles_at, planes_at, readings, setup_of

from khep_twin.episodes.controllers import ConstantSpeed
from khep_twin.episodes.episode import Episode
from khep_twin.episodes.episode_options import EpisodeOptions
from khep_twin.shadow.particles import Particles
from khep_twin.shadow.sensor_model import SensorModel, log_sum_exp, min_usable_range, usable_range

BESIDE_THE_LAMP = 600.0, 275.0, 0.0
X, Y, HEADING = AT_THE_CRATE


def expected_counts(gain: float = 1.0) -> np.ndarray:
    """Readings of a robot at the crate."""
    planes = planes_at(AT_THE_CRATE)
    planes.advance(1)
    return readings(planes, gain)


def standing(*poses: Pose) -> tuple[Particles, SensorModel]:
    """Particles at poses, whose sensors have looked around."""
    particles = particles_at(*poses)
    particles.twins.advance(1)
    return particles, SensorModel(particles.twins)


@pytest.mark.parametrize("gain", [0.8, 1.0, 1.25])
def test_the_right_pose_is_the_likeliest(gain: float) -> None:
    places = [(-15, 0, 0), (0, 20, 0), (0, -15, 0), (-15, 15, 0)]
    turns = [(0, 0, 40), (0, 0, -40), (0, 0, 180)]
    poses = [
        AT_THE_CRATE,
        *[(X + dx, Y + dy, HEADING + turn) for dx, dy, turn in [*places, *turns, (150, -60, 0)]],
    ]
    particles, model = standing(*poses)
    _, _, logs = model.observe(particles, expected_counts(gain), ALL)
    assert np.argmax(logs.sum(axis=1)) == 0
    # One that sees nothing of it is out of the question.
    assert logs.sum(axis=1)[-1] < logs.sum(axis=1)[0] - 1


def test_what_is_expected_surprises_less_than_what_is_not() -> None:
    (particles, model), reading = standing(AT_THE_CRATE), expected_counts()
    expected, usual, _ = model.observe(particles, reading, ALL)
    assert expected == pytest.approx(reading, abs=1)
    assert usual.max() < 1
    other = reading.copy()
    other[3], other[7] = 0, 700
    _, surprise, _ = model.observe(particles, other, ALL)
    assert surprise[[3, 7]].min() > 1
    assert np.delete(surprise, [3, 7]).max() < 0.7


def test_where_other_robots_drive_only_things_that_are_missing_surprise() -> None:
    particles, reading = particles_at(AT_THE_CRATE), expected_counts()
    particles.twins.has_other_robots = True
    particles.twins.advance(1)
    model = SensorModel(particles.twins)
    model.observe(particles, reading, ALL)
    other = reading.copy()
    other[3], other[7] = 0, 700
    _, surprise, _ = model.observe(particles, other, ALL)
    assert surprise[3] > 1
    assert surprise[7] == 0


def test_a_sensor_that_is_not_relied_on_tells_nothing() -> None:
    particles, model = standing(AT_THE_CRATE)
    reading, use = expected_counts(), ALL.copy()
    reading[3], use[3] = 0, False
    _, surprise, logs = model.observe(particles, reading, use)
    assert surprise[3] == logs[0, 3] == 0
    assert not particles.traits[0, 3].any()
    assert particles.traits[0, 4].all()
    assert logs[0].any()


def test_traits_are_learned_by_the_sensors_that_see_something() -> None:
    (particles, model), reading = standing(AT_THE_CRATE), expected_counts(math.exp(0.2))
    sees, nothing = (reading > 100) & (reading < 900), reading == 0
    assert sees.any()
    assert nothing.any()
    before = particles.covariances.copy()
    for _ in range(100):
        model.observe(particles, reading, ALL)
    expected, _, _ = model.observe(particles, reading, ALL)
    assert expected[sees] == pytest.approx(reading[sees], abs=2)
    variances = np.einsum("stt->st", particles.covariances[0])
    assert (variances[sees, 0] < 0.7 * np.einsum("stt->st", before[0])[sees, 0]).all()
    assert (variances > 0).all()
    assert (np.abs(particles.traits[0, nothing]) < (0.01, 0.01, 5.0)).all()


def test_a_sensors_gain_heading_and_threshold_are_told_apart_by_many_views() -> None:
    rng = np.random.default_rng(0)
    true_parameters = np.array([0.15, math.radians(-6), 60.0])
    particles = particles_at(AT_THE_CRATE)
    planes, model = particles.twins, SensorModel(particles.twins)
    threshold = planes.proximity["threshold"]
    for _ in range(400):
        dx, dy, turn = rng.uniform(-15, 0), rng.uniform(-5, 15), rng.uniform(-60, 60)
        planes.reset_poses(np.array([metric((X + dx, Y + dy, HEADING + turn))]))
        light = planes.illuminate(np.full((1, 8), true_parameters[1]))[0][0]
        counts = (
            math.exp(true_parameters[0]) * light
            - threshold
            - true_parameters[2]
            + 20 * rng.standard_normal(8)
        )
        model.observe(particles, np.rint(counts.clip(0, 1023)).astype(np.int64), ALL)
    gain, turn, shift = particles.traits[0, 1:5].T
    assert gain == pytest.approx(np.full(4, true_parameters[0]), abs=0.06)
    assert turn == pytest.approx(np.full(4, true_parameters[1]), abs=math.radians(1.5))
    assert shift == pytest.approx(np.full(4, true_parameters[2]), abs=35)


@pytest.mark.parametrize(("reading", "sign"), [(0, -1), (1023, 1)])
def test_what_is_beyond_the_range_tells_on_which_side_the_count_is(reading: int, sign: int) -> None:
    (particles, model), counts = standing(AT_THE_CRATE), expected_counts()
    sees = (counts > 100) & (counts < 900)
    for _ in range(50):
        model.observe(particles, np.full(8, reading), ALL)
    assert (sign * particles.traits[0, sees, 0] > 0.02).all()
    far = particles_at(AT_THE_CRATE)
    far.traits[:, :, 0] = 3.0 * sign  # Counts that are beyond anyhow.
    far.twins.advance(1)
    model.observe(far, np.full(8, reading), ALL)
    assert far.traits[0, sees, 0] == pytest.approx(np.full(sees.sum(), 3.0 * sign), abs=1e-3)


def test_beside_a_lamp_sensors_have_a_part_of_their_range_as_those_of_an_episode() -> None:
    episode = Episode(setup_of("workshop"), ConstantSpeed(), compiled=True)
    particles, model = standing(BESIDE_THE_LAMP)
    assert (model.usable_range == 1).all()
    episode.begin(options=EpisodeOptions(noise=False, start=BESIDE_THE_LAMP))
    episode.run(0.1)
    reading = np.array(episode.readings()[0])
    expected, surprise, _ = model.observe(particles, reading, ALL)
    assert model.usable_range[2:4].max() < 0.7
    assert model.usable_range[6:].min() > 0.9
    assert (expected <= 1023 * model.usable_range + 1e-9).all()
    assert expected == pytest.approx(np.where(reading > 0, reading, expected.clip(max=model.quiet)), abs=15)
    assert surprise.max() < 0.3
    # What a blinded sensor reads tells nothing of its traits.
    assert not particles.traits[0, model.usable_range < 1].any()


def test_sums_of_logarithms_do_not_overflow() -> None:
    assert log_sum_exp(np.log([1.0, 2.0, 3.0])) == pytest.approx(math.log(6))
    assert log_sum_exp(np.full(4, -5000.0)) == pytest.approx(-5000 + math.log(4))
    assert log_sum_exp(np.array([5000.0, 0.0])) == pytest.approx(5000)


def test_where_one_of_several_lamps_is_on_a_sensor_that_it_may_blind_tells_only_what_it_sees() -> None:
    particles = particles_at((310.0, 180.0, 90.0), name="t-maze")
    planes, model = particles.twins, SensorModel(particles.twins)
    assert planes.lamps_are_unknown
    planes.advance(1)
    blind = np.zeros(8, np.int64)
    _, surprise, logs = model.observe(particles, blind, ALL)
    is_lit = model.usable_range < 0.97
    assert is_lit.any()
    assert surprise[is_lit].tolist() == logs[0, is_lit].tolist() == [0.0] * is_lit.sum()
    _, _, logs = model.observe(particles, np.full(8, 500), ALL)
    assert (logs[0] != 0).all()


def test_a_sensor_in_the_shadow_of_a_thing_may_be_blinded_if_that_is_gone() -> None:
    places = [
        (x, y, heading) for x in (150.0, 300.0, 450.0) for y in (150.0, 350.0) for heading in (0, 90, 180)
    ]
    hidden = 0
    for place in places:
        particles = particles_at(place, name="two-lamps")
        left, open_left = usable_range(particles.twins)[0], min_usable_range(particles)
        assert (open_left <= left + 1e-9).all()
        hidden += int((open_left < left - 0.1).sum())
    assert hidden > 0
