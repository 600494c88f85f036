"""What an infrared sensor sees of a wall or a cylinder, worked out in the plane instead of traced in a scene.

The same optics as `khep_twin.sensors`, for many places at once: to fit a calibration to what a robot has
measured, and to compare both. Bearings and distances are those of a test bench: a robot that turns on the
spot, in front of an object whose nearest point is so far from the robot's edge.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from khep_twin.calibration import ProximityCalibration
from khep_twin.sensors import lobe_weights
from khep_twin.units import COUNTS_LIMIT

Floats = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class View:
    """What the rays of one sensor meet, in many places.

    Attributes:
        lengths: of the rays (n_places, n_rays) [m]; inf for a ray that meets nothing.
        incidences: cosine between ray and surface normal (n_places, n_rays), 0 for such a ray.
    """

    lengths: Floats
    incidences: Floats


@dataclass(frozen=True, slots=True)
class Bench:
    """A robot's sensor on a test bench.

    Attributes:
        position: of the sensor's face on the robot, x forward and y left (2,) [m].
        heading: where it looks, counter-clockwise from straight ahead [rad].
        tangents: of the rays' angles off its axis, to the right positive (n_rays,).
        radius: of the robot [m].
    """

    position: tuple[float, float]
    heading: float
    tangents: Floats
    radius: float

    def wall(self, distances: Floats, bearings: Floats) -> View:
        """A wall whose nearest point is so far off the robot's edge [m], at a bearing ccw from ahead [rad]."""
        towards, directions = self._towards(bearings), self._directions()
        cosines = towards @ directions.T
        away = self.radius + distances - towards @ np.array(self.position)
        met = cosines > 1e-9
        lengths = np.where(met, away[:, None] / np.where(met, cosines, 1), np.inf)
        return View(lengths, np.where(met, cosines, 0))

    def cylinder(self, distances: Floats, bearings: Floats, radius: float) -> View:
        """An upright cylinder of a radius [m], likewise."""
        towards, directions = self._towards(bearings), self._directions()
        centres = towards * (self.radius + distances + radius)[:, None] - np.array(self.position)
        along = centres @ directions.T
        aside = (centres**2).sum(axis=1)[:, None] - along**2
        met = (aside < radius**2) & (along > 0)
        depth = np.sqrt(np.where(met, radius**2 - aside, 0))
        return View(np.where(met, along - depth, np.inf), depth / radius)

    def _directions(self) -> Floats:
        angles = self.heading - np.arctan(self.tangents)
        return np.column_stack([np.cos(angles), np.sin(angles)])

    @staticmethod
    def _towards(bearings: Floats) -> Floats:
        return np.column_stack([np.cos(bearings), np.sin(bearings)])


def proximity(
    view: View, sensor: int, tangents: Floats, calibration: ProximityCalibration, reflectance: float = 1.0
) -> Floats:
    """Counts of a quiet sensor, not rounded (n_places,).

    Args:
        view: what it sees.
        sensor: its number.
        tangents: of its rays.
        calibration: of the robot.
        reflectance: of what it sees.
    """
    weights = np.array(lobe_weights(tangents, calibration.lobe_exponent))
    lit = weights * view.incidences**calibration.incidence_exponent * (view.incidences > 0)
    light = (lit / (view.lengths * 1e3 + calibration.offset_mm) ** 2).sum(axis=1)
    level = calibration.gain_counts_mm2[sensor] * reflectance * light - calibration.threshold_counts[sensor]
    return np.clip(level, 0, COUNTS_LIMIT)
