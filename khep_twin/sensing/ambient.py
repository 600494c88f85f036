"""Ambient light: light of lamps at the receivers of a robot's infrared sensors.

    light = sum over lamps of gain P v [(1 - s) cos(theta)^n + s (1 + cos(theta)) / 2] / (r - offset)^2

in counts below the dark level, with lamp power P, distance r from the receiver to the bulb's centre, angle
theta off the receiver's axis in space, and visible part v of the bulb. The diffuse part s of the sensitivity
accepts light from all directions, as from a lamp overhead. A lamp behind a wall gives no light.

The law of the Khepera Toolbox for Matlab, which is also available, ignores shadows and heights:

    light = sum over lamps of gain P f(theta) / (r - offset)^2
    f = 1 up to min_angle, cos(theta 90 degrees / max_angle) up to max_angle, 0 beyond
"""

import math

import mujoco

from khep_twin.playpen import Lighting
from khep_twin.sensing.calibration import AmbientCalibration
from khep_twin.sensing.light import Bulb, HiddenSector, Light, LightLaw
from khep_twin.sensing.occlusion import SightLines
from khep_twin.sensing.robot_indices import RobotIndices
from khep_twin.sensing.robot_sensors import Ambient
from khep_twin.units import radians


def ambient_optics(calibration: AmbientCalibration) -> Ambient:
    """Return the parameters of a robot's receivers."""
    headings = [radians(heading_deg) for heading_deg in calibration.heading_deg]
    return Ambient(
        cosine=[math.cos(heading) for heading in headings],
        sine=[math.sin(heading) for heading in headings],
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
    """Lamps of a scene, with the precomputed lines of sight from a robot; the last result is cached."""

    def __init__(self, model: mujoco.MjModel, robot: RobotIndices) -> None:
        self._model = model
        self._robot = robot
        self._cached_light: tuple[list[tuple[float, float, float]], Lighting, Light] | None = None

    def light(self, positions: list[tuple[float, float, float]], lighting: Lighting) -> Light:
        """Return the light of lamps at these positions [m]."""
        if self._cached_light is None or self._cached_light[:2] != (positions, lighting):
            sight_lines = SightLines(self._model, self._robot, positions)
            self._cached_light = positions, lighting, build_light(sight_lines, lighting)
        return self._cached_light[2]


def build_light(sight_lines: SightLines, lighting: Lighting) -> Light:
    """Return lamps with the precomputed lines of sight to them."""
    bulbs: list[Bulb] = []
    sectors: list[HiddenSector] = []
    lamp_obstacles = sight_lines.obstacles or [[] for _ in sight_lines.lamps]
    for position, obstacles in zip(sight_lines.lamps, lamp_obstacles, strict=True):
        bulbs.append(Bulb(*position, len(sectors), len(sectors) + len(obstacles)))
        for middle, half_angle, distance in obstacles:
            half_cosine = math.cos(half_angle) if half_angle < math.pi else -2.0
            sectors.append(HiddenSector(math.cos(middle), math.sin(middle), half_cosine, distance))
    law = LightLaw(
        by_toolbox=lighting.law == "toolbox",
        min_angle_deg=lighting.min_angle_deg,
        max_angle_deg=lighting.max_angle_deg,
        is_static=sight_lines.is_static,
        flicker_ns=round(5e8 / lighting.mains_hz),
        flicker_phase=0.0,
    )
    return Light(law, bulbs, sectors)
