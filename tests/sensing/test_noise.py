"""Random draws of the sensors; noise of the sampled robot and of its twin in a twin of its room."""

import math
from functools import cache
from typing import Any

import numpy as np
import pytest

from khep_twin.episodes.episode_options import EpisodeOptions
from khep_twin.sensing.noise import check_scale, draws, key_words, philox, plain_tables, quantiles
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


@pytest.mark.share(2)
@pytest.mark.parametrize("target", ["wall", "cylinder"])
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
    assert draws(plain_tables(0.0), (1, 2), 3) == (0.0, 0.0, 0.0)
    tables = quantiles()
    drawn = {draws(tables, key, number) for key in ((1, 2), (2, 2), (1, 9)) for number in (0, 1, 2**32)}
    assert len(drawn) == 9


def test_a_scale_multiplies_each_draw_and_a_switch_is_1_or_0() -> None:
    key, numbers = key_words(7), range(100)
    by_scale = {scale: [draws(plain_tables(scale), key, n) for n in numbers] for scale in (0.5, 1.0, 2.0)}
    assert by_scale[1.0] == [draws(quantiles(), key, n) for n in numbers]
    np.testing.assert_array_equal(by_scale[0.5], np.array(by_scale[1.0]) / 2)
    np.testing.assert_array_equal(by_scale[2.0], np.array(by_scale[1.0]) * 2)
    assert [check_scale(noise) for noise in (True, np.True_, 1, False, 0, 0.25, np.float32(2))] == [
        *(1.0, 1.0, 1.0, 0.0, 0.0, 0.25, 2.0)
    ]


@pytest.mark.parametrize("noise", [-0.1, 100.5, math.nan, math.inf, "off", None, [1.0]])
def test_what_is_no_scale_of_the_noise_is_refused_in_one_line(noise: Any) -> None:
    for use in (check_scale, lambda noise: EpisodeOptions(noise=noise)):
        with pytest.raises(ValueError, match=r"^noise = .*; expected True, False, or a scale from 0 to 100$"):
            use(noise)
