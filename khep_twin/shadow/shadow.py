"""A shadow: the twin beside a robot, fed by the bytes of its line alone.

    shadow = Shadow(playpen, ShadowSettings(known=False))
    for update in shadow.feed(time_ns, to_robot, data):
        print(update.estimate.pose, update.alarms)

Commands move the particles (`particle_filter`) as they move the robot, replies to N, O, E and H weigh them.
Bytes and times alone decide: the same recording gives the same updates, bit for bit.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from khep_twin.clock import NS_PER_S
from khep_twin.episodes.episode_setup import EpisodeSetup
from khep_twin.log.exchanges import BANNER, Dialogue, Exchange
from khep_twin.playpen import Playpen
from khep_twin.randomness import stream
from khep_twin.shadow.actions import LATE_NS, Action, Counted, Restarted, Seen, Waited
from khep_twin.shadow.diagnosis import Diagnosis
from khep_twin.shadow.particle_filter import ParticleFilter
from khep_twin.shadow.particles import LearnedValues
from khep_twin.shadow.reckoning import Reckoning
from khep_twin.shadow.start import PUBLISHED, Spread, begun, known_starts
from khep_twin.shadow.update import NOTHING_ASKED, Residuals, Update
from khep_twin.units import BITS_PER_BYTE, N_SENSORS

Floats = NDArray[np.float64]

ANYWHERE = 20
"""Particles for each of those in `ShadowSettings`, while the robot may be anywhere."""

_LINE_END = 2
"""Bytes that end a reply."""

_LONGEST_NS = 100_000_000
"""Silence after which the pose is estimated without a reply [ns]."""


@dataclass(frozen=True, slots=True)
class ShadowSettings:
    """Settings of a shadow.

    Attributes:
        seed: Seed of its particles.
        particles: Number of particles once the pose is known.
        known: Whether the start is the playpen's, or one of its spots, to `spread`; False for anywhere.
        spread: What is known of the start and of the robot: standard deviations.
        baud: Speed of the robot's line [baud].
        others: Whether other robots drive in the playpen: what is seen where it has nothing may be one.
    """

    seed: int = 0
    particles: int = 1000
    known: bool = True
    spread: Spread = PUBLISHED
    baud: int = 9600
    others: bool = False


class Shadow:
    """The twin beside a robot.

    Args:
        playpen: Playpen with one robot, without movable things.
        settings: Settings.

    Raises:
        PlaypenError: The playpen has a feature that a plane does not support, or no room.
    """

    def __init__(self, playpen: Playpen, settings: ShadowSettings) -> None:
        self.settings = settings
        self._setup = EpisodeSetup(playpen, planar=True)
        rng = stream(settings.seed, "shadow")
        starts = known_starts(self._setup)
        count = settings.particles * (len(starts) if settings.known else ANYWHERE)
        start = begun(self._setup, starts if settings.known else None, settings.spread, count, rng)
        start.planes.others = settings.others
        tracker = ParticleFilter(self._setup, start, rng, settings.particles)
        hypotheses = stream(settings.seed, "shadow", "hypotheses")
        self._diagnosis = Diagnosis(self._setup, tracker, hypotheses)
        reckoned = begun(self._setup, starts, Spread(0, 0, 0, 0, 0, 0), 1, rng)
        self._reckoning = Reckoning(self._setup, reckoned.planes)
        self._dialogue = Dialogue(self._byte_ns)
        self._measured: Floats = np.full(N_SENSORS, np.nan)
        self._time_ns = 0

    @property
    def learned(self) -> LearnedValues:
        """Wheels and gains of the sensors as learned so far."""
        return self._diagnosis.filter.particles.learned()

    def feed(self, time_ns: int, to_robot: bool, data: bytes) -> list[Update]:
        """Add bytes that crossed the line; return what follows from the replies that they complete.

        Args:
            time_ns: Time of the bytes [ns], not before that of earlier ones.
            to_robot: True for a host's bytes, False for the robot's.
            data: Bytes.
        """
        found = (self._take(each) for each in self._dialogue.feed(time_ns, to_robot, data))
        return [update for update in found if update is not None]

    def wait(self, time_ns: int) -> list[Update]:
        """Advance to a time until which no more bytes came [ns]; return an update of the pose there."""
        found = [self._take(each) for each in self._dialogue.wait(time_ns)]
        updates = [update for update in found if update is not None]
        if time_ns - self._time_ns > _LONGEST_NS:
            self._time_ns = time_ns
            self._follow(Waited(time_ns))
            updates.append(self._update(NOTHING_ASKED))
        return updates

    @property
    def _byte_ns(self) -> int:
        return BITS_PER_BYTE * NS_PER_S // self.settings.baud

    def _take(self, exchange: Exchange) -> Update | None:
        """Repeat an exchange on the particles; return an update if its reply has values."""
        before = self._diagnosis.alarms
        self._diagnosis.hear(exchange)
        residuals = NOTHING_ASKED
        if exchange.reply is not None and BANNER in exchange.reply:
            self._reckoning.reset()
            self._follow(Restarted(exchange.heard_ns))
        if not exchange.command:
            return self._update(residuals) if before != self._diagnosis.alarms else None
        time_ns = late_ns = exchange.sent_ns + len(exchange.command) * self._byte_ns
        if exchange.reply is not None:
            # The reply began when the command was executed, unless something kept it, or the command.
            late_ns = exchange.heard_ns - (len(exchange.reply) + _LINE_END) * self._byte_ns
            residuals = residuals._replace(timing=(late_ns - time_ns) * 1e-9)
            if late_ns <= time_ns + LATE_NS:  # of which the command's is taken for half
                time_ns = max(exchange.sent_ns, min(late_ns, (time_ns + late_ns) // 2))
        time_ns = self._time_ns = max(time_ns, self._time_ns)
        late_ns = max(late_ns, time_ns)
        values = exchange.values
        if exchange.reply is None or values is not None:
            for action in self._reckoning.executed(time_ns, late_ns, exchange):
                self._follow(action)
        match exchange.letter, values:
            case "N", tuple() if len(values) == N_SENSORS:
                readings = np.array(values)
                self._follow(Seen(time_ns, readings, late_ns))
                self._measured = readings.astype(np.float64)
                residuals = residuals._replace(proximity=readings - self._diagnosis.filter.expected)
            case "H", (int(left), int(right)):
                beyond = self._follow(Counted(time_ns, np.array([left, right]), late_ns))
                residuals = residuals._replace(wheels=beyond)
            case "O", tuple() if len(values) == N_SENSORS:
                light = np.array(values)
                residuals = residuals._replace(light=light - self._diagnosis.see_light(time_ns, light))
            case _ if before == self._diagnosis.alarms:
                return None
            case _:
                pass
        return self._update(residuals)

    def _follow(self, action: Action) -> Floats:
        """Repeat an action on all twins; return what counters tell beyond commands (2,)."""
        self._reckoning.advance_to(action.time_ns)
        return self._diagnosis.follow(action)

    def _update(self, residuals: Residuals) -> Update:
        """Return the present state."""
        return Update(
            self._time_ns,
            self._diagnosis.filter.estimate(self._time_ns),
            self._reckoning.pose,
            self._diagnosis.filter.poses,
            self._diagnosis.filter.expected,
            self._measured,
            residuals,
            self._diagnosis.state,
            self._diagnosis.suspected,
            self._diagnosis.alarms,
            self._diagnosis.ended,
        )
