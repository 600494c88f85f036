"""The pose of a robot, by particles that drive as it does."""

import math
from collections.abc import Iterator

import numpy as np
import pytest
from scenes import arena, robot
from twins import ALL, AT_THE_CRATE, EXACT, OPEN, SECOND, metric, planes_at, readings, setup_of

from khep_twin import playpen as playpens
from khep_twin.episodes.episode_setup import EpisodeSetup
from khep_twin.errors import PlaypenError
from khep_twin.playpen import Playpen
from khep_twin.randomness import stream
from khep_twin.shadow.actions import CounterReply, ProximityReply, Silence, WheelCommand
from khep_twin.shadow.changes import FaultChange
from khep_twin.shadow.hypotheses import QUOTA
from khep_twin.shadow.particle_filter import ParticleFilter
from khep_twin.shadow.planes import Twins
from khep_twin.shadow.pose_estimate import MIN_DEVIATIONS, PoseEstimate
from khep_twin.shadow.start import PUBLISHED, Spread, draw_anywhere, draw_particles
from khep_twin.shadow.wheel_faults import wheel_faults

START = 360.0, 240.0, -70.0
TICKS = 6
"""Time between two replies [ticks]."""


def filtering(
    setup: EpisodeSetup, pose: tuple[float, float, float] | None, spread: Spread = PUBLISHED, count: int = 300
) -> ParticleFilter:
    particles = draw_particles(setup, [pose] if pose else None, spread, count, stream(0, "start"))
    return ParticleFilter(setup, particles, stream(0, "filter"), count if pose else 300)


def driven(robot: Twins, tracker: ParticleFilter, seconds: float) -> Iterator[PoseEstimate]:
    """Let a robot avoid obstacles, and the filter follow; yield its estimates."""
    for _ in range(round(seconds * 100 / TICKS)):
        robot.advance(TICKS)
        time_ns = robot.ticks * SECOND // 100
        counts = readings(robot)
        tracker.follow(ProximityReply(time_ns, counts), ALL)
        speeds = (4, -4) if counts[:5].max() > 250 else (7, 6)
        robot.command("D", *speeds)
        tracker.follow(WheelCommand(time_ns, "D", *speeds), ALL)
        yield tracker.estimate(time_ns)


def off_mm(estimate: PoseEstimate, robot: Twins) -> float:
    return 1e3 * math.dist(estimate.pose[:2], robot.poses[0, :2].tolist())


def test_a_robot_whose_start_is_known_is_followed() -> None:
    """The robot stands 10 mm and 4 degrees off, and has its own wheels."""
    robot = planes_at((367.0, 233.0, -66.0))
    robot.set_wheels(np.array([1.004]), np.array([1.002]), np.array([0.995]))
    tracker = filtering(setup_of("workshop"), metric(START))
    errors, deviations = np.array(
        [
            (off_mm(estimate, robot), 1e3 * math.sqrt(np.trace(estimate.covariance[:2, :2])))
            for estimate in driven(robot, tracker, 30)
        ]
    ).T
    late = len(errors) // 3
    assert np.median(errors[late:]) < 8
    assert errors.max() < 30
    # It knows how well it knows.
    assert deviations[-1] < deviations[0]
    assert 0.1 < np.median(errors[late:] / deviations[late:]) < 4


def test_particles_that_push_are_turned_by_what_they_push() -> None:
    """Noise must not take them off the wall, which turns the robot; no reply tells."""
    start = (671.0, 150.0, 70.0)
    robot = planes_at(start)
    tracker = filtering(setup_of("workshop"), metric(start), EXACT)
    for planes in (robot, tracker.particles.twins):
        planes.command("D", 3, 3)
    nothing = np.zeros(8, np.bool_)
    for _ in range(40):
        robot.advance(TICKS)
        tracker.follow(ProximityReply(robot.ticks * SECOND // 100, readings(robot)), nothing)
    turned = robot.poses[0, 2] - metric(start)[2]
    assert turned < math.radians(-30)
    estimate = tracker.estimate(0)
    assert estimate.pose[2] == pytest.approx(robot.poses[0, 2], abs=math.radians(5))
    assert off_mm(estimate, robot) < 4


def test_particles_that_stand_against_a_wall_stay() -> None:
    start = (671.0, 250.0, 0.0)
    robot = planes_at(start)
    tracker = filtering(setup_of("workshop"), metric(start), EXACT)
    for speed in (3, 0):
        for planes in (robot, tracker.particles.twins):
            planes.command("D", speed, speed)
        before = tracker.estimate(0)
        for _ in range(60):
            robot.advance(TICKS)
            tracker.follow(
                ProximityReply(robot.ticks * SECOND // 100, readings(robot)), np.zeros(8, np.bool_)
            )
    assert tracker.estimate(0).covariance[1, 1] < 1.5 * before.covariance[1, 1]


def test_particles_spread_in_the_open_where_no_reply_tells_them_apart(field: Playpen) -> None:
    setup = EpisodeSetup(field, planar=True)
    robot = Twins(setup, 1)
    robot.reset_poses(np.array([[1.5, 2.5, 0.0]]))
    tracker = filtering(setup, (1.5, 2.5, 0.0), EXACT)
    spreads = [math.sqrt(np.trace(estimate.covariance[:2, :2])) for estimate in driven(robot, tracker, 20)]
    assert not readings(robot).any()
    quarter = len(spreads) // 4
    assert 0 < spreads[quarter] < 0.9 * spreads[2 * quarter] < 0.8 * spreads[-1]
    assert spreads[-1] > 0.001
    assert off_mm(tracker.estimate(0), robot) < 20


def test_a_reading_counts_the_more_the_farther_the_robot_went_since_the_last() -> None:
    deviations: list[float] = []
    for speed in (0, 3, 10):
        tracker = filtering(setup_of("workshop"), metric(AT_THE_CRATE), EXACT)
        tracker.follow(WheelCommand(0, "D", -speed, speed), ALL)
        for turn in (30, 36):
            tracker.follow(ProximityReply(turn * SECOND // 100, np.full(8, 500)), ALL)
        deviations.append(float(tracker.surprisal.sum()))
    assert 0 < 3 * deviations[0] < deviations[1] < 0.6 * deviations[2]


def test_replies_are_more_probable_for_a_filter_that_is_right() -> None:
    robot = planes_at(AT_THE_CRATE)
    right, wrong = (
        filtering(setup_of("workshop"), metric(pose)) for pose in (AT_THE_CRATE, (250.0, 220.0, 0.0))
    )
    for tracker in (right, wrong):
        tracker.follow(WheelCommand(0, "D", 0, 0), ALL)
    robot.advance(TICKS)
    for turn in range(1, 20):
        action = ProximityReply(turn * TICKS * SECOND // 100, readings(robot))
        for tracker in (right, wrong):
            tracker.follow(action, ALL)
    assert right.surprisal.sum() < wrong.surprisal.sum()
    assert right.expected[3:5].min() > 100 > wrong.expected[3:5].max()


def test_counters_move_the_estimate_and_tell_what_commands_do_not() -> None:
    tracker = filtering(setup_of("workshop"), metric(START), EXACT)
    assert tracker.follow(CounterReply(0, np.array([100, 100])), ALL) == pytest.approx([0, 0])
    assert tracker.follow(CounterReply(SECOND, np.array([600, 600])), ALL) == pytest.approx([500, 500])
    way = math.dist(tracker.estimate(SECOND).pose[:2], metric(START)[:2])
    assert way == pytest.approx(0.04, abs=0.002)  # 500 pulses of 0.08 mm
    assert np.isnan(tracker.follow(ProximityReply(SECOND, np.zeros(8, np.int64)), ALL)).all()


def test_an_estimate_is_a_mean_by_the_weights_and_headings_are_a_circle() -> None:
    tracker = filtering(setup_of("workshop"), metric(START), EXACT, 2)
    tracker.particles.twins.reset_poses(np.array([(0.3, 0.2, math.pi - 0.1), (0.4, 0.2, 0.3 - math.pi)]))
    x, y, heading = tracker.estimate(7).pose
    assert (x, y) == pytest.approx((0.35, 0.2))
    assert math.remainder(heading - (math.pi + 0.1), math.tau) == pytest.approx(0)
    variances = np.diag(tracker.estimate(7).covariance) - np.square(MIN_DEVIATIONS)
    assert variances == pytest.approx([0.05**2, 0, 0.2**2])
    tracker.particles.log_weights = np.log([0.9, 0.1])
    assert tracker.estimate(7).pose[0] == pytest.approx(0.31)
    assert tracker.estimate(7).time_ns == 7


def test_an_estimate_goes_on_from_the_last_whole_tick_to_the_time_of_the_reply() -> None:
    tracker = filtering(setup_of("workshop"), metric(OPEN), EXACT)
    tracker.follow(WheelCommand(0, "D", 10, 10), ALL)
    tracker.follow(Silence(SECOND), ALL)
    x, *_ = tracker.estimate(SECOND).pose
    assert tracker.estimate(SECOND + 5_000_000).pose[0] - x == pytest.approx(0.0004, rel=0.05)  # 80 mm/s


def test_changes_of_speed_make_a_pose_less_certain() -> None:
    spreads: list[float] = []
    for speed in (1, 15):
        tracker = filtering(setup_of("workshop"), metric(OPEN), EXACT)
        for turn in range(20):
            time_ns = turn * SECOND // 10
            way = speed * (turn % 2 * 2 - 1)
            tracker.follow(WheelCommand(time_ns, "D", -way, way), ALL)
            tracker.follow(ProximityReply(time_ns + SECOND // 20, np.zeros(8, np.int64)), ALL)
        spreads.append(math.sqrt(tracker.estimate(2 * SECOND).covariance[2, 2]))
    assert 2 * spreads[0] < spreads[1] < math.radians(15)


@pytest.mark.parametrize(("places", "minimum"), [(1, 300), (4, 800)])
def test_the_more_places_are_possible_the_more_particles_are_kept(places: int, minimum: int) -> None:
    setup, x = setup_of("default"), np.linspace(0.15, 0.45, places)
    particles = draw_particles(
        setup, [(x_position, 0.25, 0.0) for x_position in x.tolist()], EXACT, 2400, stream(0, "start")
    )
    tracker = ParticleFilter(setup, particles, stream(0, "filter"), 300)
    tracker.follow(WheelCommand(0, "D", 1, 1), ALL)
    tracker.follow(ProximityReply(SECOND, np.zeros(8, np.int64)), ALL)
    assert minimum <= len(tracker.particles) <= 2 * minimum


def test_particles_that_are_taken_over_become_as_many_as_are_wanted_and_differ() -> None:
    tracker = filtering(setup_of("workshop"), metric(START))
    particles = draw_particles(setup_of("workshop"), [metric(AT_THE_CRATE)], EXACT, 10, stream(0, "few"))
    particles.log_weights -= 100
    tracker.replace_particles(particles)
    assert len(tracker.particles) == 300
    assert tracker.weights.sum() == pytest.approx(1)
    assert math.dist(tracker.estimate(0).pose, metric(AT_THE_CRATE)) < 0.01
    assert len(np.unique(tracker.particles.twins.poses[:, 0])) == 300


def test_an_unknown_start_is_anywhere_where_there_is_room() -> None:
    setup = setup_of("workshop")
    planes = Twins(setup, 400)
    poses = draw_anywhere(setup, planes, stream(0, "anywhere"))
    assert planes.are_clear(poses).all()
    assert np.ptp(poses, axis=0) == pytest.approx([0.6, 0.4, 6.2], abs=0.1)
    # Nobody stands outside of the outline, whose right lower corner is cut off.
    assert not ((poses[:, 0] > 0.45) & (poses[:, 1] < 0.07)).any()


def test_a_playpen_with_hardly_any_room_is_an_error_of_one_line() -> None:
    outline = "outline_mm = [[0, 0], [200, 0], [200, 55.3], [0, 55.3]]\n"
    tight = playpens.parse(arena(200, 100, "tight") + outline + robot(27.65, 27.65), "tight")
    setup = EpisodeSetup(tight, planar=True)
    with pytest.raises(PlaypenError, match="tight: no room for the robot was found; expected a start pose"):
        draw_anywhere(setup, Twins(setup, 50), stream(0, "anywhere"))


@pytest.mark.parametrize(
    ("start", "shift"), [(START, 0.8), ((60.0, 30.0, -90.0), 0.0)], ids=["free", "pushes"]
)
def test_a_robot_that_pushes_teaches_nothing_of_its_wheels(
    start: tuple[float, float, float], shift: float
) -> None:
    tracker = filtering(setup_of("workshop"), metric(start), Spread(1e-4, 1e-3, 0.01, 0.01, 0.01, 0))
    robot = planes_at(start)
    for planes in (robot, tracker.particles.twins):
        planes.command("D", 6, 6)
        planes.advance(10 * TICKS)
    before = tracker.particles.wheels[:, 1].copy()
    # Whatever makes some wheels the likelier ones.
    tracker.particles.log_weights = np.where(before > before.mean(), -5.0, -25.0)
    tracker.follow(ProximityReply(robot.ticks * SECOND // 100, readings(robot)), ALL)
    moved = tracker.particles.wheels[:, 1].mean() - before.mean()
    assert moved / before.std() == pytest.approx(shift, abs=0.25)


def test_faults_that_are_considered_add_their_quota_once() -> None:
    setup = setup_of("workshop")
    tracker = ParticleFilter(
        setup, draw_particles(setup, None, PUBLISHED, 3000, stream(0, "start")), stream(0, "f"), 300
    )
    robot = planes_at(START)
    counts: list[int] = []
    for _ in range(5):
        robot.advance(60)
        tracker.consider_changes([FaultChange(fault, True) for fault in wheel_faults()])
        tracker.follow(ProximityReply(robot.ticks * SECOND // 100, readings(robot)), ALL)
        counts.append(len(tracker.particles))
    assert max(counts) <= 3000 + QUOTA * 7, counts
