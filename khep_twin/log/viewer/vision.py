"""Line images of robots that see, as a strip over time: the newest row is the lowest, left is left."""

# rerun's types are partly unknown.
# pyright: reportUnknownMemberType=false, reportUnknownVariableType=false, reportUnknownArgumentType=false

import numpy as np
import rerun as rr
from numpy.typing import NDArray
from rerun.chunk import Chunk

from khep_twin.board.turrets import installed
from khep_twin.log.attached import playpen_of
from khep_twin.log.reader import Label
from khep_twin.log.viewer.collected import Floats, time_column

ROWS = 100
"""Rows of a strip, of one image each."""

INTERVAL_NS = 100_000_000
"""Time between two rows [ns]: a strip shows ten seconds."""


def strip(robot: str) -> str:
    """Return the entity path of a robot's strip in a recording."""
    return f"/{robot}/vision_strip"


def seeing(label: Label) -> list[str]:
    """Return the robots of a log with a playpen that have a turret with line images."""
    if "playpen.toml" not in label.attachments:
        return []
    known = installed()
    robots = zip(label.robots, playpen_of(label.attachments, "log").robots, strict=False)
    return [
        name for name, robot in robots if any(known[each].image for each in robot.turrets if each in known)
    ]


class Strips:
    """Strips of all robots; a log may come in pieces.

    Args:
        interval_ns: Time between two rows [ns].
    """

    def __init__(self, interval_ns: int = INTERVAL_NS) -> None:
        self._interval_ns = interval_ns
        self._last: dict[str, tuple[int, Floats]] = {}

    def chunks(self, robot: str, times_ns: NDArray[np.int64], images: Floats) -> list[Chunk]:
        """Return a picture of the images so far for each of the next rows.

        Args:
            robot: Name of the robot.
            times_ns: Times of the images (n,) [ns].
            images: Greys of 0 to 255 (n, pixels).
        """
        last, before = self._last.get(robot, (-1, np.zeros((ROWS, images.shape[1]))))
        slots = times_ns // self._interval_ns
        first = np.diff(slots, prepend=last) > 0
        times_ns, images = times_ns[first], images[first]
        if not len(times_ns):
            return []
        width = images.shape[1]
        rows = np.concatenate((before, images)).astype(np.uint8)
        self._last[robot] = int(slots[-1]), rows[-ROWS:].astype(np.float64)
        pictures = np.lib.stride_tricks.sliding_window_view(rows, ROWS, axis=0)[1:].transpose(0, 2, 1)
        form = rr.components.ImageFormat(
            width=width, height=ROWS, color_model=rr.ColorModel.L, channel_datatype=rr.ChannelDatatype.U8
        )
        columns = rr.Image.columns(
            buffer=[picture.tobytes() for picture in pictures], format=[form] * len(pictures)
        )
        return [Chunk.from_columns(strip(robot), [time_column(times_ns)], columns)]
