"""Planar twins at given poses, and the replies of a robot in the place of one."""

import functools
import math

import numpy as np
import pytest
from numpy.typing import NDArray

from khep_twin.episodes.episode_setup import EpisodeSetup
from khep_twin.episodes.planar import plane as plane_data
from khep_twin.playpen import Playpen
from khep_twin.shadow.particles import Particles
from khep_twin.shadow.planes import Twins
from khep_twin.shadow.start import Spread, draw_particles

Integers = NDArray[np.int64]
Pose = tuple[float, float, float]

CIRCLE = [
    plane_data.CENTRE_X,
    plane_data.CENTRE_Y,
    plane_data.HALF_LENGTH,
    plane_data.HALF_WIDTH,
    plane_data.TOP,
    plane_data.TOUCHABLE,
    plane_data.REFLECTANCE,
]
"""Columns of an obstacle that make it a round object."""

SECOND = 1_000_000_000
ALL = np.ones(8, np.bool_)
"""Sensors to rely on: all."""

AT_THE_CRATE = (80.0, 371.0, -45.0)
"""Pose in the workshop [mm, degrees] that faces the crate, far from the lamp."""

OPEN = (350.0, 250.0, 0.0)
"""Pose in the workshop with nothing near."""

EXACT = Spread(0, 0, 0, 0, 0, 0)
"""Spread of what is known exactly."""


@functools.cache
def setup_of(name: str, has_lamps: bool = True) -> EpisodeSetup:
    """A shipped playpen, prepared for the plane, with its lamps or without them, which is faster."""
    pytest.importorskip("numba", reason="numba is not installed")
    playpen = Playpen.load(name)
    return EpisodeSetup(playpen if has_lamps else playpen.model_copy(update={"lamps": ()}), planar=True)


def metric(pose: Pose) -> Pose:
    """A pose in mm and degrees, in metres and radians."""
    x_mm, y_mm, heading_deg = pose
    return x_mm / 1e3, y_mm / 1e3, math.radians(heading_deg)


def planes_at(*poses: Pose, name: str = "workshop", has_lamps: bool = True) -> Twins:
    """A twin at each pose."""
    planes = Twins(setup_of(name, has_lamps), len(poses))
    planes.reset_poses(np.array([metric(pose) for pose in poses]))
    return planes


def particles_at(*poses: Pose, name: str = "workshop") -> Particles:
    """A particle at each pose, with the calibration's wheels and gains, of equal weights."""
    particles = draw_particles(
        setup_of(name), [metric(poses[0])], EXACT, len(poses), np.random.default_rng(0)
    )
    particles.twins.reset_poses(np.array([metric(pose) for pose in poses]))
    return particles


def light_of(planes: Twins) -> NDArray[np.float64]:
    """The light at each sensor of each twin, as the calibration has them."""
    return planes.illuminate(np.zeros((len(planes), 8)))[0]


def readings(planes: Twins, gain: float = 1.0) -> Integers:
    """Return the first twin's reply to N without noise, for sensors with this gain."""
    proximity, ambient = planes.proximity, planes.ambient
    counts = gain * light_of(planes)[0] - proximity["threshold"]
    # A lamp leaves a sensor a part of its range.
    left = 1 - planes.lamplight(0.0)[0].sum(axis=1) / float(ambient["dark"] - ambient["floor"])
    return np.rint(np.clip(counts, 0, float(proximity["limit"]) * left.clip(0))).astype(np.int64)
