"""The toolbox's khepbase as a panel of rerun: the robot from above, with bars for what it senses and does.

At each sensor a pair of bars, proximity (0 to 1023) and depth of the light below 500 counts; beside each
wheel a bar of its speed (0 to 20 pulses/10 ms, downwards when it drives backwards). And in the arena, where
the sensors look: a fan of lines at each of them.
"""

# rerun's types are partly unknown.
# pyright: reportUnknownMemberType=false, reportUnknownVariableType=false, reportUnknownArgumentType=false

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from khep_twin.units import BODIES, COUNTS_LIMIT, WHEEL_BASE, WHEEL_RADIUS

if TYPE_CHECKING:
    import rerun as rr
    from rerun.chunk import Chunk

Floats = NDArray[np.float64]

SAMPLES_PER_PICTURE = 5
"""Of the log's samples of 20 ms so many make one picture: ten a second are enough for the eye."""

FAN_LENGTH = 0.045
"""Of the lines that show where a sensor looks [m]: about as far as a wall is seen."""

_BODY = BODIES["khepera1"]
_BAR = 0.012
"""Of a bar at its full value [m]."""

_HALF_WIDTH = 0.0014
_PROXIMITY, _LIGHT, _SPEED = (228, 87, 46), (244, 200, 70), (77, 171, 247)
_OUTLINE = (150, 150, 150)
_DARK_COUNTS, _FASTEST = 500.0, 20.0
_RAYS = 9


@dataclass(frozen=True, slots=True)
class Samples:
    """What the panel shows of one robot.

    Attributes:
        times_ns: of the samples (n,) [ns].
        proximity: counts (n, 8).
        ambient: counts (n, 8).
        speed: left, right and more (n, 2 and more) [pulses/10 ms].
    """

    times_ns: NDArray[np.int64]
    proximity: Floats
    ambient: Floats
    speed: Floats


class Gatherer:
    """Picks samples out of a log while rerun reads it, which is quicker than to read it again."""

    def __init__(self) -> None:
        self._rows: dict[str, list[tuple[NDArray[np.int64], Floats]]] = {}

    def passing(self, chunks: "Iterable[Chunk]", timeline: str) -> "Iterator[Chunk]":
        """Lets the chunks of a log pass on, and notes those with samples."""
        for chunk in chunks:
            if chunk.entity_path.endswith(("/proximity", "/ambient", "/speed")):
                self._note(chunk, timeline)
            yield chunk

    def samples(self, robot: str) -> Samples | None:
        """Those of a robot; None if there are none, or not for each time."""
        parts = [self._rows.get(f"/{robot}/{topic}", []) for topic in ("proximity", "ambient", "speed")]
        if not all(parts):
            return None
        times = [np.concatenate([at for at, _ in part]) for part in parts]
        if not all(np.array_equal(times[0], each) for each in times[1:]):
            return None  # a real robot's, which answers one by one
        return Samples(times[0], *(np.concatenate([values for _, values in part]) for part in parts))

    def _note(self, chunk: "Chunk", timeline: str) -> None:
        batch: Any = chunk.to_record_batch()
        if "Scalars:scalars" not in batch.schema.names:
            return
        column: Any = batch.column(batch.schema.get_field_index("Scalars:scalars"))
        at: NDArray[Any] = batch.column(batch.schema.get_field_index(timeline)).to_numpy(zero_copy_only=False)
        values: Floats = column.flatten().to_numpy(zero_copy_only=False).reshape(len(at), -1)
        self._rows.setdefault(chunk.entity_path, []).append((at.astype(np.int64), values))


def panel(robot: str) -> str:
    """Where in a recording a robot's panel is."""
    return f"/{robot}/khepbase"


def send_panel(recording: "rr.RecordingStream", robot: str, track: Samples, timeline: str) -> None:
    """Adds the panel of one robot to a recording.

    Args:
        recording: of rerun.
        robot: its name.
        track: what was recorded of it.
        timeline: name of the recording's simulated time.
    """
    import rerun as rr

    place = panel(robot)
    recording.log(
        f"{place}/outline", rr.LineStrips2D([_circle(_BODY.radius)], colors=[_OUTLINE]), static=True
    )
    wheels = [_box(side * WHEEL_BASE / 2, 0.0, 0.0015, WHEEL_RADIUS) for side in (-1, 1)]
    nose = np.array([(-0.004, -0.020), (0, -0.0245), (0.004, -0.020)])
    recording.log(f"{place}/parts", rr.LineStrips2D([*wheels, nose], colors=[_OUTLINE] * 3), static=True)
    every = slice(None, None, SAMPLES_PER_PICTURE)
    times = rr.TimeColumn(timeline, duration=track.times_ns[every].astype("timedelta64[ns]"))
    # Pictures have y downwards: ahead is up, left is left.
    feet = np.array([(-left, -forward) for forward, left in _BODY.sensor_positions]) * 1.35
    near = np.clip(track.proximity[every] / COUNTS_LIMIT, 0, 1)
    light = np.clip(1 - track.ambient[every] / _DARK_COUNTS, 0, 1)
    shift = np.array([_HALF_WIDTH * 1.15, 0])
    for name, values, at, colour in (
        ("proximity", near, feet - shift, _PROXIMITY),
        ("light", light, feet + shift, _LIGHT),
    ):
        recording.send_columns(f"{place}/{name}", [times], _bars(rr, values, at, colour))
    beside = np.array([(-WHEEL_BASE / 2 + 0.006, 0.0), (WHEEL_BASE / 2 - 0.006, 0.0)])
    speeds = np.clip(track.speed[every, :2] / _FASTEST, -1, 1)
    recording.send_columns(f"{place}/speed", [times], _bars(rr, speeds, beside, _SPEED))


def send_fans(recording: "rr.RecordingStream", robot: str, headings_deg: tuple[float, ...]) -> None:
    """Adds to a recording where a robot's sensors look, in the arena."""
    import rerun as rr

    strips: list[Floats] = []
    for (x, y), heading_deg in zip(_BODY.sensor_positions, headings_deg, strict=True):
        for ray in range(_RAYS):
            angle = math.radians(heading_deg) - math.atan((ray + 0.5) / _RAYS * 2 - 1)
            start = np.array([x, y, _BODY.sensor_height])
            way = np.array([math.cos(angle), math.sin(angle), 0.0])
            strips.append(np.array([start, start + FAN_LENGTH * way]))
    place = f"/obstacles/{robot}_sensors"
    lines = rr.LineStrips3D(strips, colors=[(*_PROXIMITY, 90)] * len(strips), radii=0.0003)
    recording.log(place, lines, rr.CoordinateFrame(f"{robot}/base"), static=True)


def _bars(rr: Any, values: Floats, feet: Floats, colour: tuple[int, int, int]) -> Any:
    """Bars on their feet (k, 2), of values from -1 to 1 (n, k), as columns."""
    n, k = values.shape
    heights = values * _BAR
    centres = np.empty((n, k, 2))
    centres[..., 0], centres[..., 1] = feet[:, 0], feet[:, 1] - heights / 2
    halves = np.empty((n, k, 2))
    # A bar of nothing stays a line.
    halves[..., 0], halves[..., 1] = _HALF_WIDTH, np.maximum(np.abs(heights) / 2, 2e-4)
    columns = rr.Boxes2D.columns(
        centers=centres.reshape(-1, 2), half_sizes=halves.reshape(-1, 2), colors=np.tile([colour], (n * k, 1))
    )
    return columns.partition([k] * n)


def _circle(radius: float) -> Floats:
    turns = np.linspace(0, 2 * math.pi, 64)
    return radius * np.column_stack([np.cos(turns), np.sin(turns)])


def _box(x: float, y: float, half_width: float, half_height: float) -> Floats:
    corners = np.array([(-1, -1), (1, -1), (1, 1), (-1, 1), (-1, -1)], np.float64)
    return np.array([x, y]) + corners * (half_width, half_height)
