"""Faults of a robot, by its replies and the expectations of its particles."""

import math

import numpy as np
import pytest
from twins import CIRCLE, SECOND, metric, planes_at, readings, setup_of

from khep_twin.episodes.planar import plane as plane_data
from khep_twin.log.exchanges import Exchange
from khep_twin.log.shadow_channels import Alarm, PoseState
from khep_twin.randomness import stream
from khep_twin.shadow.actions import CounterReply, ProximityReply, WheelCommand
from khep_twin.shadow.diagnosis import Diagnosis
from khep_twin.shadow.particle_filter import ParticleFilter
from khep_twin.shadow.start import PUBLISHED, draw_particles
from khep_twin.shadow.thresholds import THRESHOLDS

START = 360.0, 240.0, -70.0
TICKS = 6
"""Time between two replies [ticks]."""
LATENESS_NS = 5_000_000
"""Lateness of a reply to H, as on any line [ns]."""


class Driven:
    """A robot in a plane that turns away from obstacles, its diagnosis, and the alarms so far."""

    def __init__(
        self, seed: int, counters: bool = False, particles: int = 300, has_others: bool = False
    ) -> None:
        setup = setup_of("workshop", has_lamps=False)
        self.robot = planes_at((START[0] + 5, START[1] - 4, START[2] + 3), has_lamps=False)
        start = draw_particles(setup, [metric(START)], PUBLISHED, particles, stream(seed, "start"))
        start.twins.has_other_robots = has_others
        tracker = ParticleFilter(setup, start, stream(seed, "filter"), particles)
        self.diagnosis = Diagnosis(setup, tracker, stream(seed, "hypotheses"))
        self._rng, self._counters = stream(seed, "robot"), counters
        self._turning, self._side = 0, 1
        self.raised: dict[tuple[str, int], Alarm] = {}
        self.ended: list[Alarm] = []
        self.suspected: list[float] = []

    def drive(self, seconds: float) -> None:
        """Drive on for a time."""
        diagnosis, robot = self.diagnosis, self.robot
        for _ in range(round(seconds * 100 / TICKS)):
            robot.advance(TICKS)
            time_ns = robot.ticks * SECOND // 100
            diagnosis.start_exchange(Exchange(b"N", time_ns, b"n,0,0,0,0,0,0,0,0", time_ns))
            light = readings(robot)
            noisy = np.where(light > 0, light + self._rng.normal(0, 20, 8), self._rng.exponential(2, 8))
            diagnosis.follow(ProximityReply(time_ns, noisy.clip(0, 1023).astype(np.int64)))
            if self._counters:
                angles = robot.robots["joints"][0, [plane_data.LEFT_ANGLE, plane_data.RIGHT_ANGLE]]
                counts = np.rint(angles * 600 / math.tau).astype(np.int64)
                diagnosis.follow(CounterReply(time_ns, counts, time_ns + LATENESS_NS))
            left, right = speeds = self._decide(light)
            robot.command("D", left, right)
            diagnosis.follow(WheelCommand(time_ns, "D", *speeds))
            self.raised |= {(alarm.fault, alarm.raised_ns): alarm for alarm in diagnosis.alarms}
            self.ended += diagnosis.ended
            self.suspected += [suspicion.probability for suspicion in diagnosis.suspected]

    @property
    def names(self) -> list[str]:
        """Names of the alarms so far, in their order."""
        return [fault for fault, _ in self.raised]

    @property
    def off_mm(self) -> float:
        """Error of the estimate."""
        x, y, _ = self.diagnosis.filter.estimate(0).pose
        return 1e3 * math.dist((x, y), self.robot.poses[0, :2].tolist())

    def _decide(self, light: np.ndarray) -> tuple[int, int]:
        if self._turning:
            self._turning -= 1
            return 4 * self._side, -4 * self._side
        if light[:5].max() > 250:
            self._turning = int(self._rng.integers(6, 16))
            self._side = 1 if light[:3].sum() > light[3:5].sum() else -1
        return 7, 6


@pytest.mark.share(5)
@pytest.mark.parametrize(
    ("seed", "seconds", "particles"), [(0, 10, 300), *((seed, 20, 1000) for seed in range(4))]
)
def test_a_sound_robot_has_no_alarms(seed: int, seconds: int, particles: int) -> None:
    driven = Driven(seed, particles=particles)
    driven.drive(seconds)
    assert driven.names == []
    assert driven.off_mm < 10


@pytest.mark.share(3)
@pytest.mark.parametrize(("counters", "particles"), [(True, 300), (False, 1000), (True, 1000)])
def test_a_motor_that_dies_is_named_until_it_runs_again(counters: bool, particles: int) -> None:
    driven, dead = Driven(2, counters, particles), "dead motor or blocked wheel left"
    driven.drive(4)
    driven.robot.strength[:, 0] = 0
    driven.drive(4)
    # By the counters a wheel that comes to a stand is weak for a moment.
    assert set(driven.names) - {"weak motor left"} == {dead}
    (alarm,) = driven.diagnosis.alarms
    assert (alarm.fault, alarm.channel) == (dead, "wheels")
    assert alarm.since_ns < alarm.raised_ns
    assert 4 * SECOND < alarm.raised_ns < 8 * SECOND
    assert 0.9 < alarm.sureness <= 1
    driven.robot.strength[:, 0] = 1
    driven.drive(4)
    assert driven.diagnosis.alarms == ()
    # All that began has ended, and nothing else.
    ended = [(alarm.fault, alarm.raised_ns) for alarm in driven.ended]
    assert sorted(ended) == sorted(driven.raised)
    assert driven.off_mm < 20


@pytest.mark.long
def test_a_robot_that_was_put_elsewhere_is_told_for_a_second_and_lost_until_it_is_found() -> None:
    driven = Driven(2)
    driven.drive(4)
    driven.robot.move(np.array([metric((80.0, 371.0, -45.0))]))
    driven.drive(1.5)
    assert driven.names == ["robot lifted"]
    assert driven.diagnosis.state is PoseState.LOST
    assert 0.5 < max(driven.suspected) <= THRESHOLDS.suspicion_factor  # until it was certain
    driven.drive(1)
    assert driven.diagnosis.alarms == ()
    assert [alarm.fault for alarm in driven.ended] == ["robot lifted"]


@pytest.mark.long
def test_a_thing_that_is_not_in_the_playpen_is_no_fault_where_other_robots_drive() -> None:
    driven = Driven(2, has_others=True)
    driven.drive(4)
    x, y, heading = driven.robot.poses[0].tolist()
    place = x + 0.05 * math.cos(heading), y + 0.05 * math.sin(heading)
    driven.robot.obstacles[:, -1, CIRCLE] = *place, 0.02, -1, 0.05, 1, 1
    driven.robot.remeasure()
    driven.drive(3)
    assert driven.names == []


@pytest.mark.long
def test_a_robot_that_was_pushed_a_little_is_followed_without_an_alarm() -> None:
    driven = Driven(2)
    driven.drive(4)
    x, y, heading = driven.robot.poses[0].tolist()
    driven.robot.move(np.array([[x + 0.008, y - 0.008, heading + 0.2]]))
    driven.drive(8)
    assert driven.names == []
    assert driven.off_mm < 10


def test_ended_alarms_are_those_of_the_last_exchange() -> None:
    driven = Driven(0)
    driven.diagnosis.start_exchange(Exchange(b"", 0, b"ROM of minirobot KHEPERA", 0))
    assert [alarm.fault for alarm in driven.diagnosis.alarms] == ["restart"]
    driven.diagnosis.start_exchange(Exchange(b"N", 5 * SECOND, b"n,0,0,0,0,0,0,0,0", 5 * SECOND))
    assert [alarm.fault for alarm in driven.diagnosis.ended] == ["restart"]
    driven.diagnosis.start_exchange(Exchange(b"N", 6 * SECOND, b"n,0,0,0,0,0,0,0,0", 6 * SECOND))
    assert driven.diagnosis.ended == ()
