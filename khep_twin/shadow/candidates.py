"""Faults that may begin now: of wheels, of things near the robot, and of one that is not in the playpen."""

import math
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from khep_twin.clock import NS_PER_S
from khep_twin.episodes.episode_setup import EpisodeSetup
from khep_twin.episodes.planar import plane as flat
from khep_twin.shadow.changes import FaultChange
from khep_twin.shadow.particle_filter import ParticleFilter
from khep_twin.shadow.thing_faults import Missing, Moved, Unexpected, things_of
from khep_twin.shadow.wheel_faults import SlippingWheel, of_wheels

NEAR = 0.12
"""Farthest distance of a thing from the robot's centre, to be missed or, moved a little, seen [m]."""

MET_NS = NS_PER_S
"""Time after which a thing that is near has been met: what happened to it before is seen by then [ns]."""

LEFT_NS = 4 * NS_PER_S
"""Time for which it is considered after it was near: twins that miss it may leave it [ns]."""


class Candidates:
    """Faults that may begin."""

    def __init__(self, setup: EpisodeSetup) -> None:
        self._things = things_of(setup)
        self._near: dict[str, tuple[int, int, int]] = {}
        """When each thing came near, was so last, and for how long it was not before [ns]."""

    def pass_by(self, time_ns: int, tracker: ParticleFilter) -> None:
        """Note which things are near."""
        _, (x, y, _), covariance = tracker.estimate(0)
        things = tracker.particles.planes.things[0]
        away = np.hypot(x - things[:, flat.CENTRE_X], y - things[:, flat.CENTRE_Y]) - things[:, flat.LENGTH]
        near: NDArray[np.bool_] = away < NEAR + math.sqrt(covariance[0, 0] + covariance[1, 1])
        for name, rows in self._things.items():
            came_ns, left_ns, unseen_ns = self._near.get(name, (0, -LEFT_NS, 0))
            if near[list(rows)].any():
                if time_ns - left_ns > MET_NS:
                    came_ns, unseen_ns = time_ns, time_ns - max(left_ns, 0)
                self._near[name] = came_ns, time_ns, unseen_ns

    def since(self, calm_ns: int, counted: bool) -> Iterator[FaultChange]:
        """Yield the faults that may have begun since the pose was confirmed last [ns].

        `counted` if counters tell which wheel stands or is slow.
        """
        for wheel in of_wheels():
            if not counted or isinstance(wheel, SlippingWheel):
                yield FaultChange(wheel, True)
        for name, (came_ns, left_ns, unseen_ns) in self._near.items():
            if calm_ns - left_ns < LEFT_NS:
                rows = self._things[name]
                unseen_s = unseen_ns / NS_PER_S if calm_ns - came_ns < MET_NS else 0.0
                yield FaultChange(Missing(name, rows), True, unseen_s)
                yield FaultChange(Moved(name, rows), True, unseen_s)
        yield FaultChange(Unexpected(), True)
