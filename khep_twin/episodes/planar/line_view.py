"""The line image of a K213 on the robot of a plane, whose controllers do not read it yet.

    view = PlaneView(world.playpen, model, world.forms.plane)
    light = view.take(pixels, lamps, world.playpen.lighting.room_lux)

The image is that of MuJoCo's scene with the robot and what can move at their places in the plane.
"""

from collections.abc import Sequence

import mujoco
import numpy as np
from numpy.typing import NDArray

from khep_twin.episodes.planar import plane as flat
from khep_twin.episodes.planar.plane import Plane
from khep_twin.playpen import Playpen
from khep_twin.sensing.line_faces import Places, fixed_faces, moving_faces
from khep_twin.sensing.line_scene import Eye
from khep_twin.simulation.mujoco_forms import movable_names
from khep_twin.units import K213_EYE_AHEAD, K213_EYE_HEIGHT
from khep_twin.vision.camera import Lamp, LineCamera


class PlaneView:
    """A line camera on the robot of a plane.

    Args:
        playpen: Playpen of the plane, with one robot.
        model: Model of its scene.
        plane: State of the plane, live.
    """

    def __init__(self, playpen: Playpen, model: mujoco.MjModel, plane: Plane) -> None:
        self._model, self._plane = model, plane
        data = mujoco.MjData(model)
        mujoco.mj_kinematics(model, data)
        self._geoms, self._geom_turns = data.geom_xpos.copy(), data.geom_xmat.copy()
        self._sites, self._site_turns = data.site_xpos.copy(), data.site_xmat.copy()
        self._own_places = self._geoms.copy(), self._geom_turns.copy()
        base = model.body("khepera0/base").id
        own = model.body_rootid[model.geom_bodyid] == base
        self._own: list[int] = np.flatnonzero(own).tolist()
        self._own_start = data.xpos[base].copy(), data.xmat[base].reshape(3, 3).copy()
        self._movable: list[tuple[int, list[int]]] = [
            (model.geom(name).id, np.flatnonzero(model.site_bodyid == model.body(name).id).tolist())
            for name in movable_names(playpen)
        ]
        at = Places(self._geoms, self._geom_turns, self._sites, self._site_turns)
        self._camera = LineCamera(fixed_faces(model), moving_faces(model, base), at)

    def take(
        self,
        pixels: NDArray[np.int64],
        lamps: Sequence[Lamp],
        room_lux: float,
        exposure_ms: int = 0,
        key: tuple[int, int] = (0, 0),
        number: int = 0,
        *,
        noisy: bool = False,
        compiled: bool = False,
    ) -> int:
        """Take an image; arguments and result are those of `LineCamera.take`."""
        joints = self._plane.robot.joints
        x, y = joints[flat.X], joints[flat.Y]
        c, s = flat.direction(self._plane.robot)
        self._put(x, y, c, s)
        eye = Eye(x + K213_EYE_AHEAD * c, y + K213_EYE_AHEAD * s, K213_EYE_HEIGHT, c, s)
        return self._camera.take(
            eye, pixels, lamps, room_lux, exposure_ms, key, number, noisy=noisy, compiled=compiled
        )

    def _put(self, x: float, y: float, c: float, s: float) -> None:
        """Put the robot's own geoms, and what can move, to their places in the plane."""
        start, turned = self._own_start
        turn = _upright(c, s) @ turned.T
        places, turns = self._own_places
        for geom in self._own:
            self._geoms[geom] = turn @ (places[geom] - start) + (x, y, start[2])
            self._geom_turns[geom] = (turn @ turns[geom].reshape(3, 3)).ravel()
        things, bodies = self._plane.things, self._plane.bodies
        for body, (geom, sites) in enumerate(self._movable):
            row = int(bodies[body, flat.THING])
            c, s = things[row, flat.COSINE], things[row, flat.SINE]
            frame = _upright(c, s)
            middle = (things[row, flat.BOTTOM] + things[row, flat.TOP]) / 2
            place = np.array([things[row, flat.CENTRE_X], things[row, flat.CENTRE_Y], middle])
            self._geoms[geom] = place
            self._geom_turns[geom] = frame.ravel()
            for site in sites:
                own = np.zeros(9)
                mujoco.mju_quat2Mat(own, self._model.site_quat[site])
                self._sites[site] = place + frame @ self._model.site_pos[site]
                self._site_turns[site] = (frame @ own.reshape(3, 3)).ravel()


def _upright(c: float, s: float) -> NDArray[np.float64]:
    """Return the orientation of what has turned about the vertical, by cosine and sine (3, 3)."""
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
