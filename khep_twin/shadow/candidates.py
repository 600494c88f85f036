"""Faults that may have started: of wheels, of obstacles near the robot, or an obstacle not in the playpen."""

import math
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from khep_twin.clock import NS_PER_S
from khep_twin.episodes.episode_setup import EpisodeSetup
from khep_twin.episodes.planar import plane as planar
from khep_twin.shadow.changes import FaultChange
from khep_twin.shadow.particle_filter import ParticleFilter
from khep_twin.shadow.thing_faults import Missing, Moved, Unexpected, obstacle_rows
from khep_twin.shadow.wheel_faults import SlippingWheel, wheel_faults

NEAR_DISTANCE = 0.12
"""Distance from a Khepera's centre within which a missing or slightly moved obstacle shows [m]."""

DETECTED_NS = NS_PER_S
"""Time near an obstacle after which an earlier change of it is detected [ns]."""

EXPIRY_NS = 4 * NS_PER_S
"""Time after the robot was near an obstacle for which a fault of it is considered [ns]."""


class Candidates:
    """Faults that may start, by the obstacles that the robot has met."""

    def __init__(self, setup: EpisodeSetup) -> None:
        self._obstacle_rows = obstacle_rows(setup)
        self._encounters: dict[str, tuple[int, int, int]] = {}
        """Start and end of the last time near each obstacle, and time since the one before [ns]."""

    def record_encounters(self, time_ns: int, tracker: ParticleFilter) -> None:
        """Record which obstacles are near the pose that `tracker` estimates at a time [ns]."""
        _, (x, y, _), covariance = tracker.estimate(0)
        twins = tracker.particles.twins
        obstacles = twins.obstacles[0]
        distances = np.hypot(x - obstacles[:, planar.CENTRE_X], y - obstacles[:, planar.CENTRE_Y])
        limit = NEAR_DISTANCE * twins.scale + math.sqrt(covariance[0, 0] + covariance[1, 1])
        is_near: NDArray[np.bool_] = distances - obstacles[:, planar.HALF_LENGTH] < limit
        for name, rows in self._obstacle_rows.items():
            arrival_ns, last_near_ns, unseen_ns = self._encounters.get(name, (0, -EXPIRY_NS, 0))
            if is_near[list(rows)].any():
                if time_ns - last_near_ns > DETECTED_NS:
                    arrival_ns, unseen_ns = time_ns, time_ns - max(last_near_ns, 0)
                self._encounters[name] = arrival_ns, time_ns, unseen_ns

    def changes_since(self, calm_ns: int, has_counters: bool) -> Iterator[FaultChange]:
        """Yield faults that may have started since `calm_ns`, when a reply last confirmed the pose [ns]."""
        for wheel in wheel_faults():
            # With counters, `WheelWatch` detects a wheel that stands or is slow.
            if not has_counters or isinstance(wheel, SlippingWheel):
                yield FaultChange(wheel, True)
        for name, (arrival_ns, last_near_ns, unseen_ns) in self._encounters.items():
            if calm_ns - last_near_ns < EXPIRY_NS:
                rows = self._obstacle_rows[name]
                unseen_s = unseen_ns / NS_PER_S if calm_ns - arrival_ns < DETECTED_NS else 0.0
                yield FaultChange(Missing(name, rows), True, unseen_s)
                yield FaultChange(Moved(name, rows), True, unseen_s)
        yield FaultChange(Unexpected(), True)
