"""Lazy sensor readings: a moment is recorded at each measurement, and evaluated when a reading is requested.

The robot measures continuously, its programs and logs read seldom. A reading depends only on the recorded
moment, not on the time of its evaluation.
"""

from collections.abc import Sequence
from typing import NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray

from khep_twin.sensing.light import Light
from khep_twin.sensing.mujoco_scene import MujocoScene


class Moment(NamedTuple):
    """Configuration of a world at one time.

    Attributes:
        time_ns: Time [ns].
        qpos: Positions of all joints.
        light: Light of the lamps.
        powers: Powers of the lamps [W].
    """

    time_ns: int
    qpos: NDArray[np.float64]
    light: Light
    powers: Sequence[float]


class PastScene:
    """Copy of a scene that shows a recorded moment.

    Args:
        model: Model of the scene.

    Attributes:
        model: Model of the scene.
        data: State of the scene, of which only positions are set.
        mujoco_scene: Its interface to the infrared sensors.
    """

    def __init__(self, model: mujoco.MjModel) -> None:
        self.model = model
        self.data = mujoco.MjData(model)
        self.mujoco_scene = MujocoScene(model, self.data)
        self._qpos: NDArray[np.float64] | None = None

    def move_to(self, moment: Moment) -> None:
        """Set the scene to a moment."""
        if moment.qpos is not self._qpos:
            self.data.qpos[:] = moment.qpos
            self._qpos = moment.qpos
            mujoco.mj_kinematics(self.model, self.data)
            mujoco.mj_comPos(self.model, self.data)
            mujoco.mj_camlight(self.model, self.data)
