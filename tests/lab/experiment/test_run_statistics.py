"""Statistics of runs, against paths with known values, and of the twin against its playpen."""

import math
from pathlib import Path

import numpy as np
import pytest
from scenes import arena, robot, table

from khep_twin.lab.experiment import run_statistics as statistics
from khep_twin.lab.experiment.wire_statistics import wire
from khep_twin.log.channels import TextLine
from khep_twin.log.reader import LoggedRun, read_log
from khep_twin.playpen import Playpen, parse
from khep_twin.ports.twin import TwinOptions, open_twin
from khep_twin.units import BODY_RADIUS, PULSE_LENGTH, WHEEL_BASE

SECOND = 1_000_000_000

BLOCK = {"x_mm": 300, "y_mm": 150, "length_mm": 20, "width_mm": 100, "height_mm": 50, "angle_deg": 90}
ROUND = {"x_mm": 50, "radius_mm": 10, "height_mm": 50}


@pytest.fixture
def room() -> Playpen:
    things = table("block", **BLOCK) + table("cylinder", y_mm=250, **ROUND)
    things += table("cylinder", y_mm=50, movable=True, **ROUND)
    return parse(arena(400, 300) + things + robot(200, 100), "room")


def drive(playpen: Playpen, path: Path, command: bytes, seconds: int) -> LoggedRun:
    with open_twin(playpen, TwinOptions(noise=False, log=str(path))) as twin:
        twin.robot.send(command)
        twin.advance_to(seconds * SECOND)
    return read_log(path)


def ramp(end: float, count: int = 101) -> np.ndarray:
    return np.linspace(0, end, count)


def test_a_straight_path_has_its_length() -> None:
    pose = np.column_stack([ramp(0.3), ramp(0.4), np.full(101, math.atan2(4, 3))])
    motion = statistics.motion(ramp(10), pose)
    assert motion.distance == pytest.approx(0.5)
    assert (motion.duration_s, motion.mean_speed) == (10, pytest.approx(0.05))
    assert motion.top_speed == pytest.approx(0.05)
    assert (motion.left_turn, motion.right_turn) == (0, 0)


def test_a_spin_turns_and_goes_nowhere() -> None:
    heading = np.concatenate([ramp(6 * math.pi), 6 * math.pi - ramp(math.pi)[1:]])
    wrapped = (heading + math.pi) % (2 * math.pi) - math.pi
    trembling = 2e-4 * np.sin(np.arange(len(heading)))
    pose = np.column_stack([trembling, -trembling, wrapped])
    motion = statistics.motion(ramp(20, 201), pose)
    assert motion.distance == 0
    assert motion.left_turn == pytest.approx(6 * math.pi)
    assert motion.right_turn == pytest.approx(math.pi)


def test_a_circle_has_its_circumference() -> None:
    angle = ramp(2 * math.pi, 1001)
    positions = 0.2 * np.column_stack([np.cos(angle), np.sin(angle)])
    assert statistics.path_length(positions) == pytest.approx(0.4 * math.pi, rel=1e-3)


def test_no_time_and_one_sample_give_nothing() -> None:
    motion = statistics.motion(np.zeros(1), np.zeros((1, 3)))
    assert (motion.duration_s, motion.distance, motion.mean_speed, motion.top_speed) == (0, 0, 0, 0)
    for count in (0, 1):
        near = statistics.near(np.zeros(count), np.full((count, 8), 500))
        assert (len(near.times_s), near.total_s, near.share, near.longest_s) == (0, 0, 0, 0)
    assert statistics.path_length(np.zeros((0, 2))) == 0


def test_intervals_have_start_end_and_share() -> None:
    holds = np.array([1, 1, 0, 0, 1, 0, 0, 0, 1, 1, 1], bool)
    intervals = statistics.find_intervals(np.arange(11.0), holds)
    assert intervals.times_s.tolist() == [[0, 2], [4, 5], [8, 10]]
    assert (intervals.total_s, intervals.share, intervals.longest_s) == (5, 0.5, 2)
    joined = statistics.find_intervals(np.arange(11.0), holds, gap_s=2.5)
    assert joined.times_s.tolist() == [[0, 5], [8, 10]]
    assert joined.total_s == 5


def test_near_is_above_100_counts() -> None:
    counts = np.zeros((11, 8), np.int64)
    counts[2:4, 5], counts[3:7, 0] = 101, 400
    counts[8:, 1] = 100
    near = statistics.near(np.arange(11.0), counts)
    assert near.times_s.tolist() == [[2, 7]]
    assert near.share == 0.5


def test_light_is_the_depth_below_the_dark_level() -> None:
    counts = np.full((5, 8), 500)
    counts[3, 6] = 100
    light = statistics.light(np.arange(5.0), counts, np.full(8, 500.0))
    assert (light.brightest, light.sensor, light.time_s) == (400, 6, 3)
    assert light.mean == pytest.approx(400 / 40)


def test_clearance_is_measured_to_walls_and_fixed_objects(room: Playpen) -> None:
    positions = np.array([[0.2, 0.02], [0.2, 0.29], [0.24, 0.15], [0.3, 0.15], [0.05, 0.22], [0.06, 0.05]])
    expected = [0.02, 0.01, 0.01, -0.01, 0.02, 0.05]
    assert statistics.clearance(positions, room).tolist() == pytest.approx(expected)
    corner = np.array([[0.35 + 0.003, 0.16 + 0.004]])
    assert statistics.clearance(corner, room).tolist() == pytest.approx([0.005])


def test_an_arena_with_an_outline_has_its_walls_there(room: Playpen) -> None:
    cut = {"outline_mm": ((0, 0), (400, 0), (400, 300), (200, 300), (0, 100))}
    arena = room.arena.model_copy(update=cut)
    triangle = room.model_copy(update={"arena": arena, "blocks": (), "cylinders": ()})
    place = np.array([[0.1 + 0.03 / math.sqrt(2), 0.2 - 0.03 / math.sqrt(2)]])
    assert statistics.clearance(place, triangle).tolist() == pytest.approx([0.03])


def test_contacts_shortly_after_each_other_are_one_collision(room: Playpen) -> None:
    x = np.full(500, 0.2)
    x[100:150] = x[152:200] = x[400:420] = 0.4 - BODY_RADIUS - 0.0005
    pose = np.column_stack([x, np.full(500, 0.05), np.zeros(500)])
    collisions = statistics.collisions(np.arange(500) * 0.02, pose, room, BODY_RADIUS)
    assert collisions.times_s == pytest.approx(np.array([[2, 4], [8, 8.4]]))
    assert collisions.total_s == pytest.approx(2.36)


def test_counters_reckon_straight_ways_and_turns() -> None:
    straight = np.column_stack([np.arange(1001), np.arange(1001)])
    poses = statistics.odometry(straight, np.array([1.0, 2.0, math.pi / 2]))
    assert poses[-1].tolist() == pytest.approx([1, 2 + 1000 * PULSE_LENGTH, math.pi / 2])
    spin = np.column_stack([-np.arange(1001), np.arange(1001)])
    poses = statistics.odometry(spin, np.zeros(3))
    assert poses[-1].tolist() == pytest.approx([0, 0, 2000 * PULSE_LENGTH / WHEEL_BASE])


def test_slip_is_what_the_counters_say_too_much() -> None:
    pulses = np.column_stack([np.arange(1001), np.arange(1001)])
    pose = np.zeros((1001, 3))
    slip = statistics.slip(ramp(10, 1001), pose, pulses)
    assert slip.distance == pytest.approx(0.08, abs=0.001)
    assert slip.end == pytest.approx(0.08)
    assert slip.heading == 0
    turning = np.column_stack([-np.arange(1001), np.arange(1001)])
    slip = statistics.slip(ramp(10, 1001), pose, turning)
    assert (slip.heading, slip.heading_s) == (pytest.approx(2000 * PULSE_LENGTH / WHEEL_BASE), 10)
    assert slip.distance == 0


def test_a_twin_pushed_against_a_wall_collides_once_and_slips(room: Playpen, tmp_path: Path) -> None:
    free = room.model_copy(update={"blocks": (), "cylinders": ()})
    track = drive(free, tmp_path / "push.mcap", b"D,10,10\n", 5).robots["khepera0"]
    times_s = track.times_ns / 1e9
    moved = statistics.motion(times_s, track.pose)
    # From x = 200 mm to the wall at 400 mm, where the slipping wheels shake it.
    assert track.pose[-1, 0] == pytest.approx(0.4 - BODY_RADIUS, abs=0.0001)
    assert 0.2 - BODY_RADIUS <= moved.distance < 0.2 - BODY_RADIUS + 0.01
    assert moved.top_speed == pytest.approx(0.08, rel=0.15)
    hits = statistics.collisions(times_s, track.pose, free, BODY_RADIUS)
    ((begin, end),) = hits.times_s.tolist()
    assert begin == pytest.approx((0.2 - BODY_RADIUS) / 0.08, abs=0.3)
    assert end == 5
    slip = statistics.slip(times_s, track.pose, track.registers[:, [0, 14]])
    assert slip.distance > moved.distance + 0.05
    assert statistics.near(times_s, track.proximity).share > 0.5


def test_a_twin_that_spins_free_turns_as_far_as_its_counters_say(field: Playpen, tmp_path: Path) -> None:
    track = drive(field, tmp_path / "spin.mcap", b"D,-5,5\n", 10).robots["khepera0"]
    times_s = track.times_ns / 1e9
    moved = statistics.motion(times_s, track.pose)
    assert moved.left_turn == pytest.approx(10 * 2 * 0.04 / WHEEL_BASE, rel=0.02)
    assert moved.distance < 0.003
    assert len(statistics.collisions(times_s, track.pose, field, BODY_RADIUS).times_s) == 0
    slip = statistics.slip(times_s, track.pose, track.registers[:, [0, 14]])
    assert abs(slip.heading) < 0.05 * moved.left_turn


def line(time_ms: int, name: str, text: str) -> TextLine:
    return TextLine(time_ms * 1_000_000, 20, name, text)


def test_replies_belong_to_the_oldest_command_of_their_letter() -> None:
    transcript = wire(
        [
            line(0, "host", "N"),
            line(20, "robot", "n,1,2,3,4,5,6,7,8"),
            line(30, "host", "D,5,5"),
            line(40, "host", "N"),
            line(70, "robot", "n,1,2,3,4,5,6,7,8"),
            line(80, "host", "D,5"),
            line(90, "robot", "z,Protocol error"),
            line(95, "robot", "n,unasked"),
            line(100, "host", "run demo"),
            line(110, "robot", "some words"),
            line(120, "host", "E"),
        ]
    )
    assert transcript.commands == {"D": 2, "N": 2, "E": 1, "run": 1}
    assert list(transcript.commands) == ["D", "N", "E", "run"]
    assert (transcript.count, transcript.replies, transcript.refused, transcript.unanswered) == (6, 3, 1, 2)
    assert (transcript.mean_s, transcript.longest_s) == (pytest.approx(0.02), pytest.approx(0.03))


def test_a_silent_line_has_no_statistics() -> None:
    line = wire([])
    assert (line.count, line.replies, line.unanswered, line.mean_s) == (0, 0, 0, 0)
