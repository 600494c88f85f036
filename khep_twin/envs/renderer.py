"""Pictures of an episode as arrays: the scene rendered by MuJoCo, or a map.

MuJoCo renders without a screen by EGL or OSMesa if `MUJOCO_GL=egl` or `MUJOCO_GL=osmesa` is set before mujoco
is imported.
"""

import copy
import math
import os
import sys
import warnings
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, Literal

import mujoco
import numpy as np
from numpy.typing import NDArray

from khep_twin.envs.arguments import check_choice
from khep_twin.episodes.episode import Episode
from khep_twin.episodes.episode_setup import EpisodeSetup
from khep_twin.errors import KhepTwinError
from khep_twin.playpen import Lamp
from khep_twin.robots.model import robot_name
from khep_twin.simulation.mujoco_forms import movable_names

if TYPE_CHECKING:
    from khep_twin.drawing.moving_map import MovingMap

Pose = tuple[float, float, float]
"""x, y [m] and heading [rad]."""

Picture = NDArray[np.uint8]
"""Rows from the top (height, width, 3), red, green, blue."""

View = Literal["auto", "scene", "map"]
VIEWS = ("auto", "scene", "map")

WIDTH, HEIGHT = 640, 480
"""Size of a rendered scene [pixels]: MuJoCo's offscreen buffer; a map has another size."""

_REMEDY = "expected MUJOCO_GL=egl or MUJOCO_GL=osmesa, with that library installed, or view='map'"


class MapWarning(UserWarning):
    """Warning that pictures are maps, as MuJoCo cannot render here."""


class Renderer:
    """Renderer of pictures of episodes.

    Static parts are drawn once, not for each picture.

    Args:
        view: "scene" rendered by MuJoCo, "map", or "auto". "auto" is a map for the 2-D model, and without a
            screen and `MUJOCO_GL`; otherwise a scene if MuJoCo can render, or a map with a warning.

    Attributes:
        view: View of the pictures; "auto" before the first.

    Raises:
        KhepTwinError: The view is unknown.
    """

    def __init__(self, view: View = "auto") -> None:
        check_choice("view", view, VIEWS)
        self.view: View = "map" if view == "auto" and not _can_render() else view
        self._renderer: mujoco.Renderer | None = None
        self._data: mujoco.MjData | None = None
        self._map: tuple[EpisodeSetup, tuple[Lamp, ...], MovingMap] | None = None

    def picture(self, episode: Episode) -> Picture:
        """Return a picture of an episode's state, which is not changed.

        Raises:
            KhepTwinError: The view is "scene", and MuJoCo cannot render here.
        """
        if self.view == "scene" or (self.view == "auto" and episode.setup.planar_scene is None):
            try:
                picture = self._render_scene(episode)
            except Exception as error:  # each GL backend raises its own errors
                if self.view == "scene":
                    raise KhepTwinError(f"MuJoCo cannot render here ({_reason(error)}); {_REMEDY}") from error
                warnings.warn(
                    f"pictures are maps, as MuJoCo cannot render here ({_reason(error)}); {_REMEDY}",
                    MapWarning,
                    stacklevel=2,
                )
                self.view = "map"
            else:
                self.view = "scene"
                return picture
        return self._moving_map(episode).picture(episode.poses, _as_poses(episode.objects))

    def close(self) -> None:
        """Release the resources of rendering."""
        if self._renderer is not None:
            self._renderer.close()
            self._renderer = None

    def _render_scene(self, episode: Episode) -> Picture:
        planar = episode.setup.planar_scene is not None
        model = episode.setup.model if planar else episode.data.model
        if self._renderer is None or self._data is None or self._data.model is not model:
            self.close()
            render_model = copy.copy(model)
            visual: Any = render_model.vis
            # In software rendering, three times faster than the quality of stills.
            visual.quality.shadowsize, visual.quality.offsamples = 2048, 0
            self._renderer, self._data = mujoco.Renderer(render_model, HEIGHT, WIDTH), mujoco.MjData(model)
        data, arena = self._data, episode.setup.playpen.arena
        if planar:
            _set_poses(data, [f"{robot_name(0)}/base", *movable_names(episode.setup.playpen)], episode)
        else:
            data.qpos[:] = episode.data.qpos
        mujoco.mj_kinematics(model, data)
        mujoco.mj_camlight(model, data)
        width, depth = arena.width_mm / 1e3, arena.height_mm / 1e3
        camera = mujoco.MjvCamera()
        camera.lookat[:] = width / 2, depth / 2, 0
        camera.distance = 1.3 * max(width, WIDTH / HEIGHT * depth)
        camera.azimuth, camera.elevation = 90.0, -65.0
        self._renderer.update_scene(data, camera)
        return self._renderer.render()

    def _moving_map(self, episode: Episode) -> "MovingMap":
        """Return the map of an episode's playpen and lamps, redrawn if these have changed."""
        from khep_twin.drawing.moving_map import MovingMap

        setup, playpen = episode.setup, episode.playpen
        drawn_setup, drawn_lamps, moving_map = self._map or (None, (), None)
        if moving_map is None or drawn_setup is not setup or drawn_lamps != playpen.lamps:
            moving_map = MovingMap(playpen)
            self._map = setup, playpen.lamps, moving_map
        return moving_map


def _set_poses(data: mujoco.MjData, bodies: Sequence[str], episode: Episode) -> None:
    """Set the poses of robot and movable objects of a 2-D episode in MuJoCo's data."""
    model = data.model
    data.qpos[:] = model.qpos0
    for name, (x, y, heading) in zip(bodies, (*episode.poses, *_as_poses(episode.objects)), strict=True):
        address = model.jnt_qposadr[model.body_jntadr[model.body(name).id]]
        data.qpos[[address, address + 1]] = x, y
        data.qpos[address + 3 : address + 7] = math.cos(heading / 2), 0, 0, math.sin(heading / 2)


def _as_poses(rows: NDArray[np.float64]) -> list[Pose]:
    return [(x, y, heading) for x, y, heading in rows.tolist()]


def _can_render() -> bool:
    """Return whether MuJoCo may find OpenGL, which needs a screen or `MUJOCO_GL` on Linux."""
    names = ("MUJOCO_GL", "DISPLAY", "WAYLAND_DISPLAY")
    return sys.platform != "linux" or any(os.environ.get(name) for name in names)


def _reason(error: Exception) -> str:
    """Return the first line of an error, without a full stop."""
    try:
        lines = str(error).splitlines()
    except Exception:  # str() of PyOpenGL's errors may fail
        lines = []
    return lines[0].strip().rstrip(".") if lines else type(error).__name__
