"""Panels of a robot in rerun: the toolbox's khepbase, and the line images of a robot that sees.

khepbase is the robot from above, with bars for its sensors and wheels.

At each sensor a pair of bars, proximity (0 to 1023) and ambient light (0 to 500, as counted: long in the
dark); beside each wheel a bar of its speed (0 to 20 pulses/10 ms, downwards when it drives backwards), by
`khep_twin.sensing.bars`. Line images are a strip over time: the newest row is the lowest, left is left.
"""

# rerun's types are partly unknown.
# pyright: reportUnknownMemberType=false, reportUnknownVariableType=false, reportUnknownArgumentType=false

import math
from typing import Any

import numpy as np
import rerun as rr
from numpy.typing import NDArray
from rerun.chunk import Chunk

from khep_twin.board.turrets import installed
from khep_twin.log.attached import playpen_of
from khep_twin.log.reader import Label
from khep_twin.log.viewer.collected import Floats, Samples, time_column
from khep_twin.sensing.bars import BARS
from khep_twin.units import BODIES, WHEEL_BASE, WHEEL_RADIUS

SAMPLES_PER_PICTURE = 5
"""Samples of the log, 20 ms apart, per picture: ten a second are enough for the eye."""

_BODY = BODIES["khepera1"]
_BAR = 0.012
"""Length of a bar at its full value [m]."""

_HALF_WIDTH = 0.0014
_LINE = _HALF_WIDTH / 4
_LINES = _LINE * np.array((-3, -1, 1, 3))
"""Radius of the lines that a bar is made of, and their positions [m]."""

# Pictures have y downwards: ahead is up, left is left.
_FEET = np.array([(-left, -forward) for forward, left in _BODY.sensor_positions]) * 1.35
_BESIDE = np.array([_HALF_WIDTH * 1.15, 0])
_WHEELS = np.array([(-WHEEL_BASE / 2 + 0.006, 0.0), (WHEEL_BASE / 2 - 0.006, 0.0)])
_PROXIMITY, _LIGHT, _SPEED = (228, 87, 46), (244, 200, 70), (77, 171, 247)
_OUTLINE, _FRAME = (150, 150, 150), (90, 90, 90)
_LEGEND = 0.037
"""Top of the legend, below the robot [m]."""


def panel(robot: str) -> str:
    """Return the entity path of a robot's panel in a recording."""
    return f"/{robot}/khepbase"


def panel_chunks(robot: str, track: Samples) -> list[Chunk]:
    """Return the bars of one robot's panel."""
    position = panel(robot)
    times = time_column(track.times_ns)
    return [
        Chunk.from_columns(f"{position}/{name}", [times], _bars(_filled(name, values), at, colour))
        for name, values, at, colour in (
            ("proximity", track.proximity, _FEET - _BESIDE, _PROXIMITY),
            ("light", track.ambient, _FEET + _BESIDE, _LIGHT),
            ("speed", track.speed[:, :2], _WHEELS, _SPEED),
        )
    ]


def outline_chunks(robot: str) -> list[Chunk]:
    """Return the static parts of one robot's panel."""
    wheels = [_box(side * WHEEL_BASE / 2, 0.0, 0.0015, WHEEL_RADIUS) for side in (-1, 1)]
    nose = np.array([(-0.004, -0.020), (0, -0.0245), (0.004, -0.020)])
    strips = [_circle(_BODY.radius), *wheels, nose]
    lines = rr.LineStrips2D.columns(strips=strips, colors=[_OUTLINE] * len(strips))
    feet = np.vstack((_FEET - _BESIDE, _FEET + _BESIDE))
    frames = [_box(x, y - _BAR / 2, _HALF_WIDTH, _BAR / 2) for x, y in feet]
    frames += [_box(x, y, _HALF_WIDTH, _BAR) for x, y in _WHEELS]  # a wheel's bar extends in both directions
    full = rr.LineStrips2D.columns(strips=frames, colors=[_FRAME] * len(frames), radii=[0.0001] * len(frames))
    entries = {"proximity": _PROXIMITY, "light": _LIGHT, "speed": _SPEED}
    legend = rr.Points2D.columns(
        positions=[(0.0, _LEGEND + 0.0095 * index) for index in range(len(entries))],
        colors=list(entries.values()),
        labels=[BARS[name].legend for name in entries],
        show_labels=[True] * len(entries),
        radii=[0.001] * len(entries),
    )
    return [
        Chunk.from_columns(f"{panel(robot)}/outline", [], lines.partition([len(strips)])),
        Chunk.from_columns(f"{panel(robot)}/full", [], full.partition([len(frames)])),
        Chunk.from_columns(f"{panel(robot)}/legend", [], legend.partition([len(entries)])),
    ]


def _filled(name: str, values: Floats) -> Floats:
    parts: Floats = np.vectorize(BARS[name].filled, otypes=[np.float64])(values)
    return parts


def _bars(values: Floats, feet: Floats, colour: tuple[int, int, int]) -> Any:
    """Return filled bars on their feet (k, 2), of values from -1 to 1 (n, k), as columns.

    rerun fills no boxes: a bar is one line up and down beside itself, without a gap.
    """
    n, k = values.shape
    rise = np.sign(values) * np.maximum(np.abs(values) * _BAR - 2 * _LINE, 0)
    tops = np.stack((np.sign(values) * _LINE, np.sign(values) * _LINE + rise), axis=-1)  # y is downwards
    strips = np.empty((n, k, 2 * len(_LINES), 2), np.float32)
    for line, shift in enumerate(_LINES):
        ends = tops if line % 2 == 0 else tops[..., ::-1]
        strips[:, :, 2 * line : 2 * line + 2, 0] = feet[:, 0, None] + shift
        strips[:, :, 2 * line : 2 * line + 2, 1] = feet[:, 1, None] - ends
    columns = rr.LineStrips2D.columns(
        strips=strips.reshape(n * k, -1, 2),
        colors=np.where(np.abs(values.reshape(-1, 1)) > 0, (*colour, 255), (*colour, 0)).astype(np.uint8),
        radii=np.full(n * k, _LINE, np.float32),
    )
    return columns.partition([k] * n)


def _circle(radius: float) -> Floats:
    turns = np.linspace(0, 2 * math.pi, 64)
    return radius * np.column_stack([np.cos(turns), np.sin(turns)])


def _box(x: float, y: float, half_width: float, half_height: float) -> Floats:
    corners = np.array([(-1, -1), (1, -1), (1, 1), (-1, 1), (-1, -1)], np.float64)
    return np.array([x, y]) + corners * (half_width, half_height)


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
    """Strips of all robots, with a row each interval [ns]; a log may come in pieces."""

    def __init__(self, interval_ns: int = INTERVAL_NS) -> None:
        self._interval_ns = interval_ns
        self._last: dict[str, tuple[int, Floats]] = {}

    def chunks(self, robot: str, times_ns: NDArray[np.int64], images: Floats) -> list[Chunk]:
        """Return a picture of the images so far, greys of 0 to 255 (n, pixels), for each of the next rows."""
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
