"""Panels of a robot in rerun: the toolbox's khepbase, and line images.

khepbase shows the robot from above. Each sensor has a pair of bars, proximity (0 to 1023) and ambient light
(0 to 500 counts: long in the dark); each wheel has a bar of its speed (0 to 20 pulses/10 ms, downwards for
backwards), by `khep_twin.robots.bars`. Line images form a strip over time, the newest row at the bottom.
"""

# rerun's types are partly unknown.
# pyright: reportUnknownMemberType=false, reportUnknownVariableType=false, reportUnknownArgumentType=false

import math
from typing import Any

import numpy as np
import rerun as rr
from numpy.typing import NDArray
from rerun.chunk import Chunk

from khep_twin.board.turrets import installed_turrets
from khep_twin.log.attached import playpen_of
from khep_twin.log.reader import Label
from khep_twin.log.viewer.collected import Floats, Samples, time_column
from khep_twin.robots.body import Body
from khep_twin.robots.model import Bar, RobotModel
from khep_twin.units import BODY_RADIUS

SAMPLES_PER_PICTURE = 5
"""Samples of the log, 20 ms apart, per picture: ten pictures per second look continuous."""

_BAR_LENGTH = 0.012
_HALF_WIDTH = 0.0014
_LINE_RADIUS = _HALF_WIDTH / 4
_LINE_OFFSETS = _LINE_RADIUS * np.array((-3, -1, 1, 3))
_FRAME_RADIUS = 0.0001
"""Length of a full bar, half its width, radius and offsets of its lines, and radius of frames [m], for a
Khepera, as all lengths here; for other robots they are multiplied by `PanelGeometry.scale`."""

_PROXIMITY, _LIGHT, _SPEED = (228, 87, 46), (244, 200, 70), (77, 171, 247)
_OUTLINE, _FRAME = (150, 150, 150), (90, 90, 90)
_LEGEND = 0.037
"""Top of the legend, below the robot [m]."""

_GROUND_SPACING = 0.007
"""Distance between the bars of ground sensors [m]."""

ROWS = 100
"""Rows of a strip, one per image."""

ROW_INTERVAL_NS = 100_000_000
"""Time between two rows [ns]: a strip shows ten seconds."""


class PanelGeometry:
    """Geometry of a robot's panel. A bar starts at its foot; those of ground sensors are before the axle.

    Attributes:
        scale: Size relative to a Khepera.
        feet: Feet of the proximity bars (n, 2) [m].
        light_feet: Feet of the light bars (n, 2) [m].
        wheels: Feet of the bars of both wheels (2, 2) [m].
        nose: Positions of the nose's base and tip, forward, outside the row of bars [m].
        bounds: Ranges of the panel's x and y [m].
    """

    def __init__(self, body: Body) -> None:
        self.scale = body.radius / BODY_RADIUS
        # y is downwards in pictures: forward is up, left is left.
        sensor_feet = np.array([(-left, -forward) for forward, left in body.sensor_positions]) * 1.35
        n_ground = len(body.ground_positions)
        places = [_GROUND_SPACING * (index - (n_ground - 1) / 2) for index in range(n_ground)]
        ground_feet = [(x * self.scale, -0.013 * self.scale) for x in places]
        feet = np.vstack([sensor_feet, np.array(ground_feet).reshape(-1, 2)])
        offset = np.array([_HALF_WIDTH * 1.15 * self.scale, 0])
        self.feet = feet - offset
        self.light_feet = feet + offset
        side = body.wheel_base / 2 - 0.006 * self.scale
        self.wheels = np.array([(-side, 0.0), (side, 0.0)])
        self.nose = np.array((-0.0275, -0.032) if ground_feet else (-0.020, -0.0245)) * self.scale
        x, y = 0.045 * self.scale, np.array((-0.052, 0.068)) * self.scale
        self.bounds = (-x, x), (float(y[0]), float(y[1]))


def panel_path(robot: str) -> str:
    """Return the entity path of a robot's panel."""
    return f"/{robot}/khepbase"


def panel_chunks(robot: str, samples: Samples, model: RobotModel) -> list[Chunk]:
    """Return the bars of one robot's panel."""
    path, geometry, bars = panel_path(robot), PanelGeometry(model.body), model.bars
    times = time_column(samples.times_ns)
    return [
        Chunk.from_columns(
            f"{path}/{name}", [times], _bars(_fractions(bars[name], values), feet, colour, geometry.scale)
        )
        for name, values, feet, colour in (
            ("proximity", samples.proximity, geometry.feet, _PROXIMITY),
            ("light", samples.ambient, geometry.light_feet, _LIGHT),
            ("speed", samples.speed[:, :2], geometry.wheels, _SPEED),
        )
    ]


def outline_chunks(robot: str, model: RobotModel) -> list[Chunk]:
    """Return the static parts of one robot's panel."""
    body, geometry = model.body, PanelGeometry(model.body)
    scale, half_width, length = geometry.scale, geometry.scale * _HALF_WIDTH, geometry.scale * _BAR_LENGTH
    wheels = [
        _box(side * body.wheel_base / 2, 0.0, body.wheel_width / 2, body.wheel_radius) for side in (-1, 1)
    ]
    foot, tip = geometry.nose
    nose = np.array([(-0.004 * scale, foot), (0, tip), (0.004 * scale, foot)])
    strips = [_circle(body.radius), *wheels, nose]
    lines = rr.LineStrips2D.columns(strips=strips, colors=[_OUTLINE] * len(strips))
    feet = np.vstack((geometry.feet, geometry.light_feet))
    frames = [_box(x, y - length / 2, half_width, length / 2) for x, y in feet]
    frames += [_box(x, y, half_width, length) for x, y in geometry.wheels]  # both ways
    radii = [_FRAME_RADIUS * scale] * len(frames)
    full = rr.LineStrips2D.columns(strips=frames, colors=[_FRAME] * len(frames), radii=radii)
    entries, bars = {"proximity": _PROXIMITY, "light": _LIGHT, "speed": _SPEED}, model.bars
    legend = rr.Points2D.columns(
        positions=[(0.0, (_LEGEND + 0.0095 * index) * scale) for index in range(len(entries))],
        colors=list(entries.values()),
        labels=[bars[name].legend for name in entries],
        show_labels=[True] * len(entries),
        radii=[0.001 * scale] * len(entries),
    )
    return [
        Chunk.from_columns(f"{panel_path(robot)}/outline", [], lines.partition([len(strips)])),
        Chunk.from_columns(f"{panel_path(robot)}/full", [], full.partition([len(frames)])),
        Chunk.from_columns(f"{panel_path(robot)}/legend", [], legend.partition([len(entries)])),
    ]


def _fractions(bar: Bar, values: Floats) -> Floats:
    """Return the filled fraction of a bar by value, -1 to 1."""
    return np.vectorize(bar.filled_part, otypes=[np.float64])(values)


def _bars(values: Floats, feet: Floats, colour: tuple[int, int, int], scale: float = 1.0) -> Any:
    """Return filled bars at feet (k, 2) [m], for values from -1 to 1 (n, k), as columns.

    rerun does not fill 2-D boxes: a bar is one line that runs up and down several times without a gap.
    """
    n, k = values.shape
    line, bar = scale * _LINE_RADIUS, scale * _BAR_LENGTH
    rise = np.sign(values) * np.maximum(np.abs(values) * bar - 2 * line, 0)
    tops = np.stack((np.sign(values) * line, np.sign(values) * line + rise), axis=-1)  # y is downwards
    strips = np.empty((n, k, 2 * len(_LINE_OFFSETS), 2), np.float32)
    for index, shift in enumerate(scale * _LINE_OFFSETS):
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
    angles = np.linspace(0, 2 * math.pi, 64)
    return radius * np.column_stack([np.cos(angles), np.sin(angles)])


def _box(x: float, y: float, half_width: float, half_height: float) -> Floats:
    corners = np.array([(-1, -1), (1, -1), (1, 1), (-1, 1), (-1, -1)], np.float64)
    return np.array([x, y]) + corners * (half_width, half_height)


def strip_path(robot: str) -> str:
    """Return the entity path of a robot's strip."""
    return f"/{robot}/vision_strip"


def robots_with_images(label: Label) -> list[str]:
    """Return the robots of a log that have a turret with line images; none without a playpen."""
    if "playpen.toml" not in label.attachments:
        return []
    kinds = installed_turrets()
    robots = zip(label.robots, playpen_of(label.attachments, "log").robots, strict=False)
    return [
        name for name, robot in robots if any(kinds[kind].image for kind in robot.turrets if kind in kinds)
    ]


class Strips:
    """Strips of all robots, with one row per interval [ns]; the log may come in batches."""

    def __init__(self, interval_ns: int = ROW_INTERVAL_NS) -> None:
        self._interval_ns = interval_ns
        self._last_rows: dict[str, tuple[int, Floats]] = {}

    def chunks(self, robot: str, times_ns: NDArray[np.int64], images: Floats) -> list[Chunk]:
        """Return a picture of the last rows for each new row; `images` are greys of 0 to 255 (n, pixels)."""
        last_interval, previous_rows = self._last_rows.get(robot, (-1, np.zeros((ROWS, images.shape[1]))))
        intervals = times_ns // self._interval_ns
        is_first = np.diff(intervals, prepend=last_interval) > 0
        times_ns, images = times_ns[is_first], images[is_first]
        if not len(times_ns):
            return []
        width = images.shape[1]
        rows = np.concatenate((previous_rows, images)).astype(np.uint8)
        self._last_rows[robot] = int(intervals[-1]), rows[-ROWS:].astype(np.float64)
        pictures = np.lib.stride_tricks.sliding_window_view(rows, ROWS, axis=0)[1:].transpose(0, 2, 1)
        image_format = rr.components.ImageFormat(
            width=width, height=ROWS, color_model=rr.ColorModel.L, channel_datatype=rr.ChannelDatatype.U8
        )
        columns = rr.Image.columns(
            buffer=[picture.tobytes() for picture in pictures], format=[image_format] * len(pictures)
        )
        return [Chunk.from_columns(strip_path(robot), [time_column(times_ns)], columns)]
