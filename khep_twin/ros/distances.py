"""Readings of sensors as distances, by the laws of the calibration, and without one by REP 117.

An infrared sensor reads, before a wide white wall that faces it at a distance d (`sensing.reflection`),

    counts = gain / (d + offset)^2 - threshold

so its inverse is a distance for this wall alone. A nearer one is minus infinity, nothing in range infinity.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from khep_twin.robots.model import RobotModel
from khep_twin.sensing.calibration import Calibration

_DEVIATIONS, _IDLE_MEANS = 3.0, 5.0
"""Noise above which a reading is an obstacle: standard deviations; means of the exponential idle noise, of
which 1 in 150 is larger (assumed)."""

Floats = NDArray[np.float64]


class Beam(NamedTuple):
    """Beam of a sensor.

    Attributes:
        name: Name of the sensor's topic and frame, e.g. "ps0".
        position: Position on the robot (3,) [m].
        heading: Heading [rad]; NaN for a sensor that looks down.
        field_of_view: Whole angle within which its sensitivity is at least half of the largest [rad].
        nearest: Least distance [m].
        reach: Largest distance [m].
        is_infrared: True for infrared, false for ultrasonic.
    """

    name: str
    position: tuple[float, float, float]
    heading: float
    field_of_view: float
    nearest: float
    reach: float
    is_infrared: bool

    @property
    def quaternion(self) -> tuple[float, float, float, float]:
        """Rotation x, y, z, w of its frame, whose x axis is the beam's."""
        if math.isnan(self.heading):
            return 0.0, math.sqrt(0.5), 0.0, math.sqrt(0.5)
        return 0.0, 0.0, math.sin(self.heading / 2), math.cos(self.heading / 2)


class InfraredLaw:
    """Law of the infrared sensors around a robot."""

    def __init__(self, model: RobotModel, measured: Calibration) -> None:
        law, body = measured.proximity, model.body
        self._gain, self._offset, self._threshold, noise, exponents = (
            np.array(values)
            for values in (
                law.gain_counts_mm2, law.offset_mm, law.threshold_counts, law.noise_counts, law.lobe_exponent,
            )
        )  # fmt: skip
        self._limit, self._saturates = law.limit_counts, law.saturates
        # A reading of one quantum less than the limit may be rounded from it.
        self._full = law.limit_counts - law.quantum_counts
        rest = np.where(self._threshold < 0, -self._threshold + _DEVIATIONS * noise, 0)
        self._dark = np.maximum(rest, max(_IDLE_MEANS * law.idle_counts, law.floor_counts))
        ends = self._invert(np.vstack([np.full(len(self._gain), float(self._full)), self._dark + 1]))
        views = map(view_of, exponents.tolist())
        headings = map(math.radians, measured.heading_deg)
        self.beams = [
            Beam(f"ps{k}", place, heading, view, nearest, reach, True)
            for k, (place, heading, view, (nearest, reach)) in enumerate(
                zip(body.sensor_places, headings, views, ends.T.tolist(), strict=False)
            )
        ]

    def distances(self, counts: Floats) -> Floats:
        """Return the distances of readings (n, n_sensors) [m]."""
        distances = self._invert(counts)
        distances[counts <= self._dark] = np.inf
        distances[counts > self._full] = -np.inf
        return distances

    def _invert(self, counts: Floats) -> Floats:
        if self._saturates:
            counts = np.minimum(counts, self._full)
            counts = counts / (1 - (np.maximum(counts, 0) / self._limit) ** 4) ** 0.25
        light = np.maximum(counts + self._threshold, 1e-9) / self._gain
        return np.maximum(1 / np.sqrt(light) - self._offset, 0) * 1e-3


class GroundLaw:
    """Law of the sensors that look at the floor: a light floor is there, or not.

    Args:
        model: Model of the robot.
        measured: Its calibration.
    """

    def __init__(self, model: RobotModel, measured: Calibration) -> None:
        ground, body = measured.ground, model.body
        self._middle = np.zeros(0)
        self.beams: list[Beam] = []
        if ground is not None:
            self._middle = (np.array(ground.white_counts) + ground.nothing_counts) / 2
            height = body.ground_height
            view = 2 * math.atan2(ground.spot_mm * 1e-3, height)
            for k, place in enumerate(body.sensor_places[len(body.sensor_positions) :]):
                self.beams.append(Beam(f"gs{k}", place, math.nan, view, height, height, True))

    def distances(self, counts: Floats) -> Floats:
        """Return minus infinity over a light floor, infinity over a dark one or none (n, n_sensors)."""
        return np.where(counts >= self._middle, -np.inf, np.inf)


class SonarLaw:
    """Law of the ultrasonic sensors."""

    def __init__(self, model: RobotModel) -> None:
        ring, self._unit = model.body.sonar, model.sonar_unit
        self.beams: list[Beam] = []
        if ring is None or not self._unit:
            return
        # A single code is that of no echo.
        self._codes = ring.codes if len(ring.codes) > 1 else (math.nan, *ring.codes)
        view = view_of(ring.exponent)
        self.beams = [
            Beam(f"us{k}", (x, y, z), heading, view, ring.nearest, ring.reach, False)
            for k, (x, y, z, heading) in enumerate(ring.places)
        ]

    def distances(self, readings: Floats) -> Floats:
        """Return the distances of readings (n, n_sensors) [m]; NaN for a disabled sensor."""
        distances = readings * self._unit
        # Codes that are equal mean no echo.
        for index, meaning in ((2, np.nan), (0, -np.inf), (1, np.inf)):
            if index < len(self._codes):
                distances[readings == self._codes[index]] = meaning
        return distances


def view_of(exponent: float) -> float:
    """Return the angle of a beam within which cos^exponent is at least a half [rad]."""
    return 2 * math.acos(0.5 ** (1 / exponent)) if exponent > 0 else math.pi
