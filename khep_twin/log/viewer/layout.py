"""Layout of one or several logs in rerun: arena, robots from above, curves, transcripts."""

# rerun's types are partly unknown.
# pyright: reportUnknownMemberType=false

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import rerun as rr
import rerun.blueprint as rrb

from khep_twin.log.attached import bodies_of, playpen_of
from khep_twin.log.reader import Label
from khep_twin.log.shadow_channels import ALARMS, STATE, is_shadow
from khep_twin.log.viewer.arena import EVENTS, trail
from khep_twin.log.viewer.collected import TIMELINE
from khep_twin.log.viewer.ghost import FAULTS, RECKONED, RESIDUALS, TRUTH
from khep_twin.log.viewer.khepera4 import CURVES
from khep_twin.log.viewer.robot_panel import PanelPlaces, panel, seeing, strip
from khep_twin.sensing.colours import COLD, OF_SENSORS, SENSORS, WHEELS, Colour
from khep_twin.units import BODIES, Body

_SETPOINT: Colour = (235, 235, 235)
_WHEELS: dict[str, Colour] = {**WHEELS, "setpoint left": _SETPOINT, "setpoint right": _SETPOINT}
_EVENT: Colour = (255, 80, 160)

_RANGES = {FAULTS: (-5.0, 105.0), "ultrasonic": (0.0, 260.0)}
"""Fixed ranges of plots; ultrasonic readings without a distance lie beyond."""

_SOLID = [shape.from_fields(fill_mode="solid") for shape in (rr.Boxes3D, rr.Cylinders3D, rr.Ellipsoids3D)]

_LEGEND_SHARE, _END_SHARE = 0.16, 0.02
"""Parts of the time axis before the start, where the legend covers no curve, and after the end."""


@dataclass(frozen=True, slots=True)
class Shown:
    """A log and its path in a recording.

    Attributes:
        label: Label of the log.
        name: Title above it; empty for a single log.
        place: Path below which its entities are, such as "/run"; empty for a single log.
        frame: Frame of the arena's coordinates; empty for rerun's default, for a single log.
        end_ns: End of its curves [ns]; for several logs, the end of the longest.
        last_s: Length of the curves of an unfinished run [s]; None for all of it.
    """

    label: Label
    name: str = ""
    place: str = ""
    frame: str = ""
    end_ns: int = 0
    last_s: float | None = None


def layout(shown: Sequence[Shown]) -> rrb.Blueprint:
    """Return the layout: the views of one log around each other, or a column for each of several logs."""
    following = any(log.last_s is not None for log in shown)
    return rrb.Blueprint(
        _alone(shown[0]) if len(shown) == 1 else rrb.Horizontal(*map(_column, shown)),
        rrb.TimePanel(timeline=TIMELINE, state="collapsed", play_state="following" if following else None),
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
    )


def _alone(log: Shown) -> rrb.Container:
    arena = _arena(log)
    below = rrb.Horizontal(
        *(rrb.Tabs(*views) for views in (_bases(log), _strips(log), _transcripts(log)) if views)
    )
    return rrb.Horizontal(
        rrb.Vertical(*arena, below, row_shares=[2, 1] if arena else [1]), rrb.Tabs(*_curves(log))
    )


def _column(log: Shown) -> rrb.Container:
    """Return the column of one log of several, with the same views in the same rows."""
    arena = _arena(log)
    rest = rrb.Tabs(*_curves(log), *_bases(log), *_strips(log), *_transcripts(log))
    return rrb.Vertical(*arena, rest, row_shares=[2, 3] if arena else [1], name=log.name)


def _arena(log: Shown) -> list[rrb.Spatial3DView]:
    """Return the arena's view; none for a real robot, whose position is unknown."""
    if "playpen.toml" not in log.label.attachments:
        return []
    until_now = rrb.VisibleTimeRanges(
        timeline=TIMELINE,
        start=rr.TimeRangeBoundary.infinite(),
        end=rr.TimeRangeBoundary.cursor_relative(),
    )
    paths = (*log.label.robots, *((RECKONED, TRUTH) if is_shadow(log.label) else ()))
    growing = [f"{log.place}{each}" for each in (EVENTS, *map(trail, paths))]
    frame = rrb.archetypes.SpatialInformation(target_frame=log.frame) if log.frame else None
    return [
        rrb.Spatial3DView(
            origin=log.place or "/",
            name=log.name or "arena",
            contents=[
                f"{log.place}/**",
                *(f"- {log.place}{panel(robot)}/**" for robot in log.label.robots),
                *(f"- {log.place}/{robot}/vision/**" for robot in log.label.robots),
                *(f"- {log.place}{strip(robot)}/**" for robot in log.label.robots),
            ],
            overrides={place: until_now for place in growing},
            eye_controls=_eye(log.label),
            line_grid=False,
            spatial_information=frame,
            defaults=_SOLID,
        )
    ]


def _strips(log: Shown) -> list[rrb.View]:
    """Return the line images of the robots that see, over time."""
    return [
        rrb.Spatial2DView(origin=f"{log.place}{strip(robot)}", name=f"{robot}: line image")
        for robot in seeing(log.label)
    ]


def _bases(log: Shown) -> Sequence[rrb.View]:
    if "playpen.toml" not in log.label.attachments:
        return []
    if is_shadow(log.label):
        return [_near(log)]
    return [
        rrb.Spatial2DView(
            origin=f"{log.place}{panel(robot)}",
            name=f"{robot} from above",
            visual_bounds=rrb.VisualBounds2D(x_range=bounds[0], y_range=bounds[1]),
        )
        for robot, body in _bodies(log).items()
        for bounds in (PanelPlaces(body).bounds,)
    ]


def _bodies(log: Shown) -> dict[str, Body]:
    return bodies_of(log.label.attachments, log.label.robots, "log")


def _near(log: Shown) -> rrb.Spatial3DView:
    """Return the surroundings of a shadow's estimate from above, ahead of it upwards."""
    frame = f"{log.name}/" if log.frame else ""
    return rrb.Spatial3DView(
        origin=log.place or "/",
        name="around the estimate",
        contents=[f"{log.place}/**", f"- {log.place}{EVENTS}"],
        eye_controls=rrb.EyeControls3D(
            position=(0.0, 0.0, 0.22), look_target=(0.0, 0.0, 0.0), eye_up=(1.0, 0.0, 0.0)
        ),
        line_grid=False,
        spatial_information=rrb.archetypes.SpatialInformation(
            target_frame=f"{frame}{log.label.robots[0]}/base"
        ),
        defaults=_SOLID,
    )


def _transcripts(log: Shown) -> list[rrb.TextLogView]:
    return [
        rrb.TextLogView(
            name="states, alarms and events" if is_shadow(log.label) else f"{robot}: serial line and events",
            contents=[f"{log.place}{each}" for each in (f"/{robot}/serial", STATE, ALARMS, "/events")],
            columns=rrb.TextLogColumns(timeline_columns=[TIMELINE], text_log_columns=["body"]),
            format_options=rrb.TextLogFormat(monospace_body=True),
        )
        for robot in log.label.robots
    ]


def _curves(log: Shown) -> list[rrb.Vertical]:
    if is_shadow(log.label):
        return _residuals(log, log.label.robots[0])
    views: list[rrb.Vertical] = []
    for robot, body in _bodies(log).items():
        sensors = {name: OF_SENSORS[name] for name in body.sensors}
        base = rrb.Vertical(
            _plot(log, robot, "proximity", "proximity [counts]", sensors),
            _plot(log, robot, "ambient", "ambient light [counts, low is bright]", sensors),
            *(
                _plot(log, robot, "speed", f"{side} wheel [pulses/10 ms]", _WHEELS, side)
                for side in ("left", "right")
            ),
            name=robot,
            row_shares=[3, 3, 2, 2],
        )
        views.append(base)
        if body is BODIES["khepera4"]:
            more = (_plot(log, robot, topic, *told) for topic, told in CURVES.items())
            views.append(rrb.Vertical(*more, name=f"{robot}: further sensors"))
    return views


def _residuals(log: Shown, robot: str) -> list[rrb.Vertical]:
    """Return the curves of a shadow: suspected faults, deviations of the replies, what they deviate from."""
    names = (
        "proximity: measured less expected [counts]",
        "light: measured less expected [counts]",
        "wheels: pulses beyond the expected ones",
        "timing: delay of replies [ms]",
    )
    curves = SENSORS, SENSORS, WHEELS, {"delay": COLD[1]}
    plots = [_plot(log, robot, FAULTS, "suspected faults: probability [%]")]
    plots += [_plot(log, robot, *each) for each in zip(RESIDUALS, names, curves, strict=True)]
    proximity = [
        _plot(log, "shadow", name, f"{name} proximity [counts]", SENSORS) for name in ("measured", "expected")
    ]
    return [
        rrb.Vertical(*plots, name="residuals", row_shares=[2, 3, 2, 2, 2]),
        rrb.Vertical(*proximity, name="proximity"),
    ]


def _plot(
    log: Shown, robot: str, topic: str, name: str, curves: Mapping[str, Colour] | None = None, only: str = ""
) -> rrb.TimeSeriesView:
    """Return a plot of a channel, or of those of its curves that have `only` in their name.

    Curves that are not given are those of the entities below the channel's.
    """
    origin = f"{log.place}/{robot}/{topic}"
    events = f"{log.place}/{log.label.robots[0] if is_shadow(log.label) else robot}/events"
    lines = rr.SeriesLines.from_fields(
        names=list(curves or ()),
        colors=list((curves or {}).values()),
        # The speed of a wheel is a band, its setpoint a thin white line on it.
        widths=[4.0 if topic == "speed" and curve in ("left", "right") else 1.0 for curve in curves or ()],
        visible_series=[only in curve for curve in curves or ()],
    )
    marks = rr.SeriesPoints.from_fields(
        names=["event"], colors=[_EVENT], markers=["diamond"], marker_sizes=[5.0]
    )
    if log.last_s is None:
        whole = int(-_LEGEND_SHARE * log.end_ns), int((1 + _END_SHARE) * log.end_ns)
        start, end = (rr.TimeRangeBoundary.absolute(nanos=ns) for ns in whole)
        newest = None
    else:
        start = rr.TimeRangeBoundary.cursor_relative(seconds=-log.last_s * (1 + _LEGEND_SHARE))
        end = rr.TimeRangeBoundary.cursor_relative()
        ago = rr.TimeRangeBoundary.cursor_relative(seconds=-log.last_s)
        newest = rrb.VisibleTimeRange(TIMELINE, start=ago, end=end)
    return rrb.TimeSeriesView(
        origin=origin,
        contents=[origin if curves else f"{origin}/**", events],
        name=name,
        axis_x=rrb.archetypes.TimeAxis(view_range=rr.TimeRange(start=start, end=end)),
        axis_y=rrb.ScalarAxis(range=_RANGES[topic]) if topic in _RANGES else None,
        plot_legend=rrb.PlotLegend(rrb.Corner2D.LeftTop),
        time_ranges=newest,
        overrides={events: marks, **({origin: lines} if curves else {})},
    )


def _eye(label: Label) -> rrb.EyeControls3D:
    """Return a view of the arena's middle from before and above, at a distance that fits its size."""
    arena = playpen_of(label.attachments, "log").arena
    width, depth = arena.width_mm / 1000, arena.height_mm / 1000
    reach = max(width, depth)
    return rrb.EyeControls3D(
        position=(width / 2, depth / 2 - 0.75 * reach, 0.85 * reach),
        look_target=(width / 2, depth / 2, 0.0),
        eye_up=(0.0, 0.0, 1.0),
    )
