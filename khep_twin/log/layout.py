"""How rerun arranges a log, or several beside each other: arena, robots from above, curves, transcripts."""

# rerun's types are partly unknown.
# pyright: reportUnknownMemberType=false

import tomllib
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from khep_twin.log.khepbase import panel
from khep_twin.log.reader import Label
from khep_twin.units import Sensor

if TYPE_CHECKING:
    import rerun.blueprint as rrb

Colour = tuple[int, int, int]

TIMELINE = "message_log_time"
"""What rerun calls the simulated time of a log's messages."""

_WARM: list[Colour] = [(228, 87, 46), (242, 159, 5), (244, 211, 94)]
_COLD: list[Colour] = [(64, 224, 208), (77, 171, 247), (92, 124, 250)]
_VIOLET: list[Colour] = [(177, 151, 252), (230, 153, 247)]

_SENSORS = {
    sensor.name.lower().replace("_", " "): colour
    for sensor, colour in zip(Sensor, [*_WARM, *_COLD, *_VIOLET], strict=True)
}
"""Curves of the sensors: left ones warm, right ones cold, those at the back violet."""

_WHEELS: dict[str, Colour] = {
    "left": _WARM[0],
    "right": _COLD[1],
    "left setpoint": (255, 201, 184),
    "right setpoint": (208, 235, 255),
}


@dataclass(frozen=True, slots=True)
class Shown:
    """A log and where in a recording it is.

    Attributes:
        label: what the log says of itself.
        name: to be read above it; empty where it is the only one.
        place: the path below which its entities are, such as "/run"; empty where it is the only one.
        frame: of the arena's coordinates; empty for rerun's own choice, where it is the only one.
        end_ns: where its curves end [ns], beside others; 0 for rerun's own choice.
        last_s: of a run that goes on, so much is in the curves [s]; None for all of it.
    """

    label: Label
    name: str = ""
    place: str = ""
    frame: str = ""
    end_ns: int = 0
    last_s: float | None = None


def layout(shown: Sequence[Shown]) -> "rrb.Blueprint":
    """One log's parts around each other, or several logs in a column each, from left to right."""
    import rerun.blueprint as rrb

    following = any(log.last_s is not None for log in shown)
    return rrb.Blueprint(
        _alone(shown[0]) if len(shown) == 1 else rrb.Horizontal(*map(_column, shown)),
        rrb.TimePanel(timeline=TIMELINE, state="collapsed", play_state="following" if following else None),
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
    )


def _alone(log: Shown) -> "rrb.Container":
    import rerun.blueprint as rrb

    arena, bases, transcripts = _arena(log), _bases(log), _transcripts(log)
    below = rrb.Horizontal(*([rrb.Tabs(*bases)] if bases else []), rrb.Tabs(*transcripts))
    return rrb.Horizontal(
        rrb.Vertical(*arena, below, row_shares=[2, 1] if arena else [1]), rrb.Tabs(*_curves(log))
    )


def _column(log: Shown) -> "rrb.Container":
    """A log among others: what is beside each other is alike."""
    import rerun.blueprint as rrb

    arena = _arena(log)
    rest = rrb.Tabs(*_curves(log), *_bases(log), *_transcripts(log))
    return rrb.Vertical(*arena, rest, row_shares=[2, 3] if arena else [1], name=log.name)


def _arena(log: Shown) -> "list[rrb.Spatial3DView]":
    """None for a real robot: nobody knows where it was."""
    import rerun as rr
    import rerun.blueprint as rrb

    if "playpen.toml" not in log.label.attachments:
        return []
    frame = rrb.archetypes.SpatialInformation(target_frame=log.frame) if log.frame else None
    return [
        rrb.Spatial3DView(
            origin=log.place or "/",
            name=log.name or "arena",
            contents=[
                f"{log.place}/**",
                *(f"- {log.place}{panel(robot)}/**" for robot in log.label.robots),
            ],
            eye_controls=_eye(log.label),
            line_grid=False,
            spatial_information=frame,
            defaults=[
                shape.from_fields(fill_mode="solid")
                for shape in (rr.Boxes3D, rr.Cylinders3D, rr.Ellipsoids3D)
            ],
        )
    ]


def _bases(log: Shown) -> "list[rrb.Spatial2DView]":
    import rerun.blueprint as rrb

    if "playpen.toml" not in log.label.attachments:
        return []
    bounds = rrb.VisualBounds2D(x_range=(-0.045, 0.045), y_range=(-0.055, 0.045))
    return [
        rrb.Spatial2DView(
            origin=f"{log.place}{panel(robot)}", name=f"{robot} from above", visual_bounds=bounds
        )
        for robot in log.label.robots
    ]


def _transcripts(log: Shown) -> "list[rrb.TextLogView]":
    import rerun.blueprint as rrb

    return [
        rrb.TextLogView(
            name=f"{robot}: serial line and events",
            contents=[f"{log.place}/{robot}/serial", f"{log.place}/events"],
            columns=rrb.TextLogColumns(timeline_columns=[TIMELINE], text_log_columns=["body"]),
            format_options=rrb.TextLogFormat(monospace_body=True),
        )
        for robot in log.label.robots
    ]


def _curves(log: Shown) -> "list[rrb.Vertical]":
    import rerun.blueprint as rrb

    return [
        rrb.Vertical(
            _plot(log, f"/{robot}/proximity", "proximity [counts]", _SENSORS),
            _plot(log, f"/{robot}/ambient", "ambient light [counts, low is bright]", _SENSORS),
            _plot(log, f"/{robot}/speed", "wheel speed [pulses/10 ms]", _WHEELS),
            name=robot,
        )
        for robot in log.label.robots
    ]


def _plot(log: Shown, topic: str, name: str, curves: dict[str, Colour]) -> "rrb.TimeSeriesView":
    import rerun as rr
    import rerun.blueprint as rrb

    origin = f"{log.place}{topic}"
    lines = rr.SeriesLines.from_fields(names=list(curves), colors=list(curves.values()))
    axis = None
    if log.end_ns:  # beside other logs the same time is at the same place
        start, end = (rr.TimeRangeBoundary.absolute(nanos=ns) for ns in (0, log.end_ns))
        axis = rrb.archetypes.TimeAxis(view_range=rr.TimeRange(start=start, end=end))
    newest = None
    if log.last_s is not None:
        ago = rr.TimeRangeBoundary.cursor_relative(seconds=-log.last_s)
        newest = rrb.VisibleTimeRange(TIMELINE, start=ago, end=rr.TimeRangeBoundary.cursor_relative())
    return rrb.TimeSeriesView(
        origin=origin, name=name, axis_x=axis, time_ranges=newest, overrides={origin: lines}
    )


def _eye(label: Label) -> "rrb.EyeControls3D":
    """Looks at the arena's middle from before and above, from as far as its size asks."""
    import rerun.blueprint as rrb

    arena = tomllib.loads(label.attachments["playpen.toml"])["arena"]
    width, depth = arena["width_mm"] / 1000, arena["height_mm"] / 1000
    reach = max(width, depth)
    return rrb.EyeControls3D(
        position=(width / 2, depth / 2 - 0.75 * reach, 0.85 * reach),
        look_target=(width / 2, depth / 2, 0.0),
        eye_up=(0.0, 0.0, 1.0),
    )
