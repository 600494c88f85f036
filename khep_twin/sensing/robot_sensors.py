"""Numbers of a robot's sensors as the stepping core reads them; `sensors` and `ambient` fill them."""

import math
from collections.abc import Sequence
from typing import NamedTuple

from khep_twin.compilable import compilable
from khep_twin.sensing.reflection import Lobe
from khep_twin.sensing.seen_surfaces import Chip


class Proximity(NamedTuple):
    """Reflected light; per-sensor numbers in the order of N.

    Attributes:
        gain: Counts per light (8,) [counts m^2].
        bound: Highest counts of anything at a distance of 1 m (8,) [counts m^2].
        threshold: Counts that are subtracted (8,) [counts].
        offset: Offset of the chip behind the sensor's face (8,) [m].
        reach: Range (8,) [m].
        whole: Whole part of each lobe's exponent (8,).
        part: The rest of it (8,).
        norm: Norm of each lobe (8,).
        width: Width of each lobe, over its norm (8,).
        table: Cumulated light of faces, as of `lobes.table` (8, N_CELLS + 1, 4).
        limit: Highest reading [counts].
        floor: Lowest reading [counts].
        quantum: Step between readings [counts].
        noise: Standard deviation of one reading (8,) [counts].
        idle: Mean of the noise with nothing in reach [counts].
        found: Buffer for the surfaces that a sensor sees (N_SURFACES * N_COLUMNS,).
    """

    gain: Sequence[float]
    bound: Sequence[float]
    threshold: Sequence[float]
    offset: Sequence[float]
    reach: Sequence[float]
    whole: Sequence[int]
    part: Sequence[float]
    norm: Sequence[float]
    width: Sequence[float]
    table: Sequence[Sequence[Sequence[float]]]
    limit: int
    floor: int
    quantum: int
    noise: Sequence[float]
    idle: float
    found: list[float]


class Ambient(NamedTuple):
    """Light of lamps; per-sensor numbers in the order of O.

    Attributes:
        ahead: Cosine of each receiver's heading (8,).
        left: Sine of each receiver's heading (8,).
        gain_mm2: Counts per light of a lamp (8,) [counts mm^2/W].
        lobe_exponent: Exponent of the cosine off the receiver's axis (8,).
        diffuse: Diffuse part of the sensitivity.
        offset_mm: Offset in the light's inverse square law [mm].
        dark: Reading in the dark [counts].
        floor: Reading in the brightest light [counts].
        ceiling: Highest reading [counts].
        noise: Standard deviation of one reading [counts].
    """

    ahead: Sequence[float]
    left: Sequence[float]
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
        base: Body of the robot, which its own rays ignore.
        cameras: Cameras of the sensors (8,).
        proximity: Numbers of proximity.
        ambient: Numbers of ambient light.
    """

    base: int
    cameras: Sequence[int]
    proximity: Proximity
    ambient: Ambient


@compilable
def chip_behind(place: Sequence[float], frame: Sequence[float], proximity: Proximity, channel: int) -> Chip:
    """Return a sensor's chip, behind its face.

    Args:
        place: Position of the sensor (3,) [m].
        frame: Orientation of the sensor (9,), which looks against its third axis.
        proximity: Numbers of proximity.
        channel: Number of the sensor.
    """
    # The robot stands upright; what little it tilts does not count.
    ahead, left, offset = -frame[2], -frame[5], proximity.offset[channel]
    scale = 1 / math.sqrt(max(ahead * ahead + left * left, 1e-12))
    ahead, left = ahead * scale, left * scale
    x, y = place[0] - offset * ahead, place[1] - offset * left
    return Chip(x, y, ahead, left, place[2], proximity.reach[channel])


@compilable
def lobe_of(proximity: Proximity, channel: int) -> Lobe:
    """Return the lobe of a sensor."""
    return Lobe(
        proximity.whole[channel],
        proximity.part[channel],
        proximity.norm[channel],
        proximity.width[channel],
        proximity.table[channel],
    )
