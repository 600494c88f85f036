"""Stills of logs in rerun, without a screen."""

# rerun's types are partly unknown.
# pyright: reportUnknownMemberType=false, reportUnknownVariableType=false

import os
import sys
import tempfile
import time
from contextlib import suppress
from pathlib import Path

import rerun.experimental as rx

from khep_twin.errors import LogError
from khep_twin.files.atomic import write_whole
from khep_twin.log.viewer.collected import TIMELINE
from khep_twin.log.viewer.process import free_ports

_OPENING_TIMEOUT_S = 30.0
"""Longest wait for the viewer to have opened a recording (assumed) [s]."""

_PAINTING = 1.0
"""Time after that until its pictures are stable [s]."""

_WIDTH = 1600
"""Width of a still [pixels]."""


def still(recording: Path, at_s: float, target: Path) -> None:
    """Write a still of a recording in rerun's viewer at a time.

    Args:
        recording: Recording of rerun, a file.
        at_s: Time [s].
        target: Path of the PNG file.

    Raises:
        LogError: The viewer does not start, does not answer or cannot draw.
    """
    # The viewer's output is hidden by default.
    os.environ.setdefault("RUST_LOG", "error")
    os.environ.setdefault("XDG_RUNTIME_DIR", tempfile.gettempdir())  # it warns if it is unset
    program = Path(sys.executable).with_name("rerun")
    try:
        viewer = rx.ViewerClient.spawn(
            headless=True,
            port=free_ports(1)[0],
            executable_path=str(program) if program.exists() else None,
            hide_welcome_screen=True,
        )
        try:
            _show(viewer, recording, at_s)
            picture = viewer.take_screenshot(max_size=_WIDTH)
        finally:
            with suppress(Exception):  # it may have ended by itself
                viewer.quit()
    except Exception as error:  # rerun's own errors are of many kinds, at the start or later
        raise LogError(
            f"{target}: rerun's viewer cannot draw here: {_first_line(error)}; expected Vulkan, of a "
            "graphics driver or of the package mesa-vulkan-drivers"
        ) from error
    write_whole(target, picture)


def _show(viewer: rx.ViewerClient, recording: Path, at_s: float) -> None:
    """Open a recording and wait until a time of it is shown."""
    viewer.open(str(recording.resolve()))
    deadline = time.monotonic() + _OPENING_TIMEOUT_S
    while True:
        try:
            viewer.set_time(TIMELINE, duration=at_s, play_state="paused")
            break
        except ConnectionError:
            raise
        except Exception:  # it has not read the recording so far
            if time.monotonic() > deadline:
                raise
            time.sleep(0.2)
    time.sleep(_PAINTING)


def _first_line(error: Exception) -> str:
    return (str(error).splitlines() or [type(error).__name__])[0]
