"""The toolbox's khepbase as a panel of rerun: the robot from above, with bars for what it senses and does.

At each sensor a pair of bars, proximity (0 to 1023) and ambient light (0 to 500, as counted: long in the
dark); beside each wheel a bar of its speed (0 to 20 pulses/10 ms, downwards when it drives backwards), by
`khep_twin.sensor_bars`. And in the arena, where the sensors look: a fan of lines at each of them.
"""

# rerun's types are partly unknown.
# pyright: reportUnknownMemberType=false, reportUnknownVariableType=false, reportUnknownArgumentType=false

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from khep_twin.sensor_bars import BARS
from khep_twin.units import BODIES, WHEEL_BASE, WHEEL_RADIUS

if TYPE_CHECKING:
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


def panel_chunks(
    robot: str, track: Samples, timeline: str, every: int = SAMPLES_PER_PICTURE
) -> "list[Chunk]":
    """The bars of one robot's panel.

    Args:
        robot: its name.
        track: what was recorded of it.
        timeline: name of the recording's simulated time.
        every: so many samples make one picture.
    """
    import rerun as rr
    from rerun.chunk import Chunk

    place, some = panel(robot), slice(None, None, every)
    times = rr.TimeColumn(timeline, duration=track.times_ns[some].astype("timedelta64[ns]"))
    # Pictures have y downwards: ahead is up, left is left.
    feet = np.array([(-left, -forward) for forward, left in _BODY.sensor_positions]) * 1.35
    shift = np.array([_HALF_WIDTH * 1.15, 0])
    beside = np.array([(-WHEEL_BASE / 2 + 0.006, 0.0), (WHEEL_BASE / 2 - 0.006, 0.0)])
    return [
        Chunk.from_columns(f"{place}/{name}", [times], _bars(rr, _filled(name, values), at, colour))
        for name, values, at, colour in (
            ("proximity", track.proximity[some], feet - shift, _PROXIMITY),
            ("light", track.ambient[some], feet + shift, _LIGHT),
            ("speed", track.speed[some, :2], beside, _SPEED),
        )
    ]


def outline_chunks(robot: str) -> "list[Chunk]":
    """What of one robot's panel stands still."""
    import rerun as rr

    wheels = [_box(side * WHEEL_BASE / 2, 0.0, 0.0015, WHEEL_RADIUS) for side in (-1, 1)]
    nose = np.array([(-0.004, -0.020), (0, -0.0245), (0.004, -0.020)])
    strips = [_circle(_BODY.radius), *wheels, nose]
    lines = rr.LineStrips2D.columns(strips=strips, colors=[_OUTLINE] * len(strips))
    return [_standing(f"{panel(robot)}/outline", lines.partition([len(strips)]))]


def fan_chunks(robot: str, headings_deg: tuple[float, ...]) -> "list[Chunk]":
    """Where a robot's sensors look, in the arena."""
    import rerun as rr

    strips: list[Floats] = []
    for (x, y), heading_deg in zip(_BODY.sensor_positions, headings_deg, strict=True):
        for ray in range(_RAYS):
            angle = math.radians(heading_deg) - math.atan((ray + 0.5) / _RAYS * 2 - 1)
            start = np.array([x, y, _BODY.sensor_height])
            way = np.array([math.cos(angle), math.sin(angle), 0.0])
            strips.append(np.array([start, start + FAN_LENGTH * way]))
    n = len(strips)
    lines = rr.LineStrips3D.columns(strips=strips, colors=[(*_PROXIMITY, 90)] * n, radii=[0.0003] * n)
    frame = rr.CoordinateFrame.columns(frame=[f"{robot}/base"])
    return [_standing(f"/obstacles/{robot}_sensors", [*lines.partition([n]), *frame])]


def _filled(name: str, values: Floats) -> Floats:
    parts: Floats = np.vectorize(BARS[name].filled, otypes=[np.float64])(values)
    return parts


def _standing(place: str, columns: Any) -> "Chunk":
    """Something that is there at all times."""
    from rerun.chunk import Chunk

    return Chunk.from_columns(place, [], columns)


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
