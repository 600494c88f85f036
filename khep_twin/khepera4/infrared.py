"""Infrared sensors of the Khepera IV: eight around, by the law of `sensing.optics`, and four for the floor.

A ground sensor averages over a spot of the floor:

    counts = nothing + (white - nothing) mean(reflectance over the spot) min((h0 + l) / (h + l), 1)^2 + noise

with its height h above the surface, h0 = 4.7 mm on the floor, and l = 2 mm (assumed). The reflectance is that
of the floor, patch or object that a ray from the sensor meets; it is 0 beyond an edge.
"""

import math
from collections.abc import Sequence

import mujoco
import numpy as np

from khep_twin.khepera4.moments import Moment, PastScene
from khep_twin.sensing.ambient import ambient_optics
from khep_twin.sensing.calibration import Calibration, GroundCalibration
from khep_twin.sensing.noise import draws, plain_tables
from khep_twin.sensing.optics import convert
from khep_twin.sensing.robot_indices import RobotIndices
from khep_twin.sensing.robot_sensors import RobotSensors
from khep_twin.sensors import proximity_optics
from khep_twin.units import COUNTS_LIMIT, N_SENSORS

N_AROUND = N_SENSORS
"""Number of sensors around the robot; the others look at the floor."""

PERIOD_NS = 5_000_000
"""Period of the measurements [ns] (manual)."""

_HEIGHT, _LENS = 0.0047, 0.002
"""Height of the sensors above the floor (manual), and length in the law of their distance (assumed) [m]."""

_ANGLES = np.arange(8) * (math.pi / 4)
_SPOT_POINTS = np.vstack([[0.0, 0.0], 0.7 * np.column_stack([np.cos(_ANGLES), np.sin(_ANGLES)])])
"""Sample points of a spot of radius 1."""


class Infrared:
    """The twelve sensors of one robot.

    Args:
        scene: Scene that they measure.
        indices: Indices of the robot.
        calibration: Calibration of the robot, with its sensors for the floor.
        key: Words of the key of the robot's random draws.
        noise: Scale of the readings' noise, 0 for none.
    """

    def __init__(
        self,
        scene: PastScene,
        indices: RobotIndices,
        calibration: Calibration,
        key: Sequence[int],
        noise: float,
    ) -> None:
        self._scene = scene
        self._indices = indices
        self._key = [*key]
        self._tables = plain_tables(noise)
        self._sensors = RobotSensors(
            indices.base,
            list(indices.cameras),
            proximity_optics(scene.model, indices, calibration),
            ambient_optics(calibration.ambient),
        )
        self._rises_with_light = calibration.ambient.rises_with_light
        self._ground = calibration.ground

    def measure(self, moment: Moment) -> tuple[list[int], list[int]]:
        """Return proximity and ambient counts of all sensors at a moment (12,)."""
        scene, sensors = self._scene, self._sensors
        scene.move_to(moment)
        first_draw = moment.time_ns // PERIOD_NS * len(self._indices.cameras)
        proximity_counts: list[int] = []
        ambient_counts: list[int] = []
        for channel in range(N_AROUND):
            noise_draws = draws(self._tables, self._key, first_draw + channel)
            reflected, ambient = convert(
                scene.mujoco_scene, sensors, moment.light, moment.powers, moment.time_ns, channel, noise_draws
            )
            proximity_counts.append(reflected)
            ambient_counts.append(ambient)
        for channel, camera in enumerate(self._indices.cameras[N_AROUND:]):
            noise_draws = draws(self._tables, self._key, first_draw + N_AROUND + channel)
            if self._ground is not None:
                proximity_counts.append(self._floor_counts(self._ground, channel, camera, noise_draws[0]))
            # In the shadow of the robot (assumed).
            dark_reading = sensors.ambient.dark + sensors.ambient.noise * noise_draws[1]
            ambient_counts.append(min(max(round(dark_reading), 0), COUNTS_LIMIT))
        if self._rises_with_light:
            ambient_counts = [COUNTS_LIMIT - count for count in ambient_counts]
        return proximity_counts, ambient_counts

    def _floor_counts(self, ground: GroundCalibration, channel: int, camera: int, noise_draw: float) -> int:
        """Return the counts of a sensor that looks at the floor."""
        model, data = self._scene.model, self._scene.data
        position, rotation = data.cam_xpos[camera], data.cam_xmat[camera]
        right, up, down = rotation[0::3], rotation[1::3], -rotation[2::3]
        geom, total = np.zeros(1, np.int32), 0.0
        for x, y in (ground.spot_mm * 1e-3 * _SPOT_POINTS).tolist():
            distance = mujoco.mj_ray(
                model, data, position + x * right + y * up, down, None, True, self._indices.base, geom
            )
            if distance >= 0:
                total += model.geom_user[geom[0], 0] * min((_HEIGHT + _LENS) / (distance + _LENS), 1.0) ** 2
        white, dark = ground.white_counts[channel], ground.nothing_counts
        counts = dark + (white - dark) * total / len(_SPOT_POINTS) + ground.noise_counts * noise_draw
        return min(max(round(counts), 0), COUNTS_LIMIT)
