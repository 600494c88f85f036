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
from khep_twin.sensing.light import Bulb, Hidden, Light, LightLaw
from khep_twin.sensing.occlusion import SightLines
from khep_twin.sensing.robot_indices import RobotIndices
from khep_twin.sensing.robot_sensors import Ambient
from khep_twin.units import radians


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


class LightSource:
    """Lamps of a scene as numbers, with the known sight lines to them; the last ones are kept.

    Args:
        model: Model of the scene.
        robot: Indices of the robot whose receivers they shine on.
    """

    def __init__(self, model: mujoco.MjModel, robot: RobotIndices) -> None:
        self._model, self._robot = model, robot
        self._last: tuple[list[tuple[float, float, float]], Lighting, Light] | None = None

    def light(self, positions: list[tuple[float, float, float]], lighting: Lighting) -> Light:
        """Return lamps at these positions [m]."""
        if self._last is None or self._last[:2] != (positions, lighting):
            lines = SightLines(self._model, self._robot, positions)
            self._last = positions, lighting, light_of(lines, lighting)
        return self._last[2]


def light_of(lines: SightLines, lighting: Lighting) -> Light:
    """Return lamps as numbers, with the known sight lines to them."""
    bulbs: list[Bulb] = []
    hidden: list[Hidden] = []
    rows = lines.hidden or [[] for _ in lines.lamps]
    for lamp, directions in zip(lines.lamps, rows, strict=True):
        bulbs.append(Bulb(*lamp, len(hidden), len(hidden) + len(directions)))
        for middle, half, nearest in directions:
            edge = math.cos(half) if half < math.pi else -2.0
            hidden.append(Hidden(math.cos(middle), math.sin(middle), edge, nearest))
    law = LightLaw(
        lighting.law == "toolbox",
        lighting.min_angle_deg,
        lighting.max_angle_deg,
        lines.known,
        round(5e8 / lighting.mains_hz),
        0.0,
    )
    return Light(law, bulbs, hidden)
