"""Lazy measurements: moments that robots record in the stepping core, and the scene at one of them.

A robot may measure continuously while its programs and logs read seldom. It then records a moment at each
measurement (`scene.save_moment`), which is evaluated when a reading is requested. A reading depends only on
the moment, not on the time of its evaluation.
"""

from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from khep_twin.sensing.mujoco_scene import FRAME_UPDATES, MujocoScene


class Moments:
    """Recorded moments of a scene, and a copy of the scene that shows one of them.

    Args:
        model: Compiled scene.
        count: Number of moments.

    Attributes:
        rows: Positions of joints, then powers of lamps (count, n_qpos + n_powers).
    """

    def __init__(self, model: mujoco.MjModel, count: int) -> None:
        self._n_qpos = len(model.qpos0)
        self.rows: NDArray[np.float64] = np.zeros((count, self._n_qpos))
        self.use(model)

    def use(self, model: mujoco.MjModel) -> None:
        """Show the moments in a scene, or in the present one after fixed geoms were moved in it."""
        self._model = model
        self._data: mujoco.MjData | None = None
        self._plain: MujocoScene | None = None
        self._arrays: tuple[Any, ...] | None = None

    def reserve(self, n_lamps: int) -> bool:
        """Make space for the powers of `n_lamps` lamps; return whether `rows` has been replaced."""
        n_missing = self._n_qpos + n_lamps - self.rows.shape[1]
        if n_missing <= 0 or not len(self.rows):
            return False
        self.rows = np.pad(self.rows, ((0, 0), (0, n_missing)))
        return True

    def show(self, moment: int) -> None:
        """Move the copy of the scene to a moment."""
        data = self._copy
        data.qpos[:] = self.rows[moment, : self._n_qpos]
        for update in FRAME_UPDATES:
            update(self._model, data)

    @property
    def _copy(self) -> mujoco.MjData:
        """State of the scene's copy."""
        if self._data is None:
            self._data = mujoco.MjData(self._model)
        return self._data

    def powers(self, moment: int) -> NDArray[np.float64]:
        """Return the powers of the lamps at a moment (1, n) [W]."""
        return self.rows[moment : moment + 1, self._n_qpos :]

    def plain(self) -> Any:
        """Return the scene at the shown moment for plain code."""
        if self._plain is None:
            self._plain = MujocoScene(self._model, self._copy)
        return self._plain

    def compiled(self) -> tuple[Any, ...]:
        """Return the same scene for compiled code, as arrays."""
        from khep_twin.simulation.mujoco_calls import make_calls

        if self._arrays is None:
            self._arrays = make_calls(self._model, self._copy, self.rows)
        return self._arrays
