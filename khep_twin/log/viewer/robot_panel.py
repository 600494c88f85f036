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
from khep_twin.sensing.bars import Bar, bars_of
from khep_twin.units import BODY_RADIUS, Body

SAMPLES_PER_PICTURE = 5
"""Samples of the log, 20 ms apart, per picture: ten a second are enough for the eye."""

_BAR = 0.012
_HALF_WIDTH = 0.0014
_LINE = _HALF_WIDTH / 4
_LINES = _LINE * np.array((-3, -1, 1, 3))
_SMALL = 0.0001
"""Length of a bar at its full value, half its width, radius and positions of its lines, radius of frames [m]:
of a Khepera, as are all lengths here; of larger robots `PanelPlaces.scale` times as much."""

_PROXIMITY, _LIGHT, _SPEED = (228, 87, 46), (244, 200, 70), (77, 171, 247)
_OUTLINE, _FRAME = (150, 150, 150), (90, 90, 90)
_LEGEND = 0.037
"""Top of the legend, below the robot [m]."""


class PanelPlaces:
    """PanelPlaces in the panel of a robot.

    Sensors that look at the floor have theirs in a row in front of the axle; the nose is then outside.

    Attributes:
        scale: Size beside a Khepera.
        feet: Feet of the bars of proximity (n, 2) and ...
        light_feet: ... of light [m].
        wheels: Feet of the bars of both wheels (2, 2) [m].
        nose: Positions of the nose's foot and tip ahead [m].
        bounds: Ranges of the panel's x and y [m].
    """

    def __init__(self, body: Body) -> None:
        self.scale = body.radius / BODY_RADIUS
        # Pictures have y downwards: ahead is up, left is left.
        around = np.array([(-left, -forward) for forward, left in body.sensor_positions]) * 1.35
        row = [(x * self.scale, -0.013 * self.scale) for x in _ROW[: len(body.ground_positions)]]
        feet = np.vstack([around, np.array(row).reshape(-1, 2)])
        beside = np.array([_HALF_WIDTH * 1.15 * self.scale, 0])
        self.feet, self.light_feet = feet - beside, feet + beside
        side = body.wheel_base / 2 - 0.006 * self.scale
        self.wheels = np.array([(-side, 0.0), (side, 0.0)])
        self.nose = np.array((-0.0275, -0.032) if row else (-0.020, -0.0245)) * self.scale
        x, y = 0.045 * self.scale, np.array((-0.052, 0.068)) * self.scale
        self.bounds = (-x, x), (float(y[0]), float(y[1]))


_ROW = (-0.0105, -0.0035, 0.0035, 0.0105)


def panel(robot: str) -> str:
    """Return the entity path of a robot's panel in a recording."""
    return f"/{robot}/khepbase"


def panel_chunks(robot: str, track: Samples, body: Body) -> list[Chunk]:
    """Return the bars of one robot's panel."""
    position, places, bars = panel(robot), PanelPlaces(body), bars_of(body)
    times = time_column(track.times_ns)
    return [
        Chunk.from_columns(
            f"{position}/{name}", [times], _bars(_filled(bars[name], values), at, colour, places.scale)
        )
        for name, values, at, colour in (
            ("proximity", track.proximity, places.feet, _PROXIMITY),
            ("light", track.ambient, places.light_feet, _LIGHT),
            ("speed", track.speed[:, :2], places.wheels, _SPEED),
        )
    ]


def outline_chunks(robot: str, body: Body) -> list[Chunk]:
    """Return the static parts of one robot's panel."""
    places = PanelPlaces(body)
    scale, half, bar = places.scale, places.scale * _HALF_WIDTH, places.scale * _BAR
    wheels = [
        _box(side * body.wheel_base / 2, 0.0, body.wheel_width / 2, body.wheel_radius) for side in (-1, 1)
    ]
    foot, tip = places.nose
    nose = np.array([(-0.004 * scale, foot), (0, tip), (0.004 * scale, foot)])
    strips = [_circle(body.radius), *wheels, nose]
    lines = rr.LineStrips2D.columns(strips=strips, colors=[_OUTLINE] * len(strips))
    feet = np.vstack((places.feet, places.light_feet))
    frames = [_box(x, y - bar / 2, half, bar / 2) for x, y in feet]
    frames += [_box(x, y, half, bar) for x, y in places.wheels]  # a wheel's bar extends in both directions
    radii = [_SMALL * scale] * len(frames)
    full = rr.LineStrips2D.columns(strips=frames, colors=[_FRAME] * len(frames), radii=radii)
    entries, bars = {"proximity": _PROXIMITY, "light": _LIGHT, "speed": _SPEED}, bars_of(body)
    legend = rr.Points2D.columns(
        positions=[(0.0, (_LEGEND + 0.0095 * index) * scale) for index in range(len(entries))],
        colors=list(entries.values()),
        labels=[bars[name].legend for name in entries],
        show_labels=[True] * len(entries),
        radii=[0.001 * scale] * len(entries),
    )
    return [
        Chunk.from_columns(f"{panel(robot)}/outline", [], lines.partition([len(strips)])),
        Chunk.from_columns(f"{panel(robot)}/full", [], full.partition([len(frames)])),
        Chunk.from_columns(f"{panel(robot)}/legend", [], legend.partition([len(entries)])),
    ]


def _filled(bar: Bar, values: Floats) -> Floats:
    parts: Floats = np.vectorize(bar.filled, otypes=[np.float64])(values)
    return parts


def _bars(values: Floats, feet: Floats, colour: tuple[int, int, int], scale: float = 1.0) -> Any:
    """Return filled bars on their feet (k, 2), of values from -1 to 1 (n, k), as columns.

    rerun fills no boxes: a bar is one line up and down beside itself, without a gap.
    """
    n, k = values.shape
    line, bar = scale * _LINE, scale * _BAR
    rise = np.sign(values) * np.maximum(np.abs(values) * bar - 2 * line, 0)
    tops = np.stack((np.sign(values) * line, np.sign(values) * line + rise), axis=-1)  # y is downwards
    strips = np.empty((n, k, 2 * len(_LINES), 2), np.float32)
    for index, shift in enumerate(scale * _LINES):
        ends = tops if index % 2 == 0 else tops[..., ::-1]
        strips[:, :, 2 * index : 2 * index + 2, 0] = feet[:, 0, None] + shift
        strips[:, :, 2 * index : 2 * index + 2, 1] = feet[:, 1, None] - ends
    columns = rr.LineStrips2D.columns(
        strips=strips.reshape(n * k, -1, 2),
        colors=np.where(np.abs(values.reshape(-1, 1)) > 0, (*colour, 255), (*colour, 0)).astype(np.uint8),
        radii=np.full(n * k, line, np.float32),
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
