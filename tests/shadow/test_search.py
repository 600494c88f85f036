"""Search for changes of a robot, by its last replies."""

from collections.abc import Sequence

import numpy as np
import pytest
from twins import ALL, AT_THE_CRATE, CIRCLE, SECOND, metric, planes_at, readings, setup_of

from khep_twin.episodes.planar import plane as plane_data
from khep_twin.randomness import stream
from khep_twin.shadow import search
from khep_twin.shadow.actions import ProximityReply, WheelCommand
from khep_twin.shadow.changes import FaultChange
from khep_twin.shadow.displacements import Displaced, Lifted
from khep_twin.shadow.particle_filter import ParticleFilter
from khep_twin.shadow.pose_watch import Onset
from khep_twin.shadow.search import Search
from khep_twin.shadow.start import PUBLISHED, draw_particles
from khep_twin.shadow.thing_faults import Unexpected
from khep_twin.shadow.wheel_faults import StandingWheel

ELSEWHERE = 560.0, 120.0, 100.0
TURNING = 3, -3
CHANGES = [FaultChange(hypothesis, True) for hypothesis in (Lifted(), StandingWheel(0), Unexpected())]


class Turning:
    """A robot that turns at the crate, its filter and the search."""

    def __init__(self) -> None:
        setup, rng = setup_of("workshop", has_lamps=False), stream(0, "filter")
        self.robot, self._rng = planes_at(AT_THE_CRATE, has_lamps=False), stream(0, "robot")
        start = draw_particles(setup, [metric(AT_THE_CRATE)], PUBLISHED, 500, rng)
        self.filter, self.search = ParticleFilter(setup, start, rng, 500), Search(setup, rng)
        self.drive(TURNING)

    def drive(self, speeds: tuple[int, int]) -> None:
        """Drive at other speeds from now on."""
        self._act(WheelCommand(self.robot.ticks * SECOND // 100, "D", *speeds))
        self.robot.command("D", *speeds)

    def turn(self, seconds: float) -> int:
        """Turn on for a time; return it [ns]."""
        time_ns = 0
        for _ in range(round(seconds * 20)):
            self.robot.advance(5)
            time_ns = self.robot.ticks * SECOND // 100
            noisy = readings(self.robot) + self._rng.normal(0, 20, 8)
            self._act(ProximityReply(time_ns, noisy.clip(0, 1023).astype(np.int64)))
            self.search.save_snapshot(time_ns, self.filter)
        return time_ns

    def run_search(self, since_ns: int, changes: Sequence[FaultChange] = CHANGES) -> ParticleFilter:
        """Search for changes since a time [ns]."""
        tracker = self.search.search_since(self.filter, Onset(since_ns, (since_ns,), since_ns), changes, ALL)
        assert tracker is not None
        assert np.exp(tracker.particles.log_weights).sum() == pytest.approx(1)
        return tracker

    def _act(self, action: WheelCommand | ProximityReply) -> None:
        self.search.add_action(action)
        self.filter.follow(action, ALL)


def test_a_robot_that_was_put_elsewhere_is_found_there_and_one_that_was_not_is_not() -> None:
    turning = Turning()
    since_ns = turning.turn(3)
    turning.turn(1)
    assert turning.run_search(since_ns).probabilities[0] > 0.98
    since_ns = turning.turn(0.2)
    turning.robot.move(np.array([metric(ELSEWHERE)]))
    turning.turn(1.5)
    tracker = turning.run_search(since_ns)
    assert tracker.probabilities[1] > 0.98
    # The places that it may be at are far apart, and it is close to one of them.
    x, y, _ = (tracker.particles.twins.poses[tracker.particles.changes == 1]).T
    assert x.std() > 0.04
    assert np.hypot(x - 0.56, y - 0.12).min() < 0.03


@pytest.mark.long
def test_a_robot_that_is_a_little_off_is_found_there_and_not_elsewhere_in_any_order_of_changes() -> None:
    turning = Turning()
    since_ns = turning.turn(2)
    x, y, heading = turning.robot.poses[0].tolist()
    turning.robot.move(np.array([[x + 0.012, y - 0.008, heading - 0.3]]))
    turning.turn(1.5)
    tracker = turning.run_search(since_ns, [*CHANGES, FaultChange(Displaced(), True)])
    assert tracker.probabilities[4] > 0.98
    changes = [FaultChange(Displaced(), True), *reversed(CHANGES)]
    assert turning.run_search(since_ns, changes).probabilities[1] > 0.98
    assert np.hypot(*(tracker.estimate(0).pose - turning.robot.poses[0])[:2]) < 0.01


@pytest.mark.long
def test_a_robot_that_was_put_elsewhere_seconds_ago_is_found_there() -> None:
    turning = Turning()
    since_ns = turning.turn(2)
    turning.robot.move(np.array([metric(ELSEWHERE)]))
    turning.turn(4)
    assert turning.run_search(since_ns).probabilities[1] > 0.98


@pytest.mark.long
def test_a_robot_is_found_by_all_that_it_has_seen_where_the_first_sight_fits_many_places() -> None:
    turning = Turning()
    since_ns = turning.turn(2)
    turning.robot.move(np.array([metric((669, 142, 233))]))
    turning.turn(0.6)
    for speeds in ((6, 6), TURNING, (6, 6)):
        turning.drive(speeds)
        turning.turn(1)
    tracker = turning.run_search(since_ns)
    assert tracker.probabilities[1] > 0.98
    lifted = tracker.particles.changes == 1
    off = np.hypot(*(tracker.particles.twins.poses[lifted] - turning.robot.poses[0])[:, :2].T)
    assert tracker.weights[lifted][off < 0.03].sum() > 0.5


def test_a_thing_that_was_added_is_found_where_it_is() -> None:
    turning = Turning()
    since_ns = turning.turn(2)
    x, y, _ = turning.robot.poses[0].tolist()
    turning.robot.obstacles[:, -1, CIRCLE] = x - 0.02, y + 0.05, 0.012, -1, 0.05, 1, 1
    turning.robot.remeasure()
    turning.turn(2)
    tracker = turning.run_search(since_ns, [*CHANGES, FaultChange(Displaced(), True)])
    assert tracker.probabilities[3] > 0.98
    places = tracker.particles.twins.obstacles[tracker.particles.changes == 3, -1]
    weights = tracker.weights[tracker.particles.changes == 3]
    place = np.average(places[:, [plane_data.CENTRE_X, plane_data.CENTRE_Y]], axis=0, weights=weights)
    # With eight random streams it was 5 to 18 mm off.
    assert place == pytest.approx([x - 0.02, y + 0.05], abs=0.02)


@pytest.mark.long
def test_a_wheel_that_has_come_to_a_stand_is_told_from_a_robot_that_was_put_elsewhere() -> None:
    turning = Turning()
    since_ns = turning.turn(2)
    turning.robot.strength[:, 0] = 0
    turning.turn(1.2)
    assert turning.run_search(since_ns).probabilities[2] > 0.9


@pytest.mark.long
def test_nothing_is_told_of_what_was_too_long_ago(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(search, "MAX_AGE_NS", SECOND)
    turning = Turning()
    nothing = turning.search.search_since(turning.filter, Onset(0, (0,), 0), CHANGES, ALL)
    assert nothing is None
    turning.turn(2)
    assert turning.run_search(0).probabilities[0] > 0.9


@pytest.mark.long
def test_what_is_known_while_something_else_is_likely_is_not_kept() -> None:
    turning = Turning()
    since_ns = turning.turn(2)
    turning.robot.move(np.array([metric(ELSEWHERE)]))
    turning.turn(0.5)
    turning.filter = turning.run_search(since_ns)
    turning.turn(1)
    # The next search begins before that, too.
    assert turning.run_search(since_ns).probabilities[1] > 0.98
