"""Odometry by the counters of both wheels: each step is an arc of a circle.

The covariance of the pose is that of the noise of the motion in `khep_twin.shadow.motion_noise`, whose
errors of heading turn the way that follows; systematic errors of a calibration are not in it.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from khep_twin.clock import NS_PER_S
from khep_twin.robots.body import Body
from khep_twin.sensing.calibration import Calibration
from khep_twin.shadow.motion_noise import HEADING_NOISE, PLACE_NOISE

_SPEED_MARGIN = 1.5
"""Largest speed of a wheel over that of its unloaded motor (assumed); faster steps are jumps of a counter."""

_JUMP_MARGIN_RAD = 0.1
"""Turn of a wheel that is no jump after any time [rad] (assumed)."""

_LEAST_VARIANCE = 1e-6
"""Least variance of a place [m^2], speed or heading; consumers invert the matrices (assumed)."""

Floats = NDArray[np.float64]


class Track(NamedTuple):
    """Odometry at the times of samples.

    Attributes:
        poses: Poses x, y [m] and heading [rad], not wrapped (n, 3).
        speeds: Forward speed [m/s] and rate of turn [rad/s] since the previous sample (n, 2).
        angles: Angles of the left and right wheel [rad] (n, 2).
        rates: Their speeds [rad/s] (n, 2).
        pose_covariances: Covariances of the poses (n, 3, 3).
        speed_variances: Variances of the speeds (n, 2).
    """

    poses: Floats
    speeds: Floats
    angles: Floats
    rates: Floats
    pose_covariances: Floats
    speed_variances: Floats


class Odometry:
    """Odometry of a robot, from the first sample on; the first pose is 0.

    Args:
        body: Body of its model.
        calibration: Its calibration.
    """

    def __init__(self, body: Body, calibration: Calibration) -> None:
        wheels = calibration.wheels
        self._pulse = 2 * np.pi / body.pulses_per_turn
        self._radii, self._base = np.array(wheels.radii), wheels.base_mm * 1e-3
        self._top_rate = _SPEED_MARGIN * calibration.motors.no_load_speed_rad_s
        self._counts = np.zeros(2)
        self.restart()

    def restart(self) -> None:
        """Start anew with the next sample, at the pose 0."""
        self._time_ns: int | None = None
        # Pose, angles of the wheels, variance of the place, and sums of the noise of headings over the way.
        self._state = np.zeros(12)

    def advance(self, times_ns: NDArray[np.int64], counts: ArrayLike) -> Track:
        """Return the track for later samples: times (n,) [ns], counts of left and right wheel (n, 2)."""
        values = np.asarray(counts, np.float64)
        if self._time_ns is None:
            self._time_ns, self._counts = int(times_ns[0]), values[0]
            self._state[3:5] = values[0] * self._pulse
        passed_s = np.diff(times_ns, prepend=self._time_ns) / NS_PER_S
        steps = np.diff(values, axis=0, prepend=self._counts[None]) * self._pulse
        largest = self._top_rate * passed_s[:, None] + _JUMP_MARGIN_RAD
        # A counter that is set jumps: no wheel has turned.
        steps[~(np.abs(steps) <= largest).all(axis=1)] = 0
        self._time_ns, self._counts = int(times_ns[-1]), values[-1].copy()

        left, right = (steps * self._radii).T
        way, turn = (left + right) / 2, (right - left) / self._base
        headings = self._sum(2, turn)
        middle, chord = headings - turn / 2, way * np.sinc(turn / (2 * np.pi))
        x, y = self._sum(0, chord * np.cos(middle)), self._sum(1, chord * np.sin(middle))
        poses = np.column_stack([x, y, headings])
        angles = np.column_stack([self._sum(3 + side, steps[:, side]) for side in range(2)])
        rates = np.divide(steps.T, passed_s, out=np.zeros(steps.T.shape), where=passed_s > 0).T
        left_speeds, right_speeds = (rates * self._radii).T
        speeds = np.column_stack(
            [(left_speeds + right_speeds) / 2, (right_speeds - left_speeds) / self._base]
        )
        moving_s = passed_s * steps.any(axis=1)
        return Track(
            poses, speeds, angles, rates, self._pose_covariances(x, y, moving_s),
            self._speed_variances(passed_s, moving_s),
        )  # fmt: skip

    def _sum(self, index: int, steps: Floats) -> Floats:
        """Return the cumulative sums of steps, continued over calls."""
        sums = np.cumsum(np.concatenate([self._state[index : index + 1], steps]))[1:]
        self._state[index] = sums[-1]
        return sums

    def _pose_covariances(self, x: Floats, y: Floats, moving_s: Floats) -> Floats:
        """Return the covariances of poses after times of motion [s].

        An error of heading at a place (a, b) moves the end of the way at (x, y) by (b - y, x - a) times the
        error, and the errors are independent: sums over them need no loop over pairs.
        """
        noise = HEADING_NOISE**2 * moving_s
        place = self._sum(5, PLACE_NOISE**2 * moving_s)
        terms = noise, noise * x, noise * y, noise * x * x, noise * x * y, noise * y * y
        total, sum_x, sum_y, sum_xx, sum_xy, sum_yy = (
            self._sum(6 + index, term) for index, term in enumerate(terms)
        )
        covariances = np.empty((len(x), 3, 3))
        covariances[:, 0, 0] = total * y * y - 2 * y * sum_y + sum_yy + place
        covariances[:, 1, 1] = total * x * x - 2 * x * sum_x + sum_xx + place
        covariances[:, 0, 1] = -(total * x * y - x * sum_y - y * sum_x + sum_xy)
        covariances[:, 0, 2] = sum_y - total * y
        covariances[:, 1, 2] = total * x - sum_x
        covariances[:, 2, 2] = total
        covariances[:, [1, 2, 2], [0, 0, 1]] = covariances[:, [0, 0, 1], [1, 2, 2]]
        return covariances + _LEAST_VARIANCE * np.eye(3)

    def _speed_variances(self, passed_s: Floats, moving_s: Floats) -> Floats:
        """Return the variances of speeds: noise of the motion, and of counts in whole pulses."""
        duration = np.where(passed_s > 0, passed_s, np.inf)
        pulse = np.square(self._radii.mean() * self._pulse / duration)
        noise = np.square([PLACE_NOISE, HEADING_NOISE]) * (moving_s / duration**2)[:, None]
        # The difference of two rounded counts has a variance of 1/6.
        rounding = np.column_stack([pulse / 12, pulse / (3 * self._base**2)])
        return noise + rounding + _LEAST_VARIANCE
