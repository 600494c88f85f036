"""Faulty wheels of a robot in a compiled scene: slipping tyres and blocked wheels."""

import mujoco
import numpy as np
from numpy.typing import NDArray

from khep_twin.sensing.robot_indices import RobotIndices
from khep_twin.simulation.fitted_robots import contact_pairs_of

WHEEL_FIELDS = ("dof_armature", "dof_frictionloss", "dof_invweight0", "pair_friction")
"""Arrays of a model that wheel faults change."""

_INERTIA = 1.0
"""Inertia of a blocked wheel [kg m^2], a million times that of a motor's rotor behind its gear: a
Khepera's wheel creeps by 0.3 nm/s, that of a Khepera IV by 4 nm/s (measured)."""

_FRICTION_TORQUE = 1.0
"""Dry friction of a blocked wheel [N m], five times the largest torque of a calibration's motor."""


class FaultyWheels:
    """Wheels of a robot, without faults at first, in a model that no other world may use."""

    def __init__(self, model: mujoco.MjModel, data: mujoco.MjData, robot: RobotIndices) -> None:
        self._model = model
        self._data = data
        self._dofs = list(robot.wheel_dofs)
        self._tyre_pairs = [contact_pairs_of(model, [tyre]) for tyre in robot.tyres]
        self._sound_values: list[tuple[NDArray[np.float64], NDArray[np.intp], NDArray[np.float64]]] = []
        for name in WHEEL_FIELDS:
            array = getattr(model, name)
            indices = np.concatenate(self._tyre_pairs) if name == "pair_friction" else np.array(self._dofs)
            self._sound_values.append((array, indices, array[indices].copy()))

    def mend(self) -> None:
        """Restore wheels without faults, to the last bit."""
        for array, indices, values in self._sound_values:
            array[indices] = values

    def slip(self, side: int, factor: float) -> None:
        """Reduce the friction of a tyre (0 left, 1 right) on the floor by a factor."""
        self._model.pair_friction[self._tyre_pairs[side], :2] *= factor

    def block(self, side: int) -> None:
        """Block a wheel (0 left, 1 right)."""
        dof, model = self._dofs[side], self._model
        model.dof_armature[dof], model.dof_frictionloss[dof] = _INERTIA, _FRICTION_TORQUE
        # The inverse inertia scales the softness of its friction.
        model.dof_invweight0[dof] = 1 / _INERTIA
        self._data.qvel[dof] = 0
