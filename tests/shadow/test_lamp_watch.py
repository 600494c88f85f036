"""Lamps that are off or elsewhere, by the ambient light that a robot replies to O."""

import functools
import math
from collections.abc import Mapping

import numpy as np
import pytest
from twins import SECOND, metric, particles_at, setup_of

from khep_twin.episodes.episode_setup import EpisodeSetup
from khep_twin.log.shadow_channels import Alarm, Suspicion
from khep_twin.randomness import stream
from khep_twin.shadow.lamp_watch import LampWatch
from khep_twin.shadow.planes import Twins

SOUND: Mapping[str, float] = {}
OFF, ELSEWHERE = {"power_w": 0.0}, {"x_mm": 250.0, "y_mm": 60.0}


@functools.cache
def robot_among(*changes: tuple[str, float]) -> Twins:
    """A robot of a playpen whose second lamp, in the open, differs from that of its particles."""
    playpen = setup_of("two-lamps").playpen
    screened, bulb = playpen.lamps
    lamps = screened, bulb.model_copy(update=dict(changes))
    return Twins(EpisodeSetup(playpen.model_copy(update={"lamps": lamps}), planar=True), 1)


class Watched:
    """A watch of a robot that goes round in circles, 11 mm from the lamp in the open at times.

    Twins are so much off [m] on average, and deviate by so much [m, m, rad].
    """

    def __init__(self, off: float = 0.0, apart: tuple[float, float, float] = (2e-3, 2e-3, 0.02)) -> None:
        self._off, self._apart = np.array([off, 0, 0]), apart
        self._particles = particles_at(*[(200, 200, 0)] * 60, name="two-lamps")
        self.watch = LampWatch(setup_of("two-lamps").playpen, self._particles.twins)
        self._rng = stream(0, "lamps")
        self._turn = 0
        self.ended: list[Alarm] = []

    def see(self, seconds: float, changes: Mapping[str, float]) -> list[str]:
        """See replies for a time; return the names of the alarms that last."""
        robot = robot_among(*changes.items())
        for _ in range(round(seconds * 10)):
            self._turn += 1
            angle = self._turn / 15
            pose, apart = np.array([metric(self._place(angle))]), self._rng.normal(0, 1, (60, 3))
            twins = pose + self._off + apart * self._apart
            for planes, poses in ((robot, pose), (self._particles.twins, twins)):
                planes.reset_poses(poses)
                planes.advance(1)
            dark, floor = float(robot.ambient["dark"]), float(robot.ambient["floor"])
            light = np.maximum(dark - robot.lamplight(0.0)[0].sum(axis=1), floor)
            readings = np.rint(light + self._rng.normal(0, 5, 8)).astype(np.int64)
            self.ended += self.watch.update(self._turn * SECOND // 10, readings, self._particles)
        return [alarm.fault for alarm in self.watch.alarms]

    def _place(self, angle: float) -> tuple[float, float, float]:
        return 200 + 118 * math.cos(angle), 200 + 118 * math.sin(angle), 90 + math.degrees(angle)


class Turning(Watched):
    """A watch of a robot that turns in the shadow of the screen, 20 mm from its edge."""

    def _place(self, angle: float) -> tuple[float, float, float]:
        return 380, 318, math.degrees(angle)


def test_lamps_as_they_are_told_are_no_fault_however_near_the_robot_is() -> None:
    watched = Watched()
    lowest = 500.0
    for _ in range(20):
        assert watched.see(1, SOUND) == []
        lowest = min(lowest, watched.watch.expected.min())
    assert lowest < 90  # Sensors were beyond their range.
    assert watched.ended == []


def test_a_robot_in_the_shadow_whose_twins_are_partly_in_the_light_tells_nothing_of_the_lamp() -> None:
    """An error of the pose lasts; it is one observation, however many replies it takes."""
    watched = Turning(off=0.012, apart=(8e-3, 8e-3, 0.03))
    watched.see(30, SOUND)
    assert all(suspicion.probability < 0.5 for suspicion in watched.watch.suspected)
    assert watched.watch.alarms == []


@pytest.mark.share(2)
@pytest.mark.parametrize(("changes", "fault"), [(OFF, "in-the-open off"), (ELSEWHERE, "in-the-open moved")])
def test_a_lamp_that_is_off_or_elsewhere_is_named_until_it_is_back(
    changes: Mapping[str, float], fault: str
) -> None:
    watched = Watched()
    watched.see(10, SOUND)
    assert watched.see(10, changes) == [fault]
    (alarm,) = watched.watch.alarms
    assert alarm.channel == "light"
    assert 8 * SECOND < alarm.since_ns <= alarm.raised_ns - SECOND < 20 * SECOND
    assert 0.95 < alarm.sureness < 1
    assert watched.see(12, SOUND) == []
    (ended,) = watched.ended
    assert ended.fault == fault
    assert 20 * SECOND < (ended.ended_ns or 0) < 32 * SECOND


def test_a_second_fault_may_follow_once_the_first_is_settled() -> None:
    watched = Watched()
    watched.see(5, SOUND)
    assert watched.see(15, ELSEWHERE) == ["in-the-open moved"]
    assert watched.see(10, OFF) == ["in-the-open off"]
    assert [alarm.fault for alarm in watched.ended] == ["in-the-open moved"]


def test_a_fault_is_suspected_before_it_has_an_alarm() -> None:
    watched = Watched()
    watched.see(10, SOUND)
    assert watched.watch.suspected == ()
    suspicions: list[Suspicion] = []
    while not watched.see(0.1, OFF):
        suspicions += watched.watch.suspected
    assert suspicions[0].channel == "light"
    assert {suspicion.faults for suspicion in suspicions} >= {("in-the-open off",)}
    assert all(suspicion.probability > 0.2 for suspicion in suspicions)
    assert watched.watch.suspected == ()


def test_what_is_expected_is_the_light_at_the_particles() -> None:
    particles = particles_at((110, 130, -135), name="two-lamps")
    particles.twins.advance(1)
    watch = LampWatch(setup_of("two-lamps").playpen, particles.twins)
    assert np.isnan(watch.expected).all()
    watch.update(0, np.full(8, 480), particles)
    assert watch.expected[2:4].max() < 300 < 400 < watch.expected[6:].min()
