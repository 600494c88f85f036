"""Light reflected to an infrared sensor by a wall or a cylinder, vectorized over poses.

The optics are those of `khep_twin.sensing.reflection` for a single object. They serve to fit a calibration to
measurements, and to compare both. On a test bench, a robot turns on the spot in front of an object, at a
distance from its edge to the object's nearest point. `View.of` converts the object's bearings and distances
to those of one sensor: off the sensor's axis, and from its face.
"""

from dataclasses import dataclass
from typing import Self

import numpy as np

from khep_twin.lab.fit.least_squares import Floats
from khep_twin.sensing import lobes
from khep_twin.sensing.calibration import ProximityCalibration
from khep_twin.units import BODY_RADIUS, SENSOR_HEIGHT

OBJECT_HEIGHT = 0.05
"""Height of walls and cylinders [m]: a playpen's default (unknown for the measured ones)."""

_MIN_DISTANCE = 1e-4
"""Smallest distance of a surface from a sensor's chip [m]."""
_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(12)
"""Nodes from -1 to 1 and weights of the Gauss-Legendre quadrature over the points of an object."""


@dataclass(frozen=True, slots=True)
class View:
    """Object in front of one sensor, at n poses.

    Attributes:
        bearings: Bearings of a wall's nearest point, or a cylinder's axis, off the sensor's axis (n,) [rad].
        distances: Distances of that point or axis from the sensor's face (n,) [m].
        radius: Radius of the cylinder [m]; 0 for a wall.
        heights: Heights above the sensor of the object's top, and of its mirror image's in the floor [m].
    """

    bearings: Floats
    distances: Floats
    radius: float = 0.0
    heights: tuple[float, float] = (OBJECT_HEIGHT - SENSOR_HEIGHT, -OBJECT_HEIGHT - SENSOR_HEIGHT)

    @classmethod
    def of(
        cls,
        sensor: tuple[float, float],
        heading: float,
        distances: Floats,
        bearings: Floats,
        radius: float,
        body_radius: float = BODY_RADIUS,
    ) -> Self:
        """Return the view of a sensor on a robot.

        Args:
            sensor: Position of the sensor's face on the robot, x forward and y left [m].
            heading: Heading of the sensor, counter-clockwise from straight ahead [rad].
            distances: Distances of the object from the robot's edge (n,) [m].
            bearings: Bearings of the object, counter-clockwise from ahead (n,) [rad].
            radius: Radius of an upright cylinder [m]; 0 for a wall.
            body_radius: Radius of the robot [m].
        """
        radii, (x, y) = body_radius + distances + radius, sensor
        if not radius:
            return cls(_wrap(bearings - heading), radii - x * np.cos(bearings) - y * np.sin(bearings))
        forward, left = radii * np.cos(bearings) - x, radii * np.sin(bearings) - y
        return cls(_wrap(np.arctan2(left, forward) - heading), np.hypot(forward, left), radius)

    def light(
        self, offset: float, lobe_exponent: float, elevation_exponent: int = 3, mirror: float = 1.0
    ) -> Floats:
        """Return the light reflected to a chip behind the face (n,) [1/m^2].

        Args:
            offset: Offset of the chip behind the face [m].
            lobe_exponent: Exponent of the lobe in azimuth.
            elevation_exponent: Exponent of the lobe in elevation.
            mirror: Weight of the mirror image in the floor.
        """
        lengths, azimuths, weights = self._cylinder(offset) if self.radius else self._wall(offset)
        cosines = np.maximum(np.cos(azimuths), 0)
        integer_part = int(lobe_exponent)
        lobe = cosines**integer_part * (1 - (lobe_exponent - integer_part) * (1 - cosines)) * (cosines > 0)
        top, mirrored_top = self.heights
        far = lengths if self.radius else self._wall_length(offset, lobe_exponent)
        above, floor, below = (
            _share_below(height / far, elevation_exponent)
            for height in (top, (top + mirrored_top) / 2, mirrored_top)
        )
        elevation_share = above - floor + mirror * (floor - below)
        return (weights / lengths**2 * lobe * elevation_share).sum(axis=1) / lobes.norm(lobe_exponent)

    def _wall(self, offset: float) -> tuple[Floats, Floats, Floats]:
        """Return lengths, azimuths and weights of rays to a wall, for a chip `offset` [m] behind the face."""
        wall_distances = np.maximum(self.distances + offset * np.cos(self.bearings), _MIN_DISTANCE)
        # Integrate between the ends of the wall or the lobe, over sines of the angle from the perpendicular.
        lobe_limit = np.cos(self.bearings)
        low = np.where(self.bearings < 0, -lobe_limit, -1.0)[:, None]
        high = np.where(self.bearings < 0, 1.0, lobe_limit)[:, None]
        sines = (low + high) / 2 + (high - low) / 2 * _NODES
        # For a wall directly behind, the interval is empty and the distance undefined.
        cosines = np.sqrt(np.maximum(1 - sines**2, 1e-12))
        weights = _WEIGHTS * (high - low) / 2
        return wall_distances[:, None] / cosines, self.bearings[:, None] + np.arcsin(sines), weights

    def _wall_length(self, offset: float, lobe_exponent: float) -> Floats:
        """Return the distance of a wall where most light comes from, as in `reflection` (n, 1) [m]."""
        exponent = lobes.FOOT_EXPONENT + lobe_exponent
        x = lobe_exponent + lobes.FOOT_EXPONENT * np.cos(self.bearings)
        azimuths = np.arctan2(lobes.FOOT_EXPONENT * np.sin(self.bearings), x)
        lowest, highest = np.maximum(self.bearings, 0) - np.pi / 2, np.minimum(self.bearings, 0) + np.pi / 2
        arc = np.sin(highest) - np.sin(lowest)
        spread = np.minimum(1 / (exponent + 1), arc**2 / 12)
        cosines = np.cos(np.clip(azimuths, lowest, highest) - self.bearings)
        wall_distances = np.maximum(self.distances + offset * np.cos(self.bearings), _MIN_DISTANCE)
        return (wall_distances / np.maximum(cosines, 1e-6) * (1 + spread / 2))[:, None]

    def _cylinder(self, offset: float) -> tuple[Floats, Floats, Floats]:
        """Return the same as `_wall` for a cylinder."""
        x = self.distances * np.cos(self.bearings) + offset
        y = self.distances * np.sin(self.bearings)
        axis_distances = np.maximum(np.hypot(x, y), self.radius + _MIN_DISTANCE)[:, None]
        axis_azimuths = np.arctan2(y, x)[:, None]
        node_squares = _NODES**2
        cos_incidence = (1 - node_squares) * np.sqrt(4 - node_squares) / 2
        sines = _NODES * (3 - node_squares) / 2 * self.radius / axis_distances
        cosines = np.sqrt(1 - sines**2)
        lengths = axis_distances * cosines - self.radius * cos_incidence
        weights = (
            _WEIGHTS * 1.5 * (1 - node_squares) * cos_incidence * self.radius / (axis_distances * cosines)
        )
        return lengths, axis_azimuths + np.arcsin(sines), weights


@dataclass(frozen=True, slots=True)
class Optics:
    """Calibration of one sensor's optics."""

    gain_counts_mm2: float
    threshold_counts: float
    offset_mm: float
    lobe_exponent: float
    elevation_exponent: int = 3
    mirror: float = 1.0

    @classmethod
    def of(cls, calibration: ProximityCalibration, sensor: int) -> Self:
        """Return the optics of one sensor of a calibration."""
        return cls(
            calibration.gain_counts_mm2[sensor],
            calibration.threshold_counts[sensor],
            calibration.offset_mm[sensor],
            calibration.lobe_exponent[sensor],
            calibration.elevation_exponent,
            calibration.mirror,
        )


def unclipped_counts(view: View, optics: Optics, reflectance: float = 1.0) -> Floats:
    """Return the counts of a sensor without noise, not rounded and not clipped (n_places,)."""
    exponents = optics.lobe_exponent, optics.elevation_exponent
    light = view.light(optics.offset_mm * 1e-3, *exponents, optics.mirror)
    return optics.gain_counts_mm2 * 1e-6 * reflectance * light - optics.threshold_counts


def _share_below(slopes: Floats, exponent: int) -> Floats:
    """Return the share of the elevation lobe below a slope, less a half, as in `reflection`."""
    sines = slopes / np.sqrt(1 + slopes**2)
    squares = sines * sines  # numpy's powers of negative numbers take 70 times as long
    share = 35 / 32 * sines * (1 - squares * (1 - squares * (0.6 - squares / 7)))
    term = 5 / 32 * sines * (1 - squares) ** 3
    for power in range(7, exponent + 4, 2):
        term = term * (1 - squares) * (power / (power + 1))
        share = share + term
    return share


def _wrap(angles: Floats) -> Floats:
    """Return angles from -pi to pi [rad]."""
    return np.angle(np.exp(1j * angles))
