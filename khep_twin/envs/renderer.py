"""Pictures of an episode as arrays: the scene rendered by MuJoCo, or, without GL, a map.

MuJoCo renders without a screen by EGL or OSMesa if `MUJOCO_GL=egl` or `MUJOCO_GL=osmesa` is set before mujoco
is imported.
"""

import os
import sys
import warnings
from collections.abc import Sequence
from io import BytesIO
from math import degrees
from typing import Literal

import mujoco
import numpy as np
from numpy.typing import NDArray

from khep_twin.errors import KhepTwinError, choices
from khep_twin.playpen import Playpen

Pose = tuple[float, float, float]
"""x, y [m] and heading [rad]."""

Picture = NDArray[np.uint8]
"""Rows from the top (height, width, 3), red, green, blue."""

View = Literal["auto", "scene", "map"]
VIEWS = ("auto", "scene", "map")

WIDTH, HEIGHT = 640, 480
"""Size of a rendered scene [pixels]: MuJoCo's offscreen buffer; a map has its own size."""

_MAP_DPI = 100.0


class MapWarning(UserWarning):
    """Warning that pictures are maps, as MuJoCo cannot render here."""


class Renderer:
    """Renderer of pictures of one playpen.

    Args:
        playpen: Playpen.
        view: "scene" rendered by MuJoCo, "map", or "auto" for a map where there is no screen and no
            `MUJOCO_GL`, else a scene if possible, and if not a map with a warning.
        planar: Whether the episodes are in a plane, of which there are only maps.

    Attributes:
        view: View of the pictures; "auto" before the first.

    Raises:
        KhepTwinError: The view is unknown, or a scene in a plane.
    """

    def __init__(self, playpen: Playpen, view: View = "auto", planar: bool = False) -> None:
        if view not in VIEWS:
            raise KhepTwinError(f"view {view!r}: unknown; {choices(view, VIEWS)}")
        if planar and view == "scene":
            raise KhepTwinError("view 'scene': a plane has no MuJoCo scene; expected 'map' or 'auto'")
        self._playpen = playpen
        self.view: View = "map" if planar or (view == "auto" and not _may_render()) else view
        self._renderer: mujoco.Renderer | None = None
        self._own: mujoco.MjData | None = None

    def picture(self, data: mujoco.MjData | None, poses: Sequence[Pose]) -> Picture:
        """Return a picture of a state, which is not changed.

        Args:
            data: State of the scene; None in a plane.
            poses: Poses of the robots.

        Raises:
            KhepTwinError: The view is "scene", and MuJoCo cannot render here.
        """
        if self.view != "map" and data is not None:
            try:
                picture = self._scene(data)
            except Exception as error:  # each GL backend raises its own errors
                if self.view == "scene":
                    raise KhepTwinError(f"MuJoCo cannot render here ({_told(error)}); {_REMEDY}") from error
                warnings.warn(
                    f"pictures are maps, as MuJoCo cannot render here ({_told(error)}); {_REMEDY}",
                    MapWarning,
                    stacklevel=2,
                )
                self.view = "map"
            else:
                self.view = "scene"
                return picture
        return self._map(poses)

    def close(self) -> None:
        """Release the resources of rendering."""
        if self._renderer is not None:
            self._renderer.close()
            self._renderer = None

    def _scene(self, data: mujoco.MjData) -> Picture:
        model = data.model
        if self._renderer is None or self._own is None or self._own.model is not model:
            self.close()
            self._renderer, self._own = mujoco.Renderer(model, HEIGHT, WIDTH), mujoco.MjData(model)
        own = self._own
        own.qpos[:] = data.qpos
        mujoco.mj_kinematics(model, own)
        mujoco.mj_camlight(model, own)
        arena = self._playpen.arena
        width, depth = arena.width_mm / 1e3, arena.height_mm / 1e3
        camera = mujoco.MjvCamera()
        camera.lookat[:] = width / 2, depth / 2, 0
        camera.distance = 1.3 * max(width, 4 / 3 * depth)
        camera.azimuth, camera.elevation = 90.0, -65.0
        self._renderer.update_scene(own, camera)
        return self._renderer.render()

    def _map(self, poses: Sequence[Pose]) -> Picture:
        from PIL import Image

        from khep_twin.drawing.map import draw, picture

        robots = tuple(
            robot.model_copy(
                update={"x_mm": x * 1e3, "y_mm": y * 1e3, "heading_deg": degrees(heading), "spots": ()}
            )
            for robot, (x, y, heading) in zip(self._playpen.robots, poses, strict=True)
        )
        figure = draw(self._playpen.model_copy(update={"robots": robots}))
        with Image.open(BytesIO(picture(figure, "png", _MAP_DPI))) as image:
            return np.array(image.convert("RGB"))


def _may_render() -> bool:
    """Return whether MuJoCo may find OpenGL: on Linux it needs a screen or `MUJOCO_GL`."""
    names = ("MUJOCO_GL", "DISPLAY", "WAYLAND_DISPLAY")
    return sys.platform != "linux" or any(os.environ.get(name) for name in names)


_REMEDY = "expected MUJOCO_GL=egl or MUJOCO_GL=osmesa, with that library installed, or view='map'"


def _told(error: Exception) -> str:
    """Return the first line of an error, without a full stop."""
    try:
        lines = str(error).splitlines()
    except Exception:  # str() of PyOpenGL's errors may fail
        lines = []
    return lines[0].strip().rstrip(".") if lines else type(error).__name__
