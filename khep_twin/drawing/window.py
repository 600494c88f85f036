"""A window that shows pictures, for example of an episode, at a rate.

GLFW, which comes with MuJoCo, opens the window, and MuJoCo draws the pixels.
"""

# glfw and MuJoCo's rendering are not typed here.
# pyright: reportMissingTypeStubs=false, reportUnknownMemberType=false, reportUnknownVariableType=false
# pyright: reportUnknownArgumentType=false, reportAttributeAccessIssue=false

import time
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from khep_twin.drawing.mujoco_viewer import check_screen


class PictureWindow:
    """Window of pictures; it opens with the first one.

    Args:
        title: Title of the window.
        frames_per_second: Number of pictures per second of wall time.

    Raises:
        KhepTwinError: There is no screen, or no OpenGL to draw on it.
    """

    def __init__(self, title: str, frames_per_second: float) -> None:
        check_screen("render_mode = 'human'", "without one, use render_mode='rgb_array'")
        self._title = title
        self._frame_s = 1 / frames_per_second
        self._next_frame_s = 0.0
        self._window: Any = None
        self._context: Any = None
        self._is_closed = False

    def show(self, picture: NDArray[np.uint8]) -> None:
        """Show a picture (height, width, 3) at its time; do nothing after the user has closed the window."""
        if self._is_closed:
            return
        import glfw

        height, width, _ = picture.shape
        if self._window is None:
            self._open(width, height)
        window: Any = self._window
        glfw.make_context_current(window)
        size = glfw.get_framebuffer_size(window)
        viewport, pixels = mujoco.MjrRect(0, 0, *size), np.ascontiguousarray(picture[::-1])
        mujoco.mjr_rectangle(viewport, 1, 1, 1, 1)
        mujoco.mjr_drawPixels(pixels.reshape(-1), None, mujoco.MjrRect(0, 0, width, height), self._context)
        time.sleep(max(self._next_frame_s - time.monotonic(), 0.0))
        self._next_frame_s = max(self._next_frame_s, time.monotonic() - self._frame_s) + self._frame_s
        glfw.swap_buffers(window)
        glfw.poll_events()
        if glfw.window_should_close(window):
            self.close()

    def close(self) -> None:
        """Close the window."""
        self._is_closed = True
        if self._window is not None:
            import glfw

            glfw.make_context_current(self._window)
            self._context.free()
            glfw.destroy_window(self._window)
            self._window = None

    def _open(self, width: int, height: int) -> None:
        import glfw

        glfw.window_hint(glfw.RESIZABLE, glfw.FALSE)
        glfw.window_hint(glfw.COCOA_RETINA_FRAMEBUFFER, glfw.FALSE)
        self._window = glfw.create_window(width, height, self._title, None, None)
        glfw.default_window_hints()
        glfw.make_context_current(self._window)
        glfw.swap_interval(0)
        model = mujoco.MjModel.from_xml_string("<mujoco/>")
        self._context = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_100)
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_WINDOW, self._context)
