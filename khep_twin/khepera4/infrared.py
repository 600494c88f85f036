"""Infrared sensors of the Khepera IV: eight around, by the law of `sensing.optics`, and four for the floor.

A sensor that looks at the floor sees a spot of it:

    counts = nothing + (white - nothing) mean(reflectance over the spot) min((h0 + l) / (h + l), 1)^2 + noise

with its height h above what is below, h0 = 4.7 mm on the floor, and l = 2 mm (assumed). The reflectance is
that of the floor, a patch, or whatever a ray from the sensor meets; of nothing, beyond an edge, it is 0.
"""

import math
from collections.abc import Sequence

import mujoco
import numpy as np

from khep_twin.khepera4.moments import Moment, PastScene
from khep_twin.sensing.ambient import ambient_optics
from khep_twin.sensing.calibration import Calibration, GroundCalibration
from khep_twin.sensing.noise import TABLES, draws
from khep_twin.sensing.optics import convert
from khep_twin.sensing.robot_indices import RobotIndices
from khep_twin.sensing.robot_sensors import RobotSensors
from khep_twin.sensors import proximity_optics
from khep_twin.units import COUNTS_LIMIT, N_SENSORS

N_AROUND = N_SENSORS
"""Number of sensors around; those behind them look at the floor."""

PERIOD_NS = 5_000_000
"""Period of the measurements [ns] (manual)."""

_HEIGHT, _LENS = 0.0047, 0.002
"""Height of the sensors above the floor (manual), and length in the law of their distance (assumed) [m]."""

_TURNS = np.arange(8) * (math.pi / 4)
_SPOT = np.vstack([[0.0, 0.0], 0.7 * np.column_stack([np.cos(_TURNS), np.sin(_TURNS)])])
"""Points of a spot of radius 1 that stand for it."""


class Infrared:
    """The twelve sensors of one robot.

    Args:
        past: Scene that they measure.
        indices: Indices of the robot.
        calibration: Calibration of the robot, with its sensors for the floor.
        key: Words of the key of its random draws.
        is_noisy: Whether they have noise.
    """

    def __init__(
        self,
        past: PastScene,
        indices: RobotIndices,
        calibration: Calibration,
        key: Sequence[int],
        is_noisy: bool,
    ) -> None:
        self._past, self._indices, self._key, self._tables = past, indices, [*key], TABLES[is_noisy]
        self._sensors = RobotSensors(
            indices.base,
            list(indices.cameras),
            proximity_optics(past.model, indices, calibration),
            ambient_optics(calibration.ambient),
        )
        self._rises, self._ground = calibration.ambient.rises_with_light, calibration.ground

    def measure(self, moment: Moment) -> tuple[list[int], list[int]]:
        """Return proximity and ambient counts of all sensors at a moment (12,)."""
        past, sensors = self._past, self._sensors
        past.move_to(moment)
        first = moment.time_ns // PERIOD_NS * len(self._indices.cameras)
        near: list[int] = []
        light: list[int] = []
        for channel in range(N_AROUND):
            random = draws(self._tables, self._key, first + channel)
            reflected, ambient = convert(
                past.scene, sensors, moment.light, moment.powers, moment.time_ns, channel, random
            )
            near.append(reflected)
            light.append(ambient)
        for channel, camera in enumerate(self._indices.cameras[N_AROUND:]):
            random = draws(self._tables, self._key, first + N_AROUND + channel)
            if self._ground is not None:
                near.append(self._floor_counts(self._ground, channel, camera, random[0]))
            # In the robot's shade (assumed).
            dark = sensors.ambient.dark + sensors.ambient.noise * random[1]
            light.append(min(max(round(dark), 0), COUNTS_LIMIT))
        return near, [COUNTS_LIMIT - each for each in light] if self._rises else light

    def _floor_counts(self, ground: GroundCalibration, channel: int, camera: int, random: float) -> int:
        """Return the counts of a sensor that looks at the floor."""
        model, data = self._past.model, self._past.data
        place, frame = data.cam_xpos[camera], data.cam_xmat[camera]
        right, up, down = frame[0::3], frame[1::3], -frame[2::3]
        met, total = np.zeros(1, np.int32), 0.0
        for x, y in (ground.spot_mm * 1e-3 * _SPOT).tolist():
            away = mujoco.mj_ray(
                model, data, place + x * right + y * up, down, None, True, self._indices.base, met
            )
            if away >= 0:
                total += model.geom_user[met[0], 0] * min((_HEIGHT + _LENS) / (away + _LENS), 1.0) ** 2
        white, dark = ground.white_counts[channel], ground.nothing_counts
        counts = dark + (white - dark) * total / len(_SPOT) + ground.noise_counts * random
        return min(max(round(counts), 0), COUNTS_LIMIT)
