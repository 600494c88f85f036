"""Moments of a world that sensors measured at, computed when a program or a log asks for what they read.

The robot measures all the time, its programs read now and then. A reading follows from the moment of its
measurement alone, so it does not matter when it is computed, or whether at all.
"""

from collections.abc import Sequence
from typing import NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray

from khep_twin.sensing.light import Light
from khep_twin.sensing.mujoco_scene import MujocoScene


class Moment(NamedTuple):
    """Moment of a world.

    Attributes:
        time_ns: Time [ns].
        qpos: Positions of all joints.
        light: Lamps.
        powers: Powers of the lamps [W].
    """

    time_ns: int
    qpos: NDArray[np.float64]
    light: Light
    powers: Sequence[float]


class PastScene:
    """Scene of a world at a moment.

    Args:
        model: Model of the scene.

    Attributes:
        model: Model of the scene.
        data: State of the scene, of which only positions are set.
        scene: The same for the infrared sensors.
    """

    def __init__(self, model: mujoco.MjModel) -> None:
        self.model, self.data = model, mujoco.MjData(model)
        self.scene = MujocoScene(model, self.data)
        self._qpos: NDArray[np.float64] | None = None

    def move_to(self, moment: Moment) -> None:
        """Show a moment."""
        if moment.qpos is not self._qpos:
            self.data.qpos[:] = moment.qpos
            self._qpos = moment.qpos
            mujoco.mj_kinematics(self.model, self.data)
            mujoco.mj_comPos(self.model, self.data)
            mujoco.mj_camlight(self.model, self.data)
