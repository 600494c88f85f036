"""Coordinate frames of the bodies of a scene, named as in REP 105, and their poses as messages of /tf.

    map > khepera0/base_link > khepera0/left_wheel

A moving body has its pose in the frame of the body that it is mounted on, or in the map. A body fixed to a
moving one has a constant pose, in /tf_static. Other fixed bodies are a part of the map.
"""

import mujoco
import numpy as np
from numpy.typing import NDArray

from khep_twin.log.channels import BASE_FRAME, MAP, TransformFrame
from khep_twin.log.transforms import relative

_STEPS_PER_UNIT = 2.0**30
"""Resolution of positions [1/m] and of quaternions [1] in a log: about a nanometre.

Finer digits are contact noise, which does not compress: a seventh of the file. The hashes of the state
include them."""


class MovingBodies:
    """Poses of the moving bodies of a model as messages; `static_message` has those of the bodies on them."""

    def __init__(self, model: mujoco.MjModel) -> None:
        is_moving = model.body_weldid != 0
        has_joint = model.body_weldid == np.arange(model.nbody)
        self._bodies: NDArray[np.intp] = np.flatnonzero(is_moving & has_joint)
        self._parents = model.body_parentid[self._bodies]
        self._is_mounted = is_moving[self._parents]
        frames = [(parent_frame(model, body), frame_name(model, body)) for body in self._bodies.tolist()]
        self._frame = TransformFrame(frames)
        mounted: NDArray[np.intp] = np.flatnonzero(is_moving & ~has_joint)
        static_frames = [(parent_frame(model, body), frame_name(model, body)) for body in mounted.tolist()]
        static_poses = np.hstack([model.body_pos[mounted], model.body_quat[mounted][:, [1, 2, 3, 0]]])
        static_frame = TransformFrame(static_frames)
        self.static_message = static_frame.messages(np.zeros(1, np.int64), static_poses[None]).tobytes()

    def messages(
        self, times_ns: NDArray[np.int64], positions: NDArray[np.float64], quaternions: NDArray[np.float64]
    ) -> NDArray[np.void]:
        """Return one message of /tf for each time (n,) [ns], as rows of bytes (n,).

        Args:
            times_ns: Times (n,) [ns].
            positions: Positions of all bodies in the world (n, bodies, 3) [m].
            quaternions: Rotations of all bodies in the world, w, x, y, z (n, bodies, 4).
        """
        world = np.concatenate([positions, quaternions[:, :, [1, 2, 3, 0]]], axis=2)
        poses = world[:, self._bodies]
        parents = world[:, self._parents[self._is_mounted]]
        poses[:, self._is_mounted] = relative(poses[:, self._is_mounted], parents)
        return self._frame.messages(times_ns, np.rint(poses * _STEPS_PER_UNIT) / _STEPS_PER_UNIT)


def frame_name(model: mujoco.MjModel, body: int) -> str:
    """Return the name of a body's frame and link: "map", a robot's "base_link", or the body's name."""
    name = model.body(body).name or f"body{body}"
    if body == 0:
        return MAP
    return BASE_FRAME.format(name.removesuffix("/base")) if name.endswith("/base") else name


def parent_frame(model: mujoco.MjModel, body: int) -> str:
    """Return the name of the frame in which a body has its pose: its parent's, or the map's."""
    parent = int(model.body_parentid[body])
    return frame_name(model, parent) if model.body_weldid[parent] else MAP
