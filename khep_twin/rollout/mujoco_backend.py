"""State of one episode in MuJoCo."""

import math
from typing import Any

import mujoco
import numpy as np

from khep_twin import units
from khep_twin.errors import MissingExtraError
from khep_twin.playpen.starts import Start
from khep_twin.rollout import stepping
from khep_twin.rollout.controllers import Floats
from khep_twin.sensing import raycast
from khep_twin.sensing.buffers import Vector, view
from khep_twin.sensing.robot_indices import RobotIndices

Live = tuple[Vector[float], Vector[float], Vector[float], Vector[float], Vector[float], Vector[int]]
"""Live qpos, qvel, ctrl, force, positions and warnings, as in `stepping.RobotState`."""


class MujocoBackend:
    """State of a scene, reused by one episode after another.

    Args:
        model: Model of the scene; compiled episodes need no rangefinders in it.
        robot: Indices of the robot.
        compiled: Whether the state is for compiled code.

    Attributes:
        data: State of the scene.
        scene: Scene as the robot's sensors see it.
        advance: Function `stepping.advance` for this state.
    """

    def __init__(self, model: mujoco.MjModel, robot: RobotIndices, compiled: bool) -> None:
        self._model, self._robot, self._compiled = model, robot, compiled
        self.data = mujoco.MjData(model)
        self.scene: Any
        self.advance: stepping.Advance
        if compiled:
            try:
                from khep_twin.rollout import compiled as fast
                from khep_twin.rollout import compiled_casting
            except ImportError as error:
                raise MissingExtraError("numba", "batch") from error
            self.advance = fast.advance
            self.scene = compiled_casting.scene_of(model, self.data, robot)
        else:
            self.advance = stepping.advance
            self.scene = raycast.scene_of(model, self.data, robot)

    def put(self, start: Start | None) -> None:
        """Reset the state, and place the robot at the start if one is given."""
        mujoco.mj_resetData(self._model, self.data)
        if start is not None:
            self.data.qpos[self._robot.pose : self._robot.pose + 7] = _free_joint(start)

    @property
    def arrays(self) -> Live:
        """Arrays that the episode works on."""
        data = self.data
        arrays = (data.qpos, data.qvel, data.ctrl, data.actuator_force, data.xpos.reshape(-1))
        qpos, qvel, ctrl, force, bodies = arrays if self._compiled else map(view, arrays)
        return qpos, qvel, ctrl, force, bodies, data.warning.number

    @property
    def pose(self) -> tuple[float, float, float]:
        """True x, y [m] and heading [rad]."""
        return self._robot.pose_in(self.data.qpos)

    @property
    def joints(self) -> Floats:
        """Copy of the positions of all joints."""
        return self.data.qpos.copy()

    @property
    def warning(self) -> str:
        """Name of MuJoCo's warning."""
        return mujoco.mjtWarning(int(np.flatnonzero(self.data.warning.number)[0])).name


def _free_joint(start: Start) -> Floats:
    """Return the qpos of a robot's free joint at a start (7,), as MuJoCo computes it."""
    x_mm, y_mm, heading_deg = start
    heading = units.radians(heading_deg)
    spec = mujoco.MjSpec()
    frame = spec.worldbody.add_frame(
        pos=[units.metres(x_mm), units.metres(y_mm), 0],
        quat=[math.cos(heading / 2), 0, 0, math.sin(heading / 2)],
    )
    child = mujoco.MjSpec()
    body = child.worldbody.add_body(name="base", mass=1, inertia=[1, 1, 1])
    body.add_freejoint()
    spec.attach(child, prefix="robot/", frame=frame)
    return spec.compile().qpos0
