"""MuJoCo's viewer as a window on a running world.

The viewer uses copies of the scene and its state, which are updated up to 30 times per second. It has no
effect on the run, which is the same bit for bit without it: the mouse moves the camera, not the robots.
"""

# mujoco.viewer and glfw are not typed here.
# pyright: reportMissingTypeStubs=false, reportUnknownMemberType=false, reportUnknownVariableType=false
# pyright: reportUnknownArgumentType=false, reportAttributeAccessIssue=false

import copy
import os
import sys
import threading
import time
import warnings
from typing import Any

import mujoco
import numpy as np

from khep_twin.clock import NS_PER_S
from khep_twin.errors import KhepTwinError
from khep_twin.observers import Observer
from khep_twin.world import World

FRAME_NS = NS_PER_S // 30
"""Shortest wall time between two frames [ns]."""

_MAX_SLEEP_S = 0.05
"""Longest single sleep [s], so that a closed window is detected."""

_CLOSING_S = 10.0
"""Longest wait for the window to close (assumed) [s]."""

_REMEDY = "without one, give --log FILE.mcap and look at it with khep-twin view"


class MujocoViewer(Observer):
    """Window on a world; an `Observer` of it, and of later worlds in a series.

    Args:
        real_time: True to slow down a world that runs ahead of the wall clock.

    Raises:
        KhepTwinError: There is no screen, or no OpenGL to draw on it; or this is not mjpython on macOS.
    """

    def __init__(self, *, real_time: bool) -> None:
        if sys.platform == "darwin":
            _check_mjpython()
        else:
            check_screen("--viewer", _REMEDY)
        self._real_time = real_time
        self._handle: Any = None
        self._model: mujoco.MjModel | None = None
        self._data: mujoco.MjData | None = None
        self._threads: set[threading.Thread] = set()
        self._last_frame_ns = 0
        self._offset_ns = 0

    def watch(self, world: World) -> None:
        """Show a world; open the window for the first one."""
        from mujoco import viewer

        if self._model is None:
            self._model, self._data = copy.copy(world.model), copy.copy(world.data)
            other_threads = set(threading.enumerate())
            self._handle = viewer.launch_passive(
                self._model, self._data, show_left_ui=False, show_right_ui=False
            )
            self._threads = set(threading.enumerate()) - other_threads
            self._point_camera(world)
        self._offset_ns = world.time_ns - time.monotonic_ns()
        world.add_observer(self)

    def close(self) -> None:
        """Close the window and wait for its last frame; X would end a process that draws without a window."""
        if self._handle is not None:
            self._handle.close()
        for thread in self._threads:
            thread.join(_CLOSING_S)

    def sample(self, world: World) -> None:
        """Draw a frame if it is due, and wait for the wall clock in real time."""
        if self._handle is None or not self._handle.is_running():
            return
        if time.monotonic_ns() - self._last_frame_ns >= FRAME_NS:
            self._draw_frame(world)
        while self._real_time and self._handle.is_running():
            early_ns = world.time_ns - self._offset_ns - time.monotonic_ns()
            if early_ns <= 0:
                break
            time.sleep(min(early_ns / NS_PER_S, _MAX_SLEEP_S))

    def _draw_frame(self, world: World) -> None:
        assert self._model is not None
        assert self._data is not None
        with self._handle.lock():
            mujoco.mj_copyData(self._data, world.model, world.data)
            for index, (lamp, power) in enumerate(zip(world.playpen.lamps, world.lamps.powers, strict=True)):
                glass = world.model.site(f"lamp{index}").rgba[:3]
                # A lamp that is off is dark glass.
                self._model.site(f"lamp{index}").rgba[:3] = glass * (
                    0.25 + 0.75 * (power / lamp.power_w if power else 0)
                )
        self._handle.sync()
        self._last_frame_ns = time.monotonic_ns()

    def _point_camera(self, world: World) -> None:
        """Point the camera at the arena's centre, from above and in front."""
        arena = world.playpen.arena
        camera = self._handle.cam
        camera.lookat[:] = np.array((arena.width_mm, arena.height_mm, 0.0)) / 2000
        camera.distance = 1.25 * max(arena.width_mm, 1.2 * arena.height_mm) / 1000
        camera.azimuth, camera.elevation = 90, -52


def has_screen() -> bool:
    """Return whether there may be a screen; on Linux the environment names it."""
    return sys.platform != "linux" or any(map(os.environ.get, ("DISPLAY", "WAYLAND_DISPLAY")))


def _check_mjpython() -> None:
    """Raise a `KhepTwinError` without mjpython, which leaves the main thread to the window on macOS."""
    from mujoco import viewer

    if viewer._MJPYTHON is None:
        raise KhepTwinError(f"--viewer: this is python, expected mjpython -m khep_twin on macOS; {_REMEDY}")


def check_screen(option: str, remedy: str) -> None:
    """Raise a `KhepTwinError` if no window can be opened, as the viewer would wait indefinitely."""
    if not has_screen():
        raise KhepTwinError(f"{option}: DISPLAY is not set, expected a desktop; {remedy}")
    import glfw

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # glfw also reports its errors as warnings
        window = None
        if glfw.init():
            glfw.window_hint(glfw.VISIBLE, glfw.FALSE)
            window = glfw.create_window(64, 64, "khep_twin", None, None)
            glfw.default_window_hints()
    if not window:
        raise KhepTwinError(f"{option}: no window can be opened, expected a screen with OpenGL; {remedy}")
    glfw.destroy_window(window)
