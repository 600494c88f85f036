"""Search for a robot that was put elsewhere, by its last replies."""

import numpy as np
import pytest
from twins import ALL, AT_THE_CRATE, SECOND, metric, planes_at, readings, setup_of

from khep_twin.randomness import stream
from khep_twin.shadow.actions import Commanded, Seen
from khep_twin.shadow.particle_filter import ParticleFilter
from khep_twin.shadow.search import KEPT_NS, Search
from khep_twin.shadow.start import PUBLISHED, begun
from khep_twin.shadow.wheel_commands import SPEED

ELSEWHERE = 560.0, 120.0, 100.0
TURNING = 3, -3


class Turning:
    """A robot that turns at the crate, its filter and the search."""

    def __init__(self) -> None:
        setup, rng = setup_of("workshop"), stream(0, "filter")
        self.robot, self._rng = planes_at(AT_THE_CRATE), stream(0, "robot")
        start = begun(setup, [metric(AT_THE_CRATE)], PUBLISHED, 500, rng)
        self.filter, self.search = ParticleFilter(setup, start, rng, 500), Search(setup, rng)
        self._act(Commanded(0, SPEED, *TURNING))
        self.robot.command(SPEED, *TURNING)

    def turn(self, seconds: float) -> int:
        """Turn on for a time; return it [ns]."""
        time_ns = 0
        for _ in range(round(seconds * 20)):
            self.robot.advance(5)
            time_ns = self.robot.ticks * SECOND // 100
            noisy = readings(self.robot) + self._rng.normal(0, 20, 8)
            self._act(Seen(time_ns, noisy.clip(0, 1023).astype(np.int64)))
            self.search.keep(time_ns, self.filter)
        return time_ns

    def _act(self, action: Commanded | Seen) -> None:
        self.search.note(action, self.filter.evidence)
        self.filter.act(action, ALL)


def test_a_robot_that_was_put_elsewhere_is_found_there_and_one_that_was_not_is_not() -> None:
    turning = Turning()
    since_ns = turning.turn(3)
    turning.turn(1)
    assert turning.search.odds(turning.filter, since_ns, ALL) < -10
    since_ns = turning.turn(0.2)
    turning.robot.move(np.array([metric(ELSEWHERE)]))
    turning.turn(1.5)
    assert turning.search.odds(turning.filter, since_ns, ALL) > 10
    found = turning.search.lost(since_ns, ALL)
    assert np.exp(found.logs).sum() == pytest.approx(1)
    assert np.ptp(found.planes.poses[:, :2], axis=0).max() > 0.1
    # What was before is forgotten.
    assert turning.search.odds(turning.filter, since_ns, ALL) == -np.inf


def test_the_time_after_which_it_was_lifted_need_not_be_one_of_a_snapshot() -> None:
    turning = Turning()
    since_ns = turning.turn(2.05)
    turning.robot.move(np.array([metric(ELSEWHERE)]))
    turning.turn(1.0)
    odds = turning.search.odds(turning.filter, since_ns, ALL)
    assert odds > max(turning.search.odds(turning.filter, since_ns - SECOND // 2, ALL), 0)


@pytest.mark.long
def test_what_was_too_long_ago_is_taken_for_the_first_that_is_known() -> None:
    turning = Turning()
    assert turning.search.odds(turning.filter, 0, ALL) == -np.inf
    time_ns = turning.turn(2 + KEPT_NS / SECOND)
    odds = [turning.search.odds(turning.filter, since_ns, ALL) for since_ns in (0, time_ns - KEPT_NS)]
    assert -1000 < min(odds) <= max(odds) < -10
