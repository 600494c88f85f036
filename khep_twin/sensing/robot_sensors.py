"""Parameters of a robot's sensors for the stepping core, computed by `sensors` and `ambient`."""

import math
from collections.abc import Sequence
from typing import NamedTuple

from khep_twin.compilable import compilable
from khep_twin.sensing.reflection import Lobe
from khep_twin.sensing.seen_surfaces import Chip


class Proximity(NamedTuple):
    """Reflected light; parameters of each sensor around the robot, in the order of its cameras.

    Attributes:
        gain: Counts per light (n_sensors,) [counts m^2].
        bound: Upper bound of the counts of any object at 1 m (n_sensors,) [counts m^2].
        threshold: Subtracted counts (n_sensors,) [counts].
        offset: Offset of the chip behind the sensor's face (n_sensors,) [m].
        reach: Range (n_sensors,) [m].
        exponent: Integer part of each lobe's exponent (n_sensors,).
        fraction: Fractional part of it (n_sensors,).
        norm: Norm of each lobe (n_sensors,).
        width: Width of each lobe, over its norm (n_sensors,).
        table: Cumulative light of faces, from `lobes.table` (n_sensors, N_CELLS + 1, 4).
        limit: Highest reading [counts].
        floor: Lowest reading [counts].
        quantum: Step between readings [counts].
        noise: Standard deviation of one reading (n_sensors,) [counts].
        noise_growth: Relative growth of the noise with the light [1/counts].
        idle: Mean of the noise with nothing in range [counts].
        saturates: 1 if readings approach the limit gradually.
        floor_light: Part of minus the threshold from a white floor, 0 if all are white (n_sensors,) [counts].
        narrowing: Factors cos^2 of the elevation beside cos^3.
        mirror: Weight of the mirror images in a white floor.
        surfaces: Buffer for the surfaces that a sensor sees (N_SURFACES * N_COLUMNS,).
    """

    gain: Sequence[float]
    bound: Sequence[float]
    threshold: Sequence[float]
    offset: Sequence[float]
    reach: Sequence[float]
    exponent: Sequence[int]
    fraction: Sequence[float]
    norm: Sequence[float]
    width: Sequence[float]
    table: Sequence[Sequence[Sequence[float]]]
    limit: int
    floor: int
    quantum: int
    noise: Sequence[float]
    noise_growth: float
    idle: float
    saturates: int
    floor_light: Sequence[float]
    narrowing: int
    mirror: float
    surfaces: list[float]


class Ambient(NamedTuple):
    """Light of lamps; parameters of each sensor around the robot, in the order of its cameras.

    Attributes:
        cosine: Cosine of each receiver's heading (n_sensors,).
        sine: Sine of each receiver's heading (n_sensors,).
        gain_mm2: Counts per light of a lamp (n_sensors,) [counts mm^2/W].
        lobe_exponent: Exponent of the cosine off the receiver's axis (n_sensors,).
        diffuse: Diffuse part of the sensitivity.
        offset_mm: Offset in the light's inverse square law [mm].
        dark: Reading in the dark [counts].
        floor: Reading in the brightest light [counts].
        ceiling: Highest reading [counts].
        noise: Standard deviation of one reading [counts].
    """

    cosine: Sequence[float]
    sine: Sequence[float]
    gain_mm2: Sequence[float]
    lobe_exponent: Sequence[float]
    diffuse: float
    offset_mm: float
    dark: float
    floor: float
    ceiling: int
    noise: float


class RobotSensors(NamedTuple):
    """Sensors of one robot.

    Attributes:
        base: Body of the robot, which its rays ignore.
        cameras: Cameras of the sensors (n_cameras,), those that look at the floor last.
        proximity: Parameters of proximity.
        ambient: Parameters of ambient light.
    """

    base: int
    cameras: Sequence[int]
    proximity: Proximity
    ambient: Ambient


@compilable
def chip_behind(
    position: Sequence[float], frame: Sequence[float], proximity: Proximity, channel: int
) -> Chip:
    """Return a sensor's chip, behind its face.

    Args:
        position: Position of the sensor (3,) [m].
        frame: Rotation matrix of the sensor (9,), which looks along its -z axis.
        proximity: Parameters of proximity.
        channel: Number of the sensor.
    """
    # The robot is upright; its small tilt is ignored.
    dx, dy, offset = -frame[2], -frame[5], proximity.offset[channel]
    scale = 1 / math.sqrt(max(dx * dx + dy * dy, 1e-12))
    dx, dy = dx * scale, dy * scale
    x, y = position[0] - offset * dx, position[1] - offset * dy
    return Chip(x, y, dx, dy, position[2], proximity.reach[channel])


@compilable
def sensor_lobe(proximity: Proximity, channel: int, floor: float = 1.0) -> Lobe:
    """Return the lobe of a sensor above a floor with a reflectance."""
    return Lobe(
        proximity.exponent[channel],
        proximity.fraction[channel],
        proximity.norm[channel],
        proximity.width[channel],
        proximity.table[channel],
        proximity.narrowing,
        proximity.mirror * floor,
    )
