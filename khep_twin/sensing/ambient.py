"""Ambient light: light of lamps at the receivers of a robot's infrared sensors.

    light = sum over lamps of gain P v [(1 - s) cos(theta)^n + s (1 + cos(theta)) / 2] / (r - offset)^2

in counts below the dark level, with lamp power P, distance r from the receiver to the bulb's centre, theta
off the receiver's axis in space, and v the part of the bulb that is in sight. The diffuse part s comes in
from other directions, as from a lamp overhead. A lamp behind a wall gives nothing.

The toolbox's law, for comparison, has no shadows and no height:

    light = sum over lamps of gain P f(theta) / (r - offset)^2
    f = 1 up to min_angle, cos(theta 90 degrees / max_angle) up to max_angle, 0 beyond
"""

import math

import mujoco

from khep_twin.playpen import Lighting
from khep_twin.sensing.calibration import AmbientCalibration
from khep_twin.sensing.lamps import Lamps
from khep_twin.sensing.occlusion import SightLines
from khep_twin.sensing.optics import Ambient, Bulbs
from khep_twin.sensing.robot_indices import RobotIndices
from khep_twin.units import radians


class Receivers:
    """The eight receivers of one robot in a compiled scene.

    Args:
        model: Model of the scene.
        robot: Indices of the robot.
        calibration: Calibration of this robot's receivers.
        lamps: Lamps of the world.
        lighting: Law of the lamps' light.

    Attributes:
        lamps: Lamps of the world.
        optics: Numbers of the receivers.
        bulbs: Numbers of the lamps' positions.
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        robot: RobotIndices,
        calibration: AmbientCalibration,
        lamps: Lamps,
        lighting: Lighting,
    ) -> None:
        self._model, self._robot = model, robot
        self.optics = ambient_optics(calibration)
        self.relight(lamps, lighting)

    def relight(self, lamps: Lamps, lighting: Lighting) -> None:
        """Replace the lamps and the law."""
        self.lamps = lamps
        self.bulbs = bulbs(SightLines(self._model, self._robot, lamps.positions), lighting)


def ambient_optics(calibration: AmbientCalibration) -> Ambient:
    """Return a robot's receivers as numbers."""
    headings = [radians(heading_deg) for heading_deg in calibration.heading_deg]
    return Ambient(
        ahead=[math.cos(heading) for heading in headings],
        left=[math.sin(heading) for heading in headings],
        gain_mm2=list(calibration.gain_counts_mm2_per_w),
        lobe_exponent=list(calibration.lobe_exponent),
        diffuse=calibration.diffuse,
        offset_mm=calibration.offset_mm,
        dark=calibration.dark_counts,
        floor=calibration.floor_counts,
        ceiling=calibration.ceiling_counts,
        noise=calibration.noise_counts,
    )


def bulbs(lines: SightLines, lighting: Lighting) -> Bulbs:
    """Return lamps as numbers, with the known sight lines to them."""
    first, rows = [0], list[tuple[float, float, float]]()
    for hidden in lines.hidden:
        rows += hidden
        first.append(len(rows))
    return Bulbs(
        positions=[part for position in lines.lamps for part in position],
        by_toolbox=lighting.law == "toolbox",
        min_angle_deg=lighting.min_angle_deg,
        max_angle_deg=lighting.max_angle_deg,
        known=lines.known,
        first=first,
        middles=[part for row in rows for part in (math.cos(row[0]), math.sin(row[0]))],
        edges=[math.cos(row[1]) if row[1] < math.pi else -2.0 for row in rows],
        nearest=[row[2] for row in rows],
    )
