"""Planar model of an infrared sensor before a wall or a cylinder, without a traced scene.

The optics are those of `khep_twin.sensors`, for many poses at once: to fit a calibration to measurements, and
to compare both. Bearings and distances are those of a test bench: a robot turns on the spot in front of an
object; the distance is from its edge to the object's nearest point.
"""

from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import NDArray

from khep_twin.sensing.calibration import ProximityCalibration
from khep_twin.sensors import lobe_weights
from khep_twin.units import BODY_RADIUS, COUNTS_LIMIT, SENSOR_POSITIONS

Floats = NDArray[np.float64]

TANGENTS: Floats = (np.arange(9) + 0.5) / 9 * 2 - 1
"""Tangents of the angles between a sensor's axis and the rays of assets/khepera.xml."""


@dataclass(frozen=True, slots=True)
class RayHits:
    """Hits of one sensor's rays at many poses.

    Attributes:
        lengths: Lengths of the rays (n_places, n_rays) [m]; inf for a ray that hits nothing.
        incidences: Cosines between ray and surface normal (n_places, n_rays), 0 for such a ray.
    """

    lengths: Floats
    incidences: Floats


@dataclass(frozen=True, slots=True)
class Bench:
    """Sensor of a robot on a test bench.

    Attributes:
        position: Position of the sensor's face on the robot, x forward and y left (2,) [m].
        heading: Heading of the sensor, counter-clockwise from straight ahead [rad].
        tangents: Tangents of the rays' angles off its axis, to the right positive (n_rays,).
        radius: Radius of the robot [m].
    """

    position: tuple[float, float]
    heading: float
    tangents: Floats
    radius: float

    def wall(self, distances: Floats, bearings: Floats) -> RayHits:
        """Return the view of a wall at distances from the robot's edge [m] and bearings, ccw [rad]."""
        towards = _directions(bearings)
        cosines = towards @ self._rays().T
        away = self.radius + distances - towards @ np.array(self.position)
        met = cosines > 1e-9
        lengths = np.where(met, away[:, None] / np.where(met, cosines, 1), np.inf)
        return RayHits(lengths, np.where(met, cosines, 0))

    def cylinder(self, distances: Floats, bearings: Floats, radius: float) -> RayHits:
        """Return the view of an upright cylinder of a radius [m], likewise."""
        away = (self.radius + distances + radius)[:, None]
        centres = _directions(bearings) * away - np.array(self.position)
        along = centres @ self._rays().T
        tangential = (centres**2).sum(axis=1)[:, None] - along**2
        met = (tangential < radius**2) & (along > 0)
        depth = np.sqrt(np.where(met, radius**2 - tangential, 0))
        return RayHits(np.where(met, along - depth, np.inf), depth / radius)

    def _rays(self) -> Floats:
        return _directions(self.heading - np.arctan(self.tangents))


def _directions(angles: Floats) -> Floats:
    return np.column_stack([np.cos(angles), np.sin(angles)])


@dataclass(frozen=True, slots=True)
class MeasuredTable:
    """Readings of a robot in front of an object.

    Attributes:
        distances: Distances from the robot's edge to the object (n,) [m].
        bearings: Bearings of the object, counter-clockwise from ahead (n,) [rad].
        counts: Readings of the sensors (n, 8) [counts].
        radius: Radius of the cylinder [m]; 0 for a wall.
    """

    distances: Floats
    bearings: Floats
    counts: Floats
    radius: float

    def view(self, sensor: int, heading: float) -> RayHits:
        """Return the view of a sensor with a heading [rad]."""
        bench = Bench(SENSOR_POSITIONS[sensor], heading, TANGENTS, BODY_RADIUS)
        if self.radius:
            return bench.cylinder(self.distances, self.bearings, self.radius)
        return bench.wall(self.distances, self.bearings)


@dataclass(frozen=True, slots=True)
class Optics:
    """Calibration of one sensor's optics."""

    gain_counts_mm2: float
    threshold_counts: float
    offset_mm: float
    lobe_exponent: float
    incidence_exponent: float

    @classmethod
    def of(cls, calibration: ProximityCalibration, sensor: int) -> Self:
        """Return the optics of one sensor of a calibration."""
        return cls(
            calibration.gain_counts_mm2[sensor],
            calibration.threshold_counts[sensor],
            calibration.offset_mm[sensor],
            calibration.lobe_exponent[sensor],
            calibration.incidence_exponent[sensor],
        )


def proximity(
    view: RayHits,
    tangents: Floats,
    optics: Optics,
    reflectance: float = 1.0,
    limit_counts: int = COUNTS_LIMIT,
) -> Floats:
    """Return the counts of a sensor without noise, not rounded (n_places,)."""
    return np.clip(level(view, tangents, optics, reflectance), 0, limit_counts)


def level(view: RayHits, tangents: Floats, optics: Optics, reflectance: float = 1.0) -> Floats:
    """Return `proximity` before it is clipped (n_places,) [counts]."""
    weights = np.array(lobe_weights(tangents, optics.lobe_exponent))
    lit = np.where(view.incidences > 0, weights * view.incidences**optics.incidence_exponent, 0)
    light = (lit / (view.lengths * 1e3 + optics.offset_mm) ** 2).sum(axis=1)
    return optics.gain_counts_mm2 * reflectance * light - optics.threshold_counts
