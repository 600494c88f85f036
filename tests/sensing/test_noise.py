"""Random draws of the sensors; noise of the sampled robot and of its twin in a twin of its room."""

from functools import cache

import numpy as np
import pytest
from shares import share

from khep_twin.sensing.noise import draws, key_words, no_noise, philox, quantiles
from studies.noise_fits import ORDERS, PERIOD, differences, ripple, twin

DISTANCES_MM = tuple(range(11, 39, 4))

SAMPLED = {"wall": (35.5, 26.1, 23.6), "cylinder": (33.3, 25.6, 23.7)}
"""Differences of order 2, 4 and 6 of the sampled robot's readings of 15 to 850 [counts]."""


@cache
def in_the_room(target: str) -> np.ndarray:
    return twin(target, distances_mm=DISTANCES_MM, seed=1)


@pytest.mark.parametrize("target", ["wall", "cylinder"])
def test_in_a_twin_of_its_room_the_robots_noise_is_that_of_the_samples(target: str) -> None:
    deviations = [differences(in_the_room(target), order) for order in ORDERS]
    assert deviations == pytest.approx(SAMPLED[target], rel=0.15)


@pytest.mark.parametrize("target", ["wall", "cylinder"])
def test_what_a_robot_without_any_noise_reads_is_smooth(target: str) -> None:
    quiet = twin(target, noise=0, lamp_w=0, bearing_sd_deg=0, distances_mm=DISTANCES_MM)
    assert max(differences(quiet, order) for order in ORDERS) < 5


@pytest.mark.parametrize("target", share(["wall", "cylinder"], 2))
def test_the_rooms_light_runs_through_the_sensors_in_the_order_of_the_scan(target: str) -> None:
    room_ripple = ripple(in_the_room(target))
    assert room_ripple.period == pytest.approx(PERIOD, rel=0.03)
    assert room_ripple.amplitude == pytest.approx(55, rel=0.15)
    assert room_ripple.lead_deg == pytest.approx(360 * 0.0025 * 103.6, abs=15)
    assert room_ripple.coherence > 0.8


def test_without_the_room_the_noise_is_white() -> None:
    readings = twin("wall", lamp_w=0, bearing_sd_deg=0, distances_mm=DISTANCES_MM)
    deviations = [differences(readings, order) for order in ORDERS]
    assert deviations == pytest.approx([22, 22, 22], rel=0.08)


def test_differences_of_white_noise_are_its_deviation_and_of_a_wave_as_in_closed_form() -> None:
    rng = np.random.default_rng(0)
    white = 500 + 30 * rng.standard_normal((40, 180, 8))
    assert [differences(white, order) for order in ORDERS] == pytest.approx([30, 30, 30], rel=0.02)
    wave = 500 + 59 * np.cos(2 * np.pi * np.arange(180) / 4.5)[None, :, None] * np.ones((1, 1, 8))
    for order, binomials in zip(ORDERS, (6, 70, 924), strict=True):
        expected = 59 / np.sqrt(2) * (2 * np.sin(np.pi / 4.5)) ** order / np.sqrt(binomials)
        assert differences(wave, order) == pytest.approx(expected)


def test_the_generator_gives_the_published_answers() -> None:
    # Known answers of Philox-2x32-10, as its authors' library Random123 tests them.
    assert philox(0, 0, 0) == (0xFF1DAE59, 0x6CD10DF2)
    assert philox(0xFFFFFFFF, 0xFFFFFFFF, 0xFFFFFFFF) == (0x2C3F628B, 0xAB4FD7AD)
    assert philox(0x243F6A88, 0x85A308D3, 0x13198A2E) == (0xDD7CE038, 0xF62A4C12)


def test_draws_have_the_moments_of_their_distributions_and_no_relation_to_each_other() -> None:
    tables, key = quantiles(), key_words(2**63 + 12345)
    sample = np.array([draws(tables, key, number) for number in range(100_000)])
    assert sample.mean(axis=0) == pytest.approx([0, 0, 1], abs=0.01)
    assert sample.std(axis=0) == pytest.approx([1, 1, 1], abs=0.01)
    assert (sample**3).mean(axis=0) == pytest.approx([0, 0, 6], abs=0.25)
    assert (sample[:, :2] ** 4).mean(axis=0) == pytest.approx([3, 3], abs=0.1)
    correlations = np.corrcoef(np.hstack([sample[1:], sample[:-1]]).T)
    assert np.abs(correlations - np.eye(6)).max() < 0.015


def test_a_draw_without_noise_is_zero_and_another_key_draws_something_else() -> None:
    assert draws(no_noise(), (1, 2), 3) == (0.0, 0.0, 0.0)
    tables = quantiles()
    drawn = {draws(tables, key, number) for key in ((1, 2), (2, 2), (1, 9)) for number in (0, 1, 2**32)}
    assert len(drawn) == 9
