"""The line image of a K213 on the robot of a plane; controllers in the plane do not read it yet.

    view = PlaneView(world.playpen, model, world.forms.plane)
    light = view.take(pixels, lamps, world.playpen.lighting.room_lux)

The image is that of MuJoCo's scene, with the robot and the movable objects at their poses in the plane.
"""

from collections.abc import Sequence

import mujoco
import numpy as np
from numpy.typing import NDArray

from khep_twin.episodes.planar import plane as planar
from khep_twin.episodes.planar.plane import Plane
from khep_twin.playpen import Playpen
from khep_twin.robots.model import robot_name
from khep_twin.sensing.line_faces import FacePoses, fixed_faces, moving_faces
from khep_twin.sensing.line_scene import Eye
from khep_twin.simulation.mujoco_forms import movable_names
from khep_twin.units import K213_EYE_AHEAD, K213_EYE_HEIGHT
from khep_twin.vision.camera import Lamp, LineCamera


class PlaneView:
    """A line camera on the robot of a plane.

    Args:
        playpen: Playpen of the plane, with one robot.
        model: Model of its scene.
        plane: State of the plane, read at each image.
    """

    def __init__(self, playpen: Playpen, model: mujoco.MjModel, plane: Plane) -> None:
        self._model = model
        self._plane = plane
        data = mujoco.MjData(model)
        mujoco.mj_kinematics(model, data)
        self._geoms, self._geom_turns = data.geom_xpos.copy(), data.geom_xmat.copy()
        self._sites, self._site_turns = data.site_xpos.copy(), data.site_xmat.copy()
        self._start_poses = self._geoms.copy(), self._geom_turns.copy()
        base = model.body(f"{robot_name(0)}/base").id
        is_robot = model.body_rootid[model.geom_bodyid] == base
        self._robot_geoms: list[int] = np.flatnonzero(is_robot).tolist()
        self._robot_start = data.xpos[base].copy(), data.xmat[base].reshape(3, 3).copy()
        self._movable: list[tuple[int, list[int]]] = [
            (model.geom(name).id, np.flatnonzero(model.site_bodyid == model.body(name).id).tolist())
            for name in movable_names(playpen)
        ]
        face_poses = FacePoses(self._geoms, self._geom_turns, self._sites, self._site_turns)
        self._camera = LineCamera(fixed_faces(model), moving_faces(model, base), face_poses)

    def take(
        self,
        pixels: NDArray[np.int64],
        lamps: Sequence[Lamp],
        room_lux: float,
        exposure_ms: int = 0,
        noise_key: tuple[int, int] = (0, 0),
        image_number: int = 0,
        *,
        noise: float = False,
        compiled: bool = False,
    ) -> int:
        """Fill in `pixels` with an image of the present plane; arguments are as of `LineCamera.take`."""
        joints = self._plane.robot.joints
        x, y = joints[planar.X], joints[planar.Y]
        c, s = planar.direction(self._plane.robot)
        self._place_geoms(x, y, c, s)
        eye = Eye(x + K213_EYE_AHEAD * c, y + K213_EYE_AHEAD * s, K213_EYE_HEIGHT, c, s)
        return self._camera.take(
            eye, pixels, lamps, room_lux, exposure_ms, noise_key, image_number, noise=noise, compiled=compiled
        )

    def _place_geoms(self, x: float, y: float, c: float, s: float) -> None:
        """Set the poses of the robot's geoms and of the movable objects to those in the plane."""
        start, start_turn = self._robot_start
        turn = _upright(c, s) @ start_turn.T
        start_positions, start_turns = self._start_poses
        for geom in self._robot_geoms:
            self._geoms[geom] = turn @ (start_positions[geom] - start) + (x, y, start[2])
            self._geom_turns[geom] = (turn @ start_turns[geom].reshape(3, 3)).ravel()
        obstacles, bodies = self._plane.obstacles, self._plane.bodies
        for body, (geom, sites) in enumerate(self._movable):
            row = int(bodies[body, planar.OBSTACLE])
            c, s = obstacles[row, planar.COSINE], obstacles[row, planar.SINE]
            frame = _upright(c, s)
            height = (obstacles[row, planar.BOTTOM] + obstacles[row, planar.TOP]) / 2
            centre = np.array([obstacles[row, planar.CENTRE_X], obstacles[row, planar.CENTRE_Y], height])
            self._geoms[geom] = centre
            self._geom_turns[geom] = frame.ravel()
            for site in sites:
                site_turn = np.zeros(9)
                mujoco.mju_quat2Mat(site_turn, self._model.site_quat[site])
                self._sites[site] = centre + frame @ self._model.site_pos[site]
                self._site_turns[site] = (frame @ site_turn.reshape(3, 3)).ravel()


def _upright(c: float, s: float) -> NDArray[np.float64]:
    """Return the rotation matrix about the vertical axis, from cosine and sine (3, 3)."""
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
