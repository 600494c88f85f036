"""Updates of a shadow: the pose of the robot, its faults, and the deviations of its replies."""

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from khep_twin.log.shadow_channels import Alarm, PoseState, Suspicion
from khep_twin.shadow.pose_estimate import Floats, PoseEstimate
from khep_twin.shadow.reckoning import Pose


class Residuals(NamedTuple):
    """Deviations of the last replies from the twins' expectations; NaN without a request.

    Attributes:
        proximity: Readings minus expected ones (s,) [counts].
        light: Ambient readings minus expected ones (s,) [counts].
        wheels: Counters minus expected ones since the last request, left and right (2,) [pulses].
        timing: Time of the reply beyond that of its bytes on the line [s].
    """

    proximity: Floats
    light: Floats
    wheels: Floats
    timing: float


@dataclass(frozen=True, slots=True)
class Update:
    """State of a shadow after a reply with values.

    Attributes:
        time_ns: Time at which the robot has read its registers, by the clock of the line [ns].
        estimate: Estimated pose.
        reckoned: Pose x, y [m], heading [rad] by commands alone, as the calibration's robot would drive.
        particles: Poses of equally probable particles (n, 3) [m, rad].
        expected: Expected proximity (s,) [counts].
        measured: Proximity of the last reply (s,) [counts]; NaN before the first.
        residuals: Deviations of the replies.
        state: State of the estimate.
        suspected: Faults that are suspected without an alarm, the most probable first.
        alarms: Alarms that last.
        ended: Alarms that have ended with this reply.
    """

    time_ns: int
    estimate: PoseEstimate
    reckoned: Pose
    particles: Floats
    expected: Floats
    measured: Floats
    residuals: Residuals
    state: PoseState
    suspected: tuple[Suspicion, ...]
    alarms: tuple[Alarm, ...]
    ended: tuple[Alarm, ...]


def no_residuals(n_sensors: int) -> Residuals:
    """Return the residuals of an update without a reply that has values."""
    return Residuals(np.full(n_sensors, np.nan), np.full(n_sensors, np.nan), np.full(2, np.nan), math.nan)
