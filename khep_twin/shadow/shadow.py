"""A shadow: a twin that follows a robot by the bytes of its line alone.

    shadow = Shadow(playpen, ShadowSettings(known=False))
    for update in shadow.feed(time_ns, to_robot, data):
        print(update.estimate.pose, update.alarms)

Commands move the particles (`particle_filter`) as they move the robot; replies to N, O, E and H weight them.
Updates depend on bytes and times alone: the same recording gives the same updates, bit for bit.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from khep_twin.clock import NS_PER_S
from khep_twin.episodes.episode_setup import EpisodeSetup
from khep_twin.log.exchanges import BANNER, Dialogue, Exchange
from khep_twin.playpen import Playpen
from khep_twin.randomness import stream
from khep_twin.shadow.actions import (
    LATE_NS,
    Action,
    CounterReply,
    ProximityReply,
    Restart,
    Silence,
    SonarReply,
)
from khep_twin.shadow.diagnosis import Diagnosis
from khep_twin.shadow.particle_filter import ParticleFilter
from khep_twin.shadow.particles import Floats, LearnedValues
from khep_twin.shadow.reckoning import Reckoning
from khep_twin.shadow.sonar_model import distances_of
from khep_twin.shadow.start import PUBLISHED, Spread, draw_particles, known_starts
from khep_twin.shadow.update import Residuals, Update, no_residuals
from khep_twin.units import BITS_PER_BYTE

ANYWHERE_FACTOR = 20
"""Multiple of the particles in `ShadowSettings` while the robot may be anywhere."""

_LINE_END_BYTES = 2
"""Bytes that end a reply."""

_MAX_SILENCE_NS = 100_000_000
"""Silence after which the pose is estimated without a reply [ns]."""


@dataclass(frozen=True, slots=True)
class ShadowSettings:
    """Settings of a shadow.

    Attributes:
        seed: Seed of its particles.
        particles: Number of particles once the pose is known.
        known: Whether the start is the playpen's or one of its spots, with `spread`; False for anywhere.
        spread: Standard deviations of the start and of the robot's values.
        baud: Baud rate of the robot's line.
        others: Whether other robots drive in the playpen: an unexpected obstacle may be one.
    """

    seed: int = 0
    particles: int = 1000
    known: bool = True
    spread: Spread = PUBLISHED
    baud: int = 9600
    others: bool = False


class Shadow:
    """A twin that follows a robot.

    Args:
        playpen: Playpen with one robot, without movable objects.
        settings: Settings.

    Raises:
        PlaypenError: The playpen has a feature that the 2-D model does not support, or no room.
    """

    def __init__(self, playpen: Playpen, settings: ShadowSettings) -> None:
        self.settings = settings
        self._setup = EpisodeSetup(playpen, planar=True)
        rng = stream(settings.seed, "shadow")
        starts = known_starts(self._setup)
        count = settings.particles * (len(starts) if settings.known else ANYWHERE_FACTOR)
        particle_starts = starts if settings.known else None
        particles = draw_particles(self._setup, particle_starts, settings.spread, count, rng)
        particles.twins.has_other_robots = settings.others
        tracker = ParticleFilter(self._setup, particles, rng, settings.particles)
        diagnosis_rng = stream(settings.seed, "shadow", "hypotheses")
        self._diagnosis = Diagnosis(self._setup, tracker, diagnosis_rng)
        reckoned_twin = draw_particles(self._setup, starts, Spread(0, 0, 0, 0, 0, 0), 1, rng)
        self._reckoning = Reckoning(self._setup.core, reckoned_twin.twins)
        model = self._setup.entry.robot_model
        self._model, self._n_sensors = model, particles.twins.n_sensors
        self._channels = {read.request: (channel, read) for channel, read in model.dialect.reads.items()}
        self._dialogue = Dialogue(self._byte_ns)
        self._measured: Floats = np.full(self._n_sensors, np.nan)
        self._time_ns = 0

    @property
    def learned(self) -> LearnedValues:
        """Wheels and sensor gains as learned so far."""
        return self._diagnosis.filter.particles.learned()

    def feed(self, time_ns: int, to_robot: bool, data: bytes) -> list[Update]:
        """Add bytes that crossed the line; return the updates by the replies that they complete.

        Args:
            time_ns: Time of the bytes [ns], not before that of earlier ones.
            to_robot: True for a host's bytes, False for the robot's.
            data: Bytes.
        """
        updates = (self._process(exchange) for exchange in self._dialogue.feed(time_ns, to_robot, data))
        return [update for update in updates if update is not None]

    def wait(self, time_ns: int) -> list[Update]:
        """Advance to a time until which no more bytes came [ns]; return the updates."""
        reply_updates = [self._process(exchange) for exchange in self._dialogue.expire(time_ns)]
        updates = [update for update in reply_updates if update is not None]
        if time_ns - self._time_ns > _MAX_SILENCE_NS:
            self._time_ns = time_ns
            self._follow(Silence(time_ns))
            updates.append(self._update(no_residuals(self._n_sensors)))
        return updates

    @property
    def _byte_ns(self) -> int:
        return BITS_PER_BYTE * NS_PER_S // self.settings.baud

    def _process(self, exchange: Exchange) -> Update | None:
        """Apply an exchange to the particles; return an update if its reply has values."""
        old_alarms = self._diagnosis.alarms
        self._diagnosis.start_exchange(exchange)
        residuals = no_residuals(self._n_sensors)
        if exchange.reply is not None and BANNER in exchange.reply:
            self._reckoning.reset()
            self._follow(Restart(exchange.reply_ns))
        if not exchange.command:
            return self._update(residuals) if old_alarms != self._diagnosis.alarms else None
        time_ns = late_ns = exchange.sent_ns + len(exchange.command) * self._byte_ns
        if exchange.reply is not None:
            # The reply started when the command was executed, unless the reply or the command was delayed.
            late_ns = exchange.reply_ns - (len(exchange.reply) + _LINE_END_BYTES) * self._byte_ns
            residuals = residuals._replace(timing=(late_ns - time_ns) * 1e-9)
            if late_ns <= time_ns + LATE_NS:  # Half of the delay is taken for that of the command.
                time_ns = max(exchange.sent_ns, min(late_ns, (time_ns + late_ns) // 2))
        time_ns = self._time_ns = max(time_ns, self._time_ns)
        late_ns = max(late_ns, time_ns)
        values = exchange.values
        if exchange.reply is None or values is not None:
            for action in self._reckoning.execute(time_ns, late_ns, exchange):
                self._follow(action)
        channel, readings = self._readings(exchange)
        match channel:
            case "proximity":
                in_sight = bool(readings.max() > self._model.body.near_counts)
                self._follow(ProximityReply(time_ns, readings, late_ns, in_sight))
                self._measured = readings.astype(np.float64)
                residuals = residuals._replace(proximity=readings - self._diagnosis.filter.expected)
            case "ultrasonic":
                distances = distances_of(self._model, readings)
                self._follow(SonarReply(time_ns, distances, late_ns, bool(np.isfinite(distances).any())))
            case "position":
                wheel_residuals = self._follow(CounterReply(time_ns, readings, late_ns))
                residuals = residuals._replace(wheels=wheel_residuals)
            case "ambient":
                light = readings - self._diagnosis.update_lamps(time_ns, readings)
                residuals = residuals._replace(light=light)
            case _ if old_alarms == self._diagnosis.alarms:
                return None
            case _:
                pass
        return self._update(residuals)

    def _readings(self, exchange: Exchange) -> tuple[str, NDArray[np.int64]]:
        """Return the channel of a reply, and its readings, of sensors around; empty without any."""
        channel, read = self._channels.get(exchange.letter, ("", None))
        if read is None or exchange.values is None or len(exchange.values) != read.n_values:
            return "", np.zeros(0, np.int64)
        n_readings = self._n_sensors if channel in ("proximity", "ambient") else None
        return channel, np.array([exchange.values[index] for index in read.values][:n_readings])

    def _follow(self, action: Action) -> Floats:
        """Apply an action to all twins; return the residual of counters (2,)."""
        self._reckoning.advance_to(action.time_ns)
        return self._diagnosis.follow(action)

    def _update(self, residuals: Residuals) -> Update:
        """Return an update with the present state."""
        diagnosis, tracker = self._diagnosis, self._diagnosis.filter
        poses = tracker.estimate(self._time_ns), self._reckoning.pose, tracker.poses
        readings = tracker.expected, self._measured
        faults = diagnosis.suspected, diagnosis.alarms, diagnosis.ended
        return Update(self._time_ns, *poses, *readings, residuals, diagnosis.state, *faults)
