"""Faults that may start: of wheels, of obstacles near the robot, and of one that is not in the playpen."""

import math
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from khep_twin.clock import NS_PER_S
from khep_twin.episodes.episode_setup import EpisodeSetup
from khep_twin.episodes.planar import plane as flat
from khep_twin.shadow.changes import FaultChange
from khep_twin.shadow.particle_filter import ParticleFilter
from khep_twin.shadow.thing_faults import Missing, Moved, Unexpected, thing_rows
from khep_twin.shadow.wheel_faults import SlippingWheel, wheel_faults

NEAR_DISTANCE = 0.12
"""Distance from the robot's centre within which a missing or slightly moved obstacle shows [m]."""

DETECTED_NS = NS_PER_S
"""Time near an obstacle after which an earlier change of it is detected [ns]."""

EXPIRY_NS = 4 * NS_PER_S
"""Time for which an obstacle is considered after it was near: twins without it may leave it [ns]."""


class Candidates:
    """Faults that may start, by the obstacles that the robot has met."""

    def __init__(self, setup: EpisodeSetup) -> None:
        self._thing_rows = thing_rows(setup)
        self._encounters: dict[str, tuple[int, int, int]] = {}
        """Start and end of the last time near each obstacle, and time since the one before [ns]."""

    def note_encounters(self, time_ns: int, tracker: ParticleFilter) -> None:
        """Note which obstacles are near."""
        _, (x, y, _), covariance = tracker.estimate(0)
        things = tracker.particles.planes.things[0]
        distances = np.hypot(x - things[:, flat.CENTRE_X], y - things[:, flat.CENTRE_Y])
        limit = NEAR_DISTANCE + math.sqrt(covariance[0, 0] + covariance[1, 1])
        is_near: NDArray[np.bool_] = distances - things[:, flat.LENGTH] < limit
        for name, rows in self._thing_rows.items():
            arrival_ns, last_near_ns, unseen_ns = self._encounters.get(name, (0, -EXPIRY_NS, 0))
            if is_near[list(rows)].any():
                if time_ns - last_near_ns > DETECTED_NS:
                    arrival_ns, unseen_ns = time_ns, time_ns - max(last_near_ns, 0)
                self._encounters[name] = arrival_ns, time_ns, unseen_ns

    def changes_since(self, calm_ns: int, has_counters: bool) -> Iterator[FaultChange]:
        """Yield the faults that may have started since the pose was confirmed last [ns]."""
        for wheel in wheel_faults():
            # With counters, `WheelWatch` detects a wheel that stands or is slow.
            if not has_counters or isinstance(wheel, SlippingWheel):
                yield FaultChange(wheel, True)
        for name, (arrival_ns, last_near_ns, unseen_ns) in self._encounters.items():
            if calm_ns - last_near_ns < EXPIRY_NS:
                rows = self._thing_rows[name]
                unseen_s = unseen_ns / NS_PER_S if calm_ns - arrival_ns < DETECTED_NS else 0.0
                yield FaultChange(Missing(name, rows), True, unseen_s)
                yield FaultChange(Moved(name, rows), True, unseen_s)
        yield FaultChange(Unexpected(), True)
