"""World whose sensors read a real robot's sampled tables.

A robot without inertia moves by the speeds of its wheels, and each sensor reads the table at the object's
distance and bearing, as in the simulators for which these tables were recorded.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Self

import numpy as np
from scipy.signal import savgol_coeffs, savgol_filter

from khep_twin import units
from khep_twin.randomness import stream
from khep_twin.units import BODY_RADIUS, COUNTS_LIMIT, N_SENSORS
from studies.one_object import PERIOD_S, Floats, Readings, Target

DARK_COUNTS = 485.0
"""Ambient counts in the dark (inferred from the table of the lamp)."""

_BEARINGS, _DISTANCES, _ORDER = 7, 5, 2
"""Samples and order of the local polynomials that smooth a table."""

_NOISE_CELLS = 5
"""Farthest cell along the bearing from which a draw of the noise comes [cells of 2 degrees]."""


@dataclass(frozen=True, slots=True)
class Kinematics:
    """Motion by the speeds of the wheels.

    Attributes:
        speed: Speed of a wheel per pulse/10 ms [m/s].
        base: Distance of the wheels [m].
    """

    speed: float = units.speed(1)
    base: float = units.WHEEL_BASE

    @classmethod
    def of_table(cls, rows: Floats) -> Self:
        """Fit a table of left and right speed, turn [deg] and way [cm] in 100 ms (n, 4)."""
        way = np.linalg.lstsq((rows[:, :1] + rows[:, 1:2]) / 2, rows[:, 3] / 10, rcond=None)[0][0]
        turn = np.linalg.lstsq(rows[:, :1] - rows[:, 1:2], np.radians(rows[:, 2]) * 10, rcond=None)[0][0]
        return cls(float(way), float(way / abs(turn)))

    def move(self, poses: Floats, speeds: Floats, seconds: float) -> Floats:
        """Return the poses after arcs with wheel speeds (n, 2) [pulses/10 ms]."""
        left, right = speeds.T * self.speed
        turn, way = (right - left) / self.base * seconds, (left + right) / 2 * seconds
        middle = poses[:, 2] + turn / 2
        chord = way * np.sinc(turn / (2 * math.pi))
        return poses + np.column_stack([chord * np.cos(middle), chord * np.sin(middle), turn])


class Samples:
    """Table of readings over distance and bearing of an object, smoothed, and its noise.

    Between the samples it is linear. A local polynomial removes most of the noise, the ripple of the scan
    included; the residuals, scaled to the noise before the fit, are drawn again from the cells nearby.

    Args:
        distances: Distances of the samples (n,) [m].
        bearings: Bearings of the object, ccw from ahead (n,) [rad]: the same ones at each distance.
        counts: Readings (n, 8) [counts].
        widths: Samples of the polynomial along distance and bearing; 1 leaves an axis unchanged.
    """

    def __init__(
        self,
        distances: Floats,
        bearings: Floats,
        counts: Floats,
        widths: tuple[int, int] = (_DISTANCES, _BEARINGS),
    ) -> None:
        turns = np.mod(np.round(bearings, 9), 2 * math.pi)
        order = np.lexsort((turns, distances))
        self.distances = np.unique(distances)
        shape = len(self.distances), len(distances) // len(self.distances)
        self._first, self._step = turns[order][0], 2 * math.pi / shape[1]
        self.raw = counts[order].reshape(*shape, N_SENSORS)
        smooth: Floats = self.raw
        centre = 1.0
        for axis, (width, mode) in enumerate(zip(widths, ("interp", "wrap"), strict=True)):
            if width > 1:
                smooth = np.asarray(savgol_filter(smooth, width, _ORDER, axis=axis, mode=mode), np.float64)
                centre *= float(savgol_coeffs(width, _ORDER)[width // 2])
        self.smooth: Floats = np.clip(smooth, self.raw.min(), self.raw.max())
        self.noise = (self.raw - self.smooth) / math.sqrt(1 - centre if centre < 1 else 1)
        self._far_readings = np.median(self.smooth[-1], axis=0)

    def read(self, distances: Floats, bearings: Floats, rng: np.random.Generator | None = None) -> Floats:
        """Return the readings at places (n, 8), with noise if a generator is given.

        One step beyond the last distance all sensors read the median of that distance.
        """
        row = np.interp(distances, self.distances, np.arange(len(self.distances)))
        column = np.mod(bearings - self._first, 2 * math.pi) / self._step
        low, left = np.floor(row).astype(int), np.floor(column).astype(int)
        high, part = np.minimum(low + 1, len(self.distances) - 1), (row - low)[:, None]
        n, share = self.smooth.shape[1], (column - left)[:, None]
        left, right = left % n, (left + 1) % n
        ends = [(1 - share) * self.smooth[at, left] + share * self.smooth[at, right] for at in (low, high)]
        last = self.distances[-1]
        fade = np.clip((distances - last) / (last - self.distances[-2]), 0, 1)[:, None]
        counts = (1 - fade) * ((1 - part) * ends[0] + part * ends[1]) + fade * self._far_readings
        if rng is None:
            return counts
        cells = left[:, None] + rng.integers(-_NOISE_CELLS, _NOISE_CELLS + 1, counts.shape)
        near = np.where(part[:, 0] < 0.5, low, high)[:, None]
        counts += self.noise[near, cells % n, np.arange(N_SENSORS)]
        return np.clip(counts, self.raw.min(), self.raw.max())

    def nearest(self, distances: Floats, bearings: Floats) -> Floats:
        """Return the nearest samples as they were taken (n, 8), as evorobot's simulator does."""
        rows = np.append(self.distances, 2 * self.distances[-1] - self.distances[-2])
        row = np.abs(rows[:, None] - distances).argmin(axis=0)
        column = np.round((bearings - self._first) / self._step).astype(int) % self.raw.shape[1]
        is_beyond = row == len(self.distances)
        return np.where(is_beyond[:, None], self._far_readings, self.raw[np.where(is_beyond, 0, row), column])


def along_axes(target: Target, curve: Callable[[Floats], Floats]) -> Readings:
    """Return readings by a curve over the distance along each sensor's axis, as in simple simulators."""
    places, headings = np.array(units.SENSOR_POSITIONS), np.array(units.SENSOR_HEADINGS)

    def read(distances: Floats, bearings: Floats) -> Floats:
        towards = np.stack([np.cos(bearings), np.sin(bearings)], axis=-1)
        away = (distances + BODY_RADIUS + target.radius)[:, None]
        offset = towards @ places.T
        cosine = np.cos(bearings[:, None] - headings)
        if target.radius:
            centres = towards[:, None] * away[..., None] - places
            along = centres[..., 0] * np.cos(headings) + centres[..., 1] * np.sin(headings)
            within = target.radius**2 - (centres**2).sum(axis=-1) + along**2
            lengths = along - np.sqrt(np.maximum(within, 0))
            hits = (within > 0) & (along > 0)
        else:
            hits = cosine > 1e-9
            lengths = (away - offset) / np.where(hits, cosine, 1)
        return np.where(hits, np.clip(curve(np.maximum(lengths, 0)), 0, COUNTS_LIMIT), 0.0)

    return one_sense(target, read)


class SampledWorld:
    """World whose sensors read a table, or a curve.

    Args:
        target: Object near the robots.
        readings: Readings by distance and bearing.
        kinematics: Motion.
    """

    def __init__(self, target: Target, readings: Readings, kinematics: Kinematics) -> None:
        self._target, self._readings, self._kinematics = target, readings, kinematics

    def begin(self, starts: Floats) -> None:
        """Place the robots at poses."""
        self.poses = starts.copy()

    def read(self) -> tuple[Floats, Floats]:
        """Return the counts, rounded as a converter does."""
        proximity, ambient = self._readings(*self._target.place(self.poses))
        return np.round(proximity), np.round(ambient)

    def drive(self, speeds: Floats) -> None:
        """Drive for a period; a solid object pushes a robot back along its normal."""
        self.poses = self._kinematics.move(self.poses, speeds, PERIOD_S)
        distances, bearings = self._target.place(self.poses)
        if self._target.solid:
            deep, away = np.minimum(distances, 0), bearings + self.poses[:, 2]
            self.poses[:, :2] += deep[:, None] * np.column_stack([np.cos(away), np.sin(away)])


def table_readings(target: Target, samples: Samples, seed: int | None = None) -> Readings:
    """Return a table's readings, with its noise drawn by a seed or without."""
    rng = None if seed is None else stream(seed, "sampled world", target.name)
    return one_sense(target, lambda distances, bearings: samples.read(distances, bearings, rng))


def one_sense(target: Target, read: Callable[[Floats, Floats], Floats]) -> Readings:
    """Return readings of a lamp's light or of an object's proximity; the other sensors read nothing."""

    def read_both(distances: Floats, bearings: Floats) -> tuple[Floats, Floats]:
        counts = read(distances, bearings)
        return (
            (counts, np.full_like(counts, DARK_COUNTS)) if target.solid else (np.zeros_like(counts), counts)
        )

    return read_both
