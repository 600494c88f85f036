"""Twins side by side: each is an episode in the plane, and a separate world."""

import math
import sys

import numpy as np
import pytest
from twins import AT_THE_CRATE, OPEN, Pose, light_of, planes_at, readings, setup_of

from khep_twin import shadow, units
from khep_twin.episodes.controllers import ConstantSpeed
from khep_twin.episodes.episode import Episode
from khep_twin.episodes.episode_options import EpisodeOptions
from khep_twin.episodes.episode_setup import EpisodeSetup
from khep_twin.episodes.planar import plane as plane_data
from khep_twin.errors import MissingNumbaError
from khep_twin.playpen import Playpen
from khep_twin.playpen.starts import at_start
from khep_twin.randomness import stream
from khep_twin.sensing.calibration import vary
from khep_twin.shadow.planar_bodies import AWAY
from khep_twin.shadow.planes import REACH, Twins
from khep_twin.shadow.thing_faults import obstacle_rows
from khep_twin.world import World

STARTS = (360.0, 240.0, -70.0), AT_THE_CRATE, (120.0, 200.0, 90.0)


@pytest.mark.parametrize("start", STARTS)
def test_a_twin_drives_as_an_episode_in_the_plane(start: Pose) -> None:
    episode = Episode(setup_of("workshop"), ConstantSpeed(6, 5), compiled=True)
    episode.begin(options=EpisodeOptions(noise=False, start=start))
    planes = planes_at(start)
    planes.command("D", 6, 5)
    for _ in range(10):
        episode.run(0.4)
        planes.advance(40)
        # Both reckon the motors' voltages in their own ways, which differ by the last bit.
        assert planes.robots["joints"][0] == pytest.approx(episode.joints, abs=1e-9)


@pytest.mark.parametrize("start", [*STARTS, (600.0, 240.0, 100.0)])
def test_a_standing_twin_sees_as_an_episode_in_the_plane(start: Pose) -> None:
    episode = Episode(setup_of("workshop"), ConstantSpeed(), compiled=True)
    episode.begin(options=EpisodeOptions(noise=False, start=start))
    episode.run(0.4)
    proximity, ambient = episode.readings()
    planes = planes_at(start)
    planes.proximity["reach"] /= REACH
    planes.advance(1)
    lamps = planes.lamplight(0.0)[0].sum(axis=1)
    dark, floor = float(planes.ambient["dark"]), float(planes.ambient["floor"])
    assert ambient == pytest.approx(np.maximum(dark - lamps, floor), abs=1.01)  # whole counts
    # Below a floor a sensor reads nothing.
    counts = readings(planes)
    clear = counts > 30
    assert np.array(proximity)[clear] == pytest.approx(counts[clear], abs=1.01)
    assert max(np.array(proximity)[~clear], default=0) <= 30


def test_a_twin_sees_as_far_as_a_robot_of_twice_the_gain() -> None:
    setup, seed = setup_of("workshop"), 70022
    robot, known = vary(setup.calibration, stream(seed, "robot", 0, "spread")), setup.calibration
    gains = np.divide(robot.proximity.gain_counts_mm2, known.proximity.gain_counts_mm2)
    turns = np.radians(np.subtract(robot.heading_deg, known.heading_deg))[None]
    assert gains.min() > 1.8
    episode = Episode(setup, ConstantSpeed(), compiled=True)
    n_beyond = 0
    for distance_mm in range(36, 84, 4):
        start = (350.0, 1e3 * units.BODY_RADIUS + distance_mm, -90.0)
        episode.begin(seed, EpisodeOptions(noise=False, vary=True, start=start))
        episode.run(0.4)
        planes = planes_at(start)
        planes.advance(1)
        counts = gains * planes.illuminate(turns)[0][0] - robot.proximity.threshold_counts
        reading = np.array(episode.readings()[0])
        assert reading == pytest.approx(counts.clip(0, 1023), abs=30)
        n_beyond += int(((reading > 60) & (readings(planes) == 0)).sum())
    # The robot of the calibration does not see the wall there.
    assert n_beyond > 5


def test_twins_beside_each_other_are_as_each_alone() -> None:
    together, alone = planes_at(*STARTS), [planes_at(start) for start in STARTS]
    factors = np.array([1.0, 1.01, 0.99])
    together.set_wheels(factors, factors, factors)
    for single, factor in zip(alone, factors, strict=True):
        single.set_wheels(*np.full((3, 1), factor))
    for single in (together, *alone):
        single.command("D", 8, 6)
        single.advance(400)
    for row, single in enumerate(alone):
        assert together.poses[row].tolist() == single.poses[0].tolist()
        assert together.states[row].tolist() == single.states[0].tolist()
        assert light_of(together)[row].tolist() == light_of(single)[0].tolist()
        assert together.lamplight(1.0)[row].tolist() == single.lamplight(1.0)[0].tolist()


def test_wheels_of_a_twin_are_its_own() -> None:
    planes = planes_at(*[OPEN] * 4)
    one = np.ones(4)
    radius, ratio, base = one.copy(), one.copy(), one.copy()
    radius[1], ratio[2], base[3] = 1.01, 1.01, 1.01
    planes.set_wheels(radius, ratio, base)
    planes.command("D", 5, 5)
    planes.advance(200)
    way = np.hypot(*(planes.poses[:, :2] - np.array(OPEN[:2]) / 1e3).T)
    assert way[1] == pytest.approx(1.01 * way[0], rel=1e-3)
    assert way[3] == pytest.approx(way[0], rel=1e-6)
    turned = planes.poses[:, 2]
    assert turned[[0, 1, 3]] == pytest.approx([0, 0, 0], abs=1e-9)
    assert turned[2] == pytest.approx(0.01 * way[0] / units.WHEEL_BASE, rel=0.02)
    planes.reset_poses(np.tile((0.35, 0.25, 0.0), (4, 1)))
    planes.command("D", -3, 3)
    planes.advance(100)
    turned = planes.poses[:, 2]
    assert turned[3] == pytest.approx(turned[0] / 1.01, rel=1e-3)


def test_taken_twins_are_copies_and_those_of_a_slice_are_the_same() -> None:
    planes = planes_at(*STARTS)
    planes.command("D", 5, 5)
    copies, same = planes.select(np.array([2, 0, 2])), planes.select(slice(1, None))
    before = planes.poses
    assert copies.poses.tolist() == before[[2, 0, 2]].tolist()
    copies.advance(100)
    copies.command("D", 0, 0)
    copies.obstacles[:] = AWAY
    assert planes.poses.tolist() == before.tolist()
    assert planes.ticks == 0
    planes.advance(100)
    assert planes.poses[2].tolist() == copies.poses[0].tolist()
    assert same.poses.tolist() == planes.poses[1:].tolist()


def test_a_thing_that_is_moved_in_one_twin_is_seen_and_felt_by_that_one_alone() -> None:
    planes = planes_at(AT_THE_CRATE, AT_THE_CRATE)
    rows = obstacle_rows(setup_of("workshop"))["block1"]
    planes.advance(1)
    before = light_of(planes)
    assert before[0].tolist() == before[1].tolist()
    assert before[0, 3:5].min() > 200
    planes.obstacles[1, rows, plane_data.CENTRE_X] += 0.05
    planes.remeasure()
    moved = light_of(planes)
    assert moved[0].tolist() == before[0].tolist()
    assert moved[1, 3:5].max() < 0.3 * before[1, 3:5].min()
    planes.command("D", 5, 5)
    planes.advance(200)
    way = np.hypot(*(planes.poses[:, :2] - np.array(AT_THE_CRATE[:2]) / 1e3).T)
    assert way[0] < 0.035 < way[1]
    planes.restore_obstacles(rows)
    assert (
        planes.obstacles[0, :, : plane_data.REFLECTANCE].tolist()
        == planes.obstacles[1, :, : plane_data.REFLECTANCE].tolist()
    )


def test_a_motor_without_torque_stands_and_one_with_a_part_of_it_is_slow() -> None:
    planes = planes_at(*[OPEN] * 3)
    planes.strength[1, 0], planes.strength[2, :] = 0, 0.2
    planes.command("D", 6, 6)
    planes.advance(100)
    left, right = planes.robots["joints"][:, [plane_data.LEFT_ANGLE, plane_data.RIGHT_ANGLE]].T
    assert left[1] == pytest.approx(0, abs=1e-3)
    assert right[1] > 0.8 * right[0]
    assert 0.05 < left[2] / left[0] < 0.98


def test_twins_roll_by_pulses_as_wheels_do() -> None:
    planes = planes_at(OPEN, OPEN, OPEN)
    planes.roll_wheels(np.array([[100.0, 100.0], [-100.0, 100.0], [0.0, 0.0]]))
    x, y, heading = planes.poses.T
    way = 100 / units.PULSES_PER_TURN * math.tau * float(planes.robots["left_wheel"][0])
    assert x - 0.35 == pytest.approx([way, 0, 0], abs=1e-9)
    assert y == pytest.approx([0.25] * 3)
    assert heading == pytest.approx([0, 2 * way / float(planes.robots["track"][0]), 0])


def test_a_pose_is_free_where_the_body_touches_nothing() -> None:
    planes = planes_at(OPEN, OPEN, OPEN)
    # In the open; in the crate; 20 mm from a wall, where the body of 27 mm has no room.
    poses = np.array([(0.35, 0.25, 0.0), (0.115, 0.310, 0.0), (0.02, 0.25, 0.0)])
    assert planes.are_clear(poses).tolist() == [True, False, False]


def test_a_lamp_lights_the_sensors_that_it_is_before_and_nothing_behind_a_thing() -> None:
    # The lamp of the workshop is at 640, 275; the bench, 50 mm high, stands between it and 480, 115.
    planes = planes_at((600.0, 275.0, 0.0), (600.0, 275.0, 180.0), (490.0, 130.0, 45.0))
    planes.advance(1)
    light = planes.lamplight(0.0)[:, :, 0]
    assert light[0, 2:4].min() > 5 * light[1, 2:4].max()
    assert light[2, 2:4].max() < 0.05 * light[0, 2:4].min()
    assert not planes.lamplight(1e6).any()


def test_lamps_elsewhere_shine_as_those_that_stand_there_and_have_shadows() -> None:
    planes = planes_at((110, 130, -135), (300, 250, 90), name="two-lamps")
    planes.advance(1)
    positions, turns = np.array(planes.lamps.positions), np.full(8, 0.3)
    light_at_positions = planes.lamplight_from(positions, planes.powers, 0.0, turns)
    np.testing.assert_allclose(light_at_positions, planes.lamplight(0.0, turns), rtol=1e-9)
    assert np.abs(light_at_positions - planes.lamplight(0.0)).max() > 5
    before, shadowed = np.array([[0.3, 0.3, 0.015], [0.3, 0.4, 0.015]])
    light = planes.lamplight_from(np.array([before, shadowed]), np.full(2, 5.0), 0.0, 0.0)[1].max(axis=0)
    assert light[0] > 100 > 5 > light[1]


def test_put_twins_are_at_rest_and_keep_their_counters() -> None:
    planes = planes_at(OPEN)
    planes.command("D", 8, 8)
    planes.advance(50)
    counters = planes.robots["joints"][0, plane_data.LEFT_ANGLE]
    planes.reset_poses(np.array([[0.3, 0.2, 1.0]]))
    assert not planes.robots["speeds"].any()
    assert planes.robots["joints"][0, plane_data.LEFT_ANGLE] == counters > 0


def test_what_no_twins_can_be_made_of_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(ValueError, match="expected EpisodeSetup"):
        Twins(EpisodeSetup(Playpen.load("workshop")), 1)
    monkeypatch.delattr(shadow, "compiled", raising=False)
    monkeypatch.setitem(sys.modules, "khep_twin.shadow.compiled", None)
    with pytest.raises(MissingNumbaError, match="numba is not installed"):
        Twins(setup_of("workshop"), 1)


def test_a_wheel_that_is_blocked_stands_however_fast_it_was_turned() -> None:
    planes = planes_at(OPEN)
    planes.strength[:] = -1
    planes.robots["speeds"][:, plane_data.LEFT_ANGLE] = 150  # three times what a motor reaches
    planes.advance(200)
    assert np.abs(planes.robots["speeds"]).max() < 1
    assert np.isfinite(planes.poses).all()


@pytest.mark.long
def test_a_twin_of_a_khepera4_drives_as_an_episode_in_the_plane_and_hears_as_a_robot_in_mujoco() -> None:
    start = 1000.0, 400.0, 90.0
    episode = Episode(setup_of("arena4"), ConstantSpeed(200, 150), compiled=True)
    episode.begin(options=EpisodeOptions(noise=False, start=start))
    planes = planes_at(start, name="arena4")
    world = World(at_start(Playpen.load("arena4"), 0, start), noise=False)
    world.advance(0.2)
    heard = np.array(world.robots[0].readings()["ultrasonic"]) / 100
    planes.advance(1)
    assert planes.echoes()[0] == pytest.approx(heard, abs=0.006)
    planes = planes_at(start, name="arena4")
    planes.command("D", 200, 150)
    for _ in range(10):
        episode.run(0.2)
        planes.advance(20)
        assert planes.robots["joints"][0] == pytest.approx(episode.joints, abs=1e-9)
    at = planes.counters[0]
    planes.command("F", *(at + 5000).astype(int).tolist())
    planes.advance(400)
    assert planes.counters[0] == pytest.approx(at + 5000, abs=100)
