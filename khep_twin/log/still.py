"""A still of a log as rerun shows it, without a screen."""

# rerun's types are partly unknown.
# pyright: reportUnknownMemberType=false, reportUnknownVariableType=false

import os
import sys
import time
from pathlib import Path

from khep_twin.errors import LogError
from khep_twin.files import write_whole
from khep_twin.log.viewer import free_ports

_PATIENCE = 30.0
"""Longest wait for the viewer to have opened a recording [s]."""

_PAINTING = 1.0
"""After that its pictures settle [s]."""

_WIDTH = 1600
"""Of a still [pixels]."""


def still(recording: Path, timeline: str, at_s: float, target: Path) -> None:
    """Writes what rerun's viewer shows of a recording at a time.

    Args:
        recording: of rerun, a file.
        timeline: on which the time is.
        at_s: the time [s].
        target: the PNG file.

    Raises:
        LogError: the viewer does not start or does not answer.
    """
    import rerun.experimental as rx

    # Unless somebody wants to know more, the viewer keeps what it does to itself.
    os.environ.setdefault("RUST_LOG", "error")
    program = Path(sys.executable).with_name("rerun")
    try:
        viewer = rx.ViewerClient.spawn(
            headless=True,
            port=free_ports(1)[0],
            executable_path=str(program) if program.exists() else None,
            hide_welcome_screen=True,
        )
    except Exception as error:  # rerun's own errors are of many kinds
        raise LogError(f"{target}: rerun's viewer does not start: {_first_line(error)}") from error
    try:
        viewer.open(str(recording.resolve()))
        deadline = time.monotonic() + _PATIENCE
        while True:
            try:
                viewer.set_time(timeline, duration=at_s, play_state="paused")
                break
            except Exception as error:
                if time.monotonic() > deadline:
                    raise LogError(f"{target}: rerun's viewer shows nothing: {_first_line(error)}") from error
                time.sleep(0.2)
        time.sleep(_PAINTING)
        write_whole(target, viewer.take_screenshot(max_size=_WIDTH))
    finally:
        viewer.quit()


def _first_line(error: Exception) -> str:
    return (str(error).splitlines() or [type(error).__name__])[0]
