"""A shadow: the bytes of a line, and its updates."""

import math
from collections.abc import Iterable, Iterator
from pathlib import Path

import numpy as np
import pytest
from nine_sensors import nine_playpen
from twins import EXACT, SECOND, readings

from khep_twin.episodes.episode_setup import EpisodeSetup
from khep_twin.errors import PlaypenError
from khep_twin.log.shadow_channels import PoseState
from khep_twin.playpen import Playpen
from khep_twin.ports.twin import TwinOptions, open_twin
from khep_twin.robots.khepera4.registers import Control, DspicRegister
from khep_twin.robots.khepera4.robot import Khepera4Robot
from khep_twin.shadow.following import AlarmChange, Follower
from khep_twin.shadow.particles import LearnedValues
from khep_twin.shadow.planes import Twins
from khep_twin.shadow.recording import LineChunk, read_recording
from khep_twin.shadow.shadow import Shadow, ShadowSettings
from khep_twin.shadow.update import Update
from studies.twin_runs import Recording, ShadowRun, follow, playpen_at_known_start

STUCK, SINCE_S, UNTIL_S, RESTART_S, LENGTH_S = 3, 4, 9, 12, 20
SETTINGS = ShadowSettings(particles=300)
QUIET = b"n,0,0,0,0,0,0,0,0\r\n"
MS = SECOND // 1000


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A stand-in robot with a stuck sensor for a while, and a restart later."""
    pytest.importorskip("numba", reason="numba is not installed")
    faults = f"stuck:{STUCK}@{SINCE_S}-{UNTIL_S}", f"brown-out@{RESTART_S}"
    run = Recording("robot", "workshop", 6, LENGTH_S, asks_counters=False, faults=faults)
    return run.path(tmp_path_factory.mktemp("stand-in"))


@pytest.fixture(scope="module")
def followed(log: Path) -> ShadowRun:
    """The shadow of that robot, beside the truth."""
    return follow(log, "workshop", SETTINGS)


def updates(lines: Iterable[LineChunk], settings: ShadowSettings, followed: ShadowRun) -> Iterator[Update]:
    """Feed a new shadow."""
    shadow = Shadow(playpen_at_known_start("workshop", followed.truth), settings)
    for chunk in lines:
        yield from shadow.feed(*chunk)


def early(log: Path) -> list[LineChunk]:
    return [chunk for chunk in read_recording(log).chunks if chunk.time_ns < 2 * SECOND]


def bits(updates: Iterable[Update]) -> list[object]:
    """Return all numbers of updates."""
    return [
        (
            update.time_ns,
            update.estimate.pose,
            update.estimate.covariance.tobytes(),
            update.particles.tobytes(),
            update.expected.tobytes(),
            update.reckoned,
            update.alarms,
        )
        for update in updates
    ]


def conversation(shadow: Shadow, *exchanges: tuple[int, bytes, bytes]) -> list[Update]:
    """Feed commands at their times [ms], and their replies 2 ms for each byte later."""
    updates: list[Update] = []
    for time_ms, command, reply in exchanges:
        updates += shadow.feed(time_ms * MS, True, command)
        if reply:
            updates += shadow.feed((time_ms + len(command + reply)) * MS, False, reply)
    return updates


def make_shadow(**settings: object) -> Shadow:
    """The shadow of a robot in the workshop, 50 particles of a known start."""
    pytest.importorskip("numba", reason="numba is not installed")
    return Shadow(Playpen.load("workshop"), ShadowSettings(**{"particles": 50, **settings}))  # type: ignore


def test_a_robot_is_followed_within_millimetres_and_better_than_by_dead_reckoning(
    followed: ShadowRun,
) -> None:
    errors, reckoned = followed.errors(followed.poses), followed.errors(followed.reckoned)
    assert np.median(errors[:, 0]) < 8
    assert errors[:, 0].max() < 40
    assert np.median(errors[:, 1]) < 5
    last = followed.times_ns > (LENGTH_S - 4) * SECOND
    assert np.median(errors[last, 0]) < np.median(reckoned[last, 0])
    assert (np.diff(followed.times_ns) >= 0).all()
    assert len(errors) > 5 * LENGTH_S


def test_a_stuck_sensor_and_a_restart_are_named_until_they_are_over(followed: ShadowRun) -> None:
    stuck, restart = followed.alarms
    assert (stuck.fault, restart.fault) == (f"stuck sensor {STUCK}", "restart")
    assert SINCE_S * SECOND < stuck.raised_ns < (SINCE_S + 4) * SECOND
    assert 0 <= stuck.ended_ns - UNTIL_S * SECOND < SECOND
    assert 0 <= restart.raised_ns - RESTART_S * SECOND < SECOND
    assert restart.raised_ns < restart.ended_ns < LENGTH_S * SECOND


def test_the_same_line_gives_the_same_updates_and_another_seed_others(log: Path, followed: ShadowRun) -> None:
    lines = early(log)
    one, two = (list(updates(lines, SETTINGS, followed)) for _ in range(2))
    assert bits(one) == bits(two)
    assert len(one) > 10
    assert [list(update.estimate.pose) for update in one] == followed.poses[: len(one)].tolist()
    other = list(updates(lines, ShadowSettings(seed=1, particles=300), followed))
    assert other[-1].estimate.pose != one[-1].estimate.pose


def test_bytes_may_come_in_any_pieces(log: Path, followed: ShadowRun) -> None:
    lines = early(log)[:60]
    pieces = [
        LineChunk(chunk.time_ns, chunk.to_robot, chunk.data[i : i + 3])
        for chunk in lines
        for i in range(0, len(chunk.data), 3)
    ]
    assert bits(updates(pieces, SETTINGS, followed)) == bits(updates(lines, SETTINGS, followed))


def test_each_reply_with_values_has_its_own_deviations() -> None:
    shadow = make_shadow(spread=EXACT)
    proximity_updates, counter_updates, light_updates = conversation(
        shadow,
        (0, b"N\n", b"n,9,0,0,0,0,0,0,0\r\n"),
        (100, b"H\n", b"h,0,0\r\n"),
        (200, b"B\n", b"b,5.02,5.01\r\n"),
        (300, b"E\n", b"e,0,0\r\n"),
        (400, b"O\n", b"o,485,485,485,485,485,485,485,100\r\n"),
    )
    assert proximity_updates.residuals.proximity == pytest.approx([9, *[0] * 7])
    assert proximity_updates.measured.tolist() == [9, *[0] * 7]
    assert proximity_updates.expected.tolist() == [0] * 8
    assert np.isnan(proximity_updates.residuals.light).all()
    assert np.isnan(proximity_updates.residuals.wheels).all()
    assert counter_updates.residuals.wheels.tolist() == [0, 0]
    assert np.isnan(counter_updates.residuals.proximity).all()
    assert light_updates.residuals.light[7] < -200
    assert light_updates.measured.tolist() == proximity_updates.measured.tolist()
    (later,) = conversation(shadow, (500, b"H\n", b"h,20,-20\r\n"))
    assert later.residuals.wheels == pytest.approx([20, -20])
    assert later.alarms == later.ended == ()


def test_a_reply_that_comes_late_is_told() -> None:
    shadow, byte_ms = make_shadow(), 11 / 9.6
    for time_ms, late_ms in ((0, 0), (100, 12)):
        heard_ms = time_ms + byte_ms * (len(QUIET) + 2) + late_ms
        shadow.feed(time_ms * MS, True, b"N\n")
        (update,) = shadow.feed(round(heard_ms * MS), False, QUIET)
        assert update.residuals.timing * 1e3 == pytest.approx(late_ms, abs=2.5)


def test_commands_alone_move_dead_reckoning_and_the_twins_with_it() -> None:
    (update,) = conversation(make_shadow(spread=EXACT), (0, b"D,5,5\n", b"d\r\n"), (2000, b"N\n", QUIET))
    x, y, heading = update.reckoned
    start = Playpen.load("workshop").robots[0]
    off = x - start.x_mm / 1e3, y - start.y_mm / 1e3
    assert math.hypot(*off) == pytest.approx(0.08, abs=0.005)  # 2 s at 40 mm/s
    assert heading == pytest.approx(math.radians(start.heading_deg), abs=1e-3)
    assert update.estimate.pose == pytest.approx(update.reckoned, abs=0.02)


def test_a_command_that_nobody_acknowledges_is_in_doubt() -> None:
    with_counters, untold = (
        conversation(make_shadow(spread=EXACT), (0, b"D,5,5\n", reply), (2500, b"N\n", QUIET))[-1]
        for reply in (b"d\r\n", b"")
    )
    away = [np.ptp(particles.particles[:, 1]) for particles in (with_counters, untold)]
    assert away[1] > 3 * away[0]
    assert away[1] > 0.02


def test_silence_advances_the_pose_without_a_reply() -> None:
    shadow = make_shadow(spread=EXACT)
    conversation(shadow, (0, b"D,5,5\n", b"d\r\n"))
    (first,), (second,) = shadow.wait(SECOND), shadow.wait(2 * SECOND)
    assert (first.time_ns, second.time_ns) == (SECOND, 2 * SECOND)
    assert np.isnan(first.residuals.proximity).all()
    way = math.dist(first.estimate.pose[:2], second.estimate.pose[:2])
    assert way == pytest.approx(0.04, abs=0.005)
    assert shadow.wait(2 * SECOND + MS) == []


def test_a_robot_may_start_at_any_of_its_spots_and_is_lost_until_they_are_told_apart() -> None:
    pytest.importorskip("numba", reason="numba is not installed")
    playpen = Playpen.load("looping-maze")
    shadow = Shadow(playpen, ShadowSettings(particles=50))
    (update,) = conversation(shadow, (0, b"N\n", QUIET))
    assert update.state is PoseState.LOST
    spots = np.array([(spot.x_mm, spot.y_mm) for spot in playpen.spots]) * 1e-3
    away = np.linalg.norm(update.particles[:, None, :2] - spots, axis=2)
    assert (away.min(axis=1) < 0.06).all()
    assert np.bincount(away.argmin(axis=1), minlength=4).min() > 10


def test_an_unknown_start_is_looked_for_everywhere_and_replies_narrow_it() -> None:
    shadow = make_shadow(known=False)
    (first,) = conversation(shadow, (0, b"N\n", QUIET))
    assert len(first.particles) > 500
    assert np.ptp(first.particles[:, :2], axis=0).min() > 0.3
    deviation = math.sqrt(np.trace(first.estimate.covariance[:2, :2]))
    assert deviation > 0.1
    assert first.alarms == ()
    # A thing close before the robot leaves the places at things; of its replies little is new, as it stands.
    near = b"n,0,100,700,700,100,0,0,0\r\n"
    last = conversation(shadow, *[(100 * turn, b"N\n", near) for turn in range(1, 25)])[-1]
    x, y = last.particles[:, 0], last.particles[:, 1]
    in_the_open = (abs(x - 0.36) < 0.04) & (abs(y - 0.26) < 0.04)
    assert in_the_open.mean() < 0.005


def test_playpens_that_a_plane_does_not_have_are_refused() -> None:
    with pytest.raises(PlaypenError, match="expected none in the plane"):
        Shadow(Playpen.load("gripper"), ShadowSettings())


def test_a_follower_steps_through_silence_and_tells_when_alarms_begin_and_end() -> None:
    follower = Follower(make_shadow())
    assert follower.last_update is None
    changes: list[AlarmChange] = []
    banner = b"ROM of minirobot KHEPERA, version 5.02\r\n"
    for chunk in (
        LineChunk(1000 * MS, True, b"N\n"),
        LineChunk(1030 * MS, False, QUIET),
        LineChunk(2000 * MS, False, banner),
        LineChunk(5000 * MS, True, b"N\n"),
        LineChunk(5030 * MS, False, QUIET),
    ):
        for update in follower.feed(chunk):
            changes += follower.changes(update)
    assert [(change.alarm.fault, change.alarm.ended_ns is None) for change in changes] == [
        ("restart", True),
        ("restart", False),
    ]
    assert follower.replies >= 2
    times_ns = [update.time_ns for update in follower.wait(8 * SECOND)]
    assert times_ns == sorted(set(times_ns))
    assert np.diff(times_ns).max() <= SECOND // 2
    assert follower.last_update.time_ns == times_ns[-1] > 7 * SECOND


def test_a_shadow_learns_its_robots_wheels_and_gains(log: Path, followed: ShadowRun) -> None:
    shadow = Shadow(playpen_at_known_start("workshop", followed.truth), SETTINGS)
    before = shadow.learned
    assert before.wheels == pytest.approx(np.ones(3), abs=0.01)
    assert before.gains == pytest.approx(np.ones(8), abs=0.1)
    for chunk in read_recording(log).chunks:
        if chunk.time_ns < 7 * SECOND:
            shadow.feed(*chunk)
    after = shadow.learned
    # What has looked at something is known better.
    assert (after.gain_deviations < 0.7 * before.gain_deviations).any()
    assert (after.wheel_deviations > 0).all()
    assert len(after.row) == 22
    again = LearnedValues.from_row(after.row)
    assert all(np.array_equal(one, two) for one, two in zip(again, after, strict=True))


@pytest.mark.long
def test_a_khepera4_is_followed_by_its_line(tmp_path: Path) -> None:
    pytest.importorskip("numba", reason="numba is not installed")
    path = Recording("line", "arena4-room", 40, 8, "wanderer", asks_counters=True).path(tmp_path)
    run = follow(path, "arena4-room", SETTINGS)
    assert run.errors(run.poses)[-100:, 0].max() < 20
    assert (run.states == PoseState.FOLLOWED).mean() > 0.9
    assert not run.alarms


@pytest.mark.long
def test_a_khepera4_is_followed_by_its_registers(tmp_path: Path) -> None:
    pytest.importorskip("numba", reason="numba is not installed")
    path = tmp_path / "program.mcap"
    with open_twin("arena4", TwinOptions(seed=2, log=str(path), vary=True)) as twin:
        robot = twin.world.robots[0]
        assert isinstance(robot, Khepera4Robot)
        robot.dspic.write(bytes([DspicRegister.SPEED_ORDER_LEFT, 200, 0, 120, 0]))
        robot.dspic.write(bytes([DspicRegister.CONTROL, Control.SPEED_PROFILE]))
        twin.advance_to(6 * SECOND)
        place = np.array(robot.pose[:2])
    recording = read_recording(path)
    follower = Follower(
        Shadow(Playpen.load("arena4"), ShadowSettings(particles=300, baud=recording.baud or 0))
    )
    every = [update for chunk in recording.chunks for update in follower.feed(chunk)]
    assert np.hypot(*(np.array(every[-1].estimate.pose[:2]) - place)) < 0.02
    assert math.dist(every[0].estimate.pose[:2], every[-1].estimate.pose[:2]) > 0.1
    assert not any(update.alarms for update in every)


@pytest.mark.long
def test_a_robot_with_nine_sensors_is_followed_and_its_ninth_is_watched(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("numba", reason="numba is not installed")
    playpen, rng = nine_playpen(tmp_path, monkeypatch), np.random.default_rng(0)
    playpen = playpen.model_copy(update={"lamps": Playpen.load("two-lamps").lamps[:1]})
    robot = Twins(EpisodeSetup(playpen, planar=True), 1)
    robot.reset_poses(np.array([(0.11, 1.0, 0.0)]))
    robot.advance(1)
    counts, ambient = readings(robot), float(robot.ambient["dark"]) - robot.lamplight(0.0)[0].sum(axis=1)
    distances = np.rint(100 * robot.echoes()[0].clip(0, 2.5))
    assert counts[8] > 300
    assert (ambient < 970).any()
    shadow = Shadow(playpen, ShadowSettings(particles=200, baud=115_200))
    received: list[Update] = []
    for step in range(200):
        noisy = np.vstack([counts, ambient]) + 3 * rng.standard_normal((2, 9))
        noisy[0, 8] = 333 if step > 100 else noisy[0, 8]
        replies = [*noisy[0], *[900] * 4], distances, [*noisy[1], *[500] * 4]
        for i, (letter, values) in enumerate(zip("NGO", replies, strict=True)):
            reply = ",".join([letter.lower(), *(f"{value:.0f}" for value in values)])
            time_ms = 60 * step + 20 * i
            received += shadow.feed(time_ms * MS, True, f"{letter}\n".encode())
            received += shadow.feed((time_ms + 10) * MS, False, f"{reply}\r\n".encode())
    assert len(received) == 600
    sound, failed = received[300], received[-1]
    assert sound.expected == pytest.approx(counts, abs=15)
    assert sound.residuals.proximity.shape == received[302].residuals.light.shape == (9,)
    assert np.abs(received[302].residuals.light).max() < 60
    assert math.dist(sound.estimate.pose[:2], (0.11, 1.0)) < 0.015
    assert sound.alarms == ()
    assert [alarm.fault for alarm in failed.alarms] == ["stuck sensor 8"]
    assert len(shadow.learned.gains) == 9
