"""Hypotheses: a fault starts in its particles, and ends without a trace."""

import math

import numpy as np
import pytest
from twins import AT_THE_CRATE, OPEN, light_of, particles_at, setup_of

from khep_twin.episodes.planar import plane as plane_data
from khep_twin.shadow.hypotheses import JITTER, Hypothesis, shrink_and_jitter
from khep_twin.shadow.particles import Particles
from khep_twin.shadow.planar_bodies import N_SPARE
from khep_twin.shadow.thing_faults import ADDED_RADII, MIN_MOVE, Missing, Moved, Unexpected, obstacle_rows
from khep_twin.shadow.wheel_faults import wheel_faults


def of_things() -> list[Hypothesis]:
    crate = obstacle_rows(setup_of("workshop"))["block1"]
    return [Missing("block1", crate), Moved("block1", crate), Unexpected()]


def state(particles: Particles) -> list[object]:
    """Return the state that a fault may change."""
    planes = particles.twins
    columns = [
        plane_data.CENTRE_X,
        plane_data.CENTRE_Y,
        plane_data.COSINE,
        plane_data.SINE,
        plane_data.HALF_LENGTH,
        plane_data.HALF_WIDTH,
        plane_data.TOUCHABLE,
    ]
    robots = [planes.robots[name].tolist() for name in ("joints", "left_grip", "right_grip", "left_wheel")]
    light = light_of(planes).tolist()
    return [planes.obstacles[:, :, columns].tolist(), planes.strength.tolist(), robots, light]


def faults() -> list[Hypothesis]:
    return [*wheel_faults(), *of_things()]


def test_each_fault_has_a_name_of_its_own() -> None:
    assert sorted(fault.name for fault in faults()) == [
        "dead motor or blocked wheel left",
        "dead motor or blocked wheel right",
        "missing block1",
        "moved block1",
        "slipping wheel left",
        "slipping wheel right",
        "unexpected thing",
        "weak motor left",
        "weak motor right",
    ]
    assert {fault.channel for fault in faults()} == {"wheels", "proximity"}


@pytest.mark.parametrize("index", range(9))
def test_a_fault_begins_in_those_that_are_given_it_and_ends_without_a_trace(index: int) -> None:
    fault = faults()[index]
    particles = particles_at(*[AT_THE_CRATE] * 4)
    particles.twins.advance(1)
    before = state(particles)
    halves = particles.select(slice(0, 2)), particles.select(slice(2, 4))
    untouched = state(halves[0])
    fault.begin(halves[1], np.random.default_rng(0))
    assert state(halves[0]) == untouched
    assert state(particles) != before
    fault.end(halves[1])
    assert state(particles) == before


@pytest.mark.parametrize("side", [0, 1])
def test_wheels_with_a_fault_drive_less_than_sound_ones(side: int) -> None:
    standing, weak, slipping = list(wheel_faults())[3 * side : 3 * side + 3]
    particles = particles_at(*[OPEN] * 4)
    for row, fault in enumerate((standing, weak, slipping)):
        fault.begin(particles.select(slice(row, row + 1)), np.random.default_rng(0))
    particles.twins.command("D", 8, 8)
    particles.twins.advance(100)
    angles = particles.twins.robots["joints"][:, [plane_data.LEFT_ANGLE, plane_data.RIGHT_ANGLE][side]]
    turned = particles.twins.poses[:, 2] * (-1 if side else 1)
    assert angles[0] == pytest.approx(0, abs=1e-3)
    assert angles[1] < 0.97 * angles[3]
    # A tyre that slips lets its wheel turn; the robot turns towards it all the same.
    assert angles[2] > 0.97 * angles[3]
    assert turned[:3].min() > 0.05 > 0.01 > abs(turned[3])


def test_a_thing_that_is_missing_is_not_seen_and_an_unexpected_one_is() -> None:
    particles = particles_at(*[AT_THE_CRATE] * 8)
    particles.twins.advance(1)
    before = light_of(particles.twins)[0]
    missing, moved, unexpected = of_things()
    rng = np.random.default_rng(0)
    missing.begin(particles, rng)
    light_without = light_of(particles.twins)
    assert before[3:5].min() > 500 > 10 > light_without[:, 3:5].max()
    missing.end(particles)
    moved.begin(particles, rng)
    light = light_of(particles.twins)
    assert len(np.unique(light[:, 3])) > 4
    moved.end(particles)
    unexpected.begin(particles, rng)
    light = light_of(particles.twins)
    assert ((light > before + 30).any(axis=1)).sum() > 4


@pytest.mark.parametrize("name", ["workshop", "obstacles"])
def test_things_have_the_names_of_the_scene_and_rows_of_the_plane(name: str) -> None:
    setup = setup_of(name)
    thing_table, playpen = obstacle_rows(setup), setup.playpen
    items = {f"{kind}{i}": item for kind, all_ in playpen.objects.items() for i, item in enumerate(all_)}
    assert {thing for thing in thing_table if not thing.startswith("wall")} == set(items)
    planes = particles_at(setup.start(0), name=name).twins
    for thing, rows in thing_table.items():
        if thing not in items:
            continue
        centre = planes.obstacles[0, list(rows), plane_data.CENTRE_X : plane_data.CENTRE_Y + 1].mean(axis=0)
        assert centre * 1e3 == pytest.approx([items[thing].x_mm, items[thing].y_mm], abs=1e-6)
    assert len({row for rows in thing_table.values() for row in rows}) == sum(map(len, thing_table.values()))


def test_a_thing_that_was_moved_stays_moved_as_its_place_is_refined() -> None:
    particles, rng = particles_at(*[AT_THE_CRATE] * 200), np.random.default_rng(0)
    _, moved, _ = of_things()
    rows = obstacle_rows(setup_of("workshop"))["block1"]
    moved.begin(particles, rng)
    before = particles.twins.obstacle_offsets(rows)
    away = np.hypot(*before.T)
    assert away.min() >= MIN_MOVE
    assert 0.025 < np.median(away) < 0.035
    for _ in range(20):
        moved.jitter(particles, rng)
    after = particles.twins.obstacle_offsets(rows)
    assert np.hypot(*after.T).min() >= 0.999 * MIN_MOVE
    assert after.mean(axis=0) == pytest.approx(before.mean(axis=0), abs=0.005)
    assert after.std(axis=0) == pytest.approx(before.std(axis=0), rel=0.4)
    # All its faces have moved together, and what one robot sees is not what another does.
    faces = particles.twins.obstacles[:, rows, plane_data.CENTRE_X]
    assert np.ptp(faces - faces[:, :1], axis=0) == pytest.approx(np.zeros(len(rows)), abs=1e-12)


@pytest.mark.parametrize("way", ["jitter", "roughen"])
def test_an_unexpected_thing_keeps_a_radius_in_its_range(way: str) -> None:
    particles, rng, fault = particles_at(*[OPEN] * 200), np.random.default_rng(1), Unexpected()
    fault.begin(particles, rng)
    radii = particles.twins.obstacles[:, -N_SPARE, plane_data.HALF_LENGTH]
    radii[:] = ADDED_RADII[0] * particles.twins.scale
    for _ in range(20):
        fault.jitter(particles, rng) if way == "jitter" else fault.roughen(particles, 0.01, rng)
    assert radii.min() >= ADDED_RADII[0] * particles.twins.scale > 0
    assert radii.max() <= ADDED_RADII[1] * particles.twins.scale


def test_values_drawn_anew_have_their_mean_and_deviation_but_not_less_than_the_least() -> None:
    rng = np.random.default_rng(0)
    values = rng.normal(3.0, 0.5, 4000)
    drawn = shrink_and_jitter(values, 0.01, rng)
    assert (drawn != values).all()
    assert np.corrcoef(drawn, values)[0, 1] == pytest.approx(math.sqrt(1 - JITTER**2), abs=0.01)
    assert drawn.mean() == pytest.approx(3.0, abs=0.05)
    assert drawn.std() == pytest.approx(0.5, rel=0.05)
    assert shrink_and_jitter(np.full(4000, 2.0), 0.1, rng).std() == pytest.approx(0.1 * JITTER, rel=0.1)
