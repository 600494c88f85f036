"""Particles at the start: at a known pose with an uncertainty, or anywhere."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from khep_twin import units
from khep_twin.episodes.episode_setup import EpisodeSetup
from khep_twin.errors import PlaypenError
from khep_twin.playpen.starts import defined_starts
from khep_twin.sensing import calibration
from khep_twin.shadow.particles import Floats, Particles, Prior
from khep_twin.shadow.planes import Booleans, Twins

Pose = tuple[float, float, float]

HEADING_DEVIATION = math.radians(calibration.HEADING_SPREAD_DEG)
"""Standard deviation of a sensor's heading from the calibration's [rad]."""


class Spread(NamedTuple):
    """Uncertainty of a robot at the start: standard deviations.

    Attributes:
        place: Of x and y [m]; infinite for an unknown start.
        heading: Of the heading [rad].
        radius: Of the wheels' mean radius, relative.
        ratio: Of the right wheel's radius over the left one's.
        base: Of the wheel base, relative.
        gain: Of the logarithm of the sensors' common gain.
    """

    place: float = 0.01
    heading: float = math.radians(5)
    radius: float = calibration.RADIUS_SPREAD
    ratio: float = calibration.INEQUALITY_SPREAD
    base: float = calibration.BASE_SPREAD
    gain: float = calibration.COMMON_GAIN_SPREAD


PUBLISHED = Spread()
"""Spread of robots of the same model, placed by hand within 10 mm and 5 degrees."""

_MAX_TRIES = 200
"""Tries to find room for every particle."""


def known_starts(setup: EpisodeSetup) -> list[Pose]:
    """Return the poses x, y [m], heading [rad] at which a robot may start: its start, or each spot."""
    return [
        (units.metres(x_mm), units.metres(y_mm), units.radians(heading_deg))
        for x_mm, y_mm, heading_deg in defined_starts(setup.playpen, 0)
    ]


def draw_particles(
    setup: EpisodeSetup, starts: Sequence[Pose] | None, spread: Spread, count: int, rng: np.random.Generator
) -> Particles:
    """Return random particles.

    Args:
        setup: Playpen with the robot, prepared for the plane.
        starts: Equally probable starts x, y [m] and heading [rad]; None for anywhere.
        spread: Standard deviations of each start and of the robot's values.
        count: Number of particles.
        rng: Random stream.
    """
    twins = Twins(setup, count)
    if starts is None:
        twins.reset_poses(draw_anywhere(setup, twins, rng))
    else:
        deviations = spread.place, spread.place, spread.heading
        poses = np.array(starts)[np.arange(count) * len(starts) // count]
        twins.reset_poses(poses + rng.standard_normal((count, 3)) * deviations)
    wheels = 1 + rng.standard_normal((count, 3)) * (spread.radius, spread.ratio, spread.base)
    twins.set_wheels(*wheels.T)
    traits = np.zeros((count, twins.n_sensors, 3))
    traits[:, :, 0] = rng.standard_normal((count, 1)) * spread.gain
    thresholds = setup.calibration.proximity.threshold_spread * twins.proximity["threshold"]
    prior = np.zeros((twins.n_sensors, 3, 3))
    prior[:, 0, 0], prior[:, 1, 1] = calibration.GAIN_SPREAD**2, HEADING_DEVIATION**2
    prior[:, 2, 2] = thresholds**2
    return Particles(
        twins,
        Prior(np.array([spread.radius, spread.ratio, spread.base]), spread.gain, prior),
        np.full(count, -math.log(count)),
        wheels,
        traits,
        np.repeat(prior[None], count, axis=0),
        np.full((count, 2), np.nan),
        np.zeros(count, np.int64),
        np.zeros(count, np.int64),
    )


def draw_anywhere(setup: EpisodeSetup, twins: Twins, rng: np.random.Generator) -> Floats:
    """Return a random pose with room for each twin: x, y [m] and heading [rad] (n, 3)."""
    corners = np.array(setup.playpen.arena.corners) * 1e-3
    low, high = corners.min(axis=0), corners.max(axis=0)
    poses = np.zeros((len(twins), 3))
    is_missing = np.ones(len(twins), np.bool_)
    for _ in range(_MAX_TRIES):
        candidates = rng.uniform((*low, 0), (*high, math.tau), poses.shape)
        poses[is_missing] = candidates[is_missing]
        is_missing = ~(twins.are_clear(poses) & are_inside(corners, poses))
        if not is_missing.any():
            return poses
    raise PlaypenError(f"{setup.playpen.name}: no room for the robot was found; expected a start pose")


def are_inside(corners: Floats, poses: Floats) -> Booleans:
    """Return whether positions are inside a polygon (n,)."""
    is_inside = np.zeros(len(poses), np.bool_)
    x, y = poses[:, 0], poses[:, 1]
    for (x0, y0), (x1, y1) in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        if y0 == y1:
            continue
        is_inside ^= ((y0 > y) != (y1 > y)) & (x < (x1 - x0) * (y - y0) / (y1 - y0) + x0)
    return is_inside
