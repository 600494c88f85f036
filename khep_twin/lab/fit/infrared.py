"""Light that an infrared sensor gets back from a wall or a cylinder, for many poses at once.

The optics are those of `khep_twin.sensing.reflection`, for one object without others, to fit a calibration to
measurements and to compare both. Bearings and distances are those of a test bench: a robot turns on the spot
in front of an object; the distance is from its edge to the object's nearest point.
"""

from dataclasses import dataclass
from typing import Self

import numpy as np

from khep_twin.lab.fit.least_squares import Floats
from khep_twin.sensing import lobes
from khep_twin.sensing.calibration import ProximityCalibration
from khep_twin.units import BODY_RADIUS, SENSOR_HEIGHT

OBJECT_HEIGHT = 0.05
"""Height of walls and cylinders [m]: a playpen's default (not told of any that was measured)."""

_TOUCHING = 1e-4
"""Smallest distance of a surface [m]."""

_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(12)


@dataclass(frozen=True, slots=True)
class View:
    """Object before one sensor, at many poses.

    Attributes:
        bearings: Bearings of a wall's nearest point, or a cylinder's axis, off the sensor's axis (n,) [rad].
        distances: Distances of these from the sensor's face (n,) [m].
        radius: Radius of the cylinder [m]; 0 for a wall.
    """

    bearings: Floats
    distances: Floats
    radius: float = 0.0

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
        away, (x, y) = body_radius + distances + radius, sensor
        if not radius:
            return cls(_wrapped(bearings - heading), away - x * np.cos(bearings) - y * np.sin(bearings))
        ahead, left = away * np.cos(bearings) - x, away * np.sin(bearings) - y
        return cls(_wrapped(np.arctan2(left, ahead) - heading), np.hypot(ahead, left), radius)

    def light(self, offset: float, lobe_exponent: float) -> Floats:
        """Return the light that comes back to a chip behind the face (n,) [1/m^2].

        Args:
            offset: Offset of the chip behind the face [m].
            lobe_exponent: Exponent of the lobe in azimuth.
        """
        lengths, azimuths, lit = self._cylinder(offset) if self.radius else self._wall(offset)
        ahead = np.maximum(np.cos(azimuths), 0)
        whole = int(lobe_exponent)
        lobe = ahead**whole * (1 - (lobe_exponent - whole) * (1 - ahead)) * (ahead > 0)
        top, mirrored = OBJECT_HEIGHT - SENSOR_HEIGHT, -OBJECT_HEIGHT - SENSOR_HEIGHT
        filled = _below(top / lengths) - _below(mirrored / lengths)
        return (lit / lengths**2 * lobe * filled).sum(axis=1) / lobes.norm(lobe_exponent)

    def _wall(self, offset: float) -> tuple[Floats, Floats, Floats]:
        """Return lengths and azimuths of the way to points of the wall, and their cosines' arcs."""
        away = np.maximum(self.distances + offset * np.cos(self.bearings), _TOUCHING)
        # From one end of the wall, or of the lobe, to the other, in sines off the foot.
        edge = np.cos(self.bearings)
        low = np.where(self.bearings < 0, -edge, -1.0)[:, None]
        high = np.where(self.bearings < 0, 1.0, edge)[:, None]
        sines = (low + high) / 2 + (high - low) / 2 * _NODES
        # Of a wall right behind, the arc has no length, and lies where there is no distance.
        cosines = np.sqrt(np.maximum(1 - sines**2, 1e-12))
        lit = _WEIGHTS * (high - low) / 2
        return away[:, None] / cosines, self.bearings[:, None] + np.arcsin(sines), lit

    def _cylinder(self, offset: float) -> tuple[Floats, Floats, Floats]:
        """Return the same of points of the cylinder."""
        x = self.distances * np.cos(self.bearings) + offset
        y = self.distances * np.sin(self.bearings)
        away = np.maximum(np.hypot(x, y), self.radius + _TOUCHING)[:, None]
        axis = np.arctan2(y, x)[:, None]
        square = _NODES**2
        incidences = (1 - square) * np.sqrt(4 - square) / 2
        sines = _NODES * (3 - square) / 2 * self.radius / away
        cosines = np.sqrt(1 - sines**2)
        lengths = away * cosines - self.radius * incidences
        lit = _WEIGHTS * 1.5 * (1 - square) * incidences * self.radius / (away * cosines)
        return lengths, axis + np.arcsin(sines), lit


@dataclass(frozen=True, slots=True)
class Optics:
    """Calibration of one sensor's optics."""

    gain_counts_mm2: float
    threshold_counts: float
    offset_mm: float
    lobe_exponent: float

    @classmethod
    def of(cls, calibration: ProximityCalibration, sensor: int) -> Self:
        """Return the optics of one sensor of a calibration."""
        return cls(
            calibration.gain_counts_mm2[sensor],
            calibration.threshold_counts[sensor],
            calibration.offset_mm[sensor],
            calibration.lobe_exponent[sensor],
        )


def level(view: View, optics: Optics, reflectance: float = 1.0) -> Floats:
    """Return the counts of a sensor without noise, not rounded and not clipped (n_places,)."""
    light = view.light(optics.offset_mm * 1e-3, optics.lobe_exponent)
    return optics.gain_counts_mm2 * 1e-6 * reflectance * light - optics.threshold_counts


def _below(slopes: Floats) -> Floats:
    """Return the part of the lobe in elevation below a slope, less a half, as `reflection` has it."""
    sines = slopes / np.sqrt(1 + slopes**2)
    squares = sines * sines  # numpy's powers of negative numbers take 70 times as long
    return 35 / 32 * sines * (1 - squares * (1 - squares * (0.6 - squares / 7)))


def _wrapped(angles: Floats) -> Floats:
    """Return angles from -pi to pi [rad]."""
    return np.angle(np.exp(1j * angles))
