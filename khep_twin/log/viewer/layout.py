"""Layout of one or several logs in rerun: arena, robots from above, curves, transcripts."""

# rerun's types are partly unknown.
# pyright: reportUnknownMemberType=false

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import rerun as rr
import rerun.blueprint as rrb

from khep_twin.log.attached import playpen_of
from khep_twin.log.channels import BASE_FRAME
from khep_twin.log.reader import Label
from khep_twin.log.robot_models import models_of
from khep_twin.log.shadow_channels import ALARMS, RESIDUALS, STATE, is_shadow
from khep_twin.log.viewer.arena import EVENT_PATH, trail_path
from khep_twin.log.viewer.collected import TIMELINE
from khep_twin.log.viewer.further_sensors import curves_of
from khep_twin.log.viewer.ghost import FAULT_PATH, RECKONED, TRUTH
from khep_twin.log.viewer.robot_panel import PanelGeometry, panel_path, robots_with_images, strip_path
from khep_twin.robots.model import RobotModel
from khep_twin.sensing.colours import COLD, WHEELS, Colour, sensor_colours

_SETPOINT: Colour = (235, 235, 235)
_WHEELS: dict[str, Colour] = {**WHEELS, "setpoint left": _SETPOINT, "setpoint right": _SETPOINT}
_EVENT: Colour = (255, 80, 160)
_Curves = Mapping[str, Colour]

_SUSPICION_RANGE = -5.0, 105.0
_SONAR_MARGIN = 1.04
"""Range of an ultrasonic plot, in longest distances; readings without a distance are outside."""

_SOLID = [shape.from_fields(fill_mode="solid") for shape in (rr.Boxes3D, rr.Cylinders3D, rr.Ellipsoids3D)]

_LEGEND_SHARE, _END_SHARE = 0.16, 0.02
"""Margins of the time axis, as fractions of the run: before the start, for the legend, and after the end."""


@dataclass(frozen=True, slots=True)
class ShownLog:
    """A log and its path in a recording.

    Attributes:
        label: Label of the log.
        name: Title; empty for a single log.
        path: Root path of its entities, e.g. "/run"; empty for a single log.
        frame: Frame of the arena's coordinates; empty for rerun's default, for a single log.
        end_ns: End of the curves [ns]; for several logs, the end of the longest.
        last_s: Length of the curves of an unfinished run [s]; None for all of it.
    """

    label: Label
    name: str = ""
    path: str = ""
    frame: str = ""
    end_ns: int = 0
    last_s: float | None = None


def layout(logs: Sequence[ShownLog]) -> rrb.Blueprint:
    """Return the layout: a grid of views for one log, or a column for each of several logs."""
    is_live = any(log.last_s is not None for log in logs)
    return rrb.Blueprint(
        _single_log(logs[0]) if len(logs) == 1 else rrb.Horizontal(*map(_column, logs)),
        rrb.TimePanel(timeline=TIMELINE, state="collapsed", play_state="following" if is_live else None),
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
    )


def _single_log(log: ShownLog) -> rrb.Container:
    arena = _arena_views(log)
    below = rrb.Horizontal(
        *(rrb.Tabs(*views) for views in (_panel_views(log), _image_views(log), _text_views(log)) if views)
    )
    return rrb.Horizontal(
        rrb.Vertical(*arena, below, row_shares=[2, 1] if arena else [1]), rrb.Tabs(*_curve_views(log))
    )


def _column(log: ShownLog) -> rrb.Container:
    """Return the column of one log of several, with the same rows for each log."""
    arena = _arena_views(log)
    rest = rrb.Tabs(*_curve_views(log), *_panel_views(log), *_image_views(log), *_text_views(log))
    return rrb.Vertical(*arena, rest, row_shares=[2, 3] if arena else [1], name=log.name)


def _arena_views(log: ShownLog) -> list[rrb.Spatial3DView]:
    """Return the arena view; none for a real robot, whose position is unknown."""
    if "playpen.toml" not in log.label.attachments:
        return []
    past = rrb.VisibleTimeRanges(
        timeline=TIMELINE, start=rr.TimeRangeBoundary.infinite(), end=rr.TimeRangeBoundary.cursor_relative()
    )
    paths = (*log.label.robots, *((RECKONED, TRUTH) if is_shadow(log.label) else ()))
    growing_paths = [f"{log.path}{path}" for path in (EVENT_PATH, *map(trail_path, paths))]
    frame = rrb.archetypes.SpatialInformation(target_frame=log.frame) if log.frame else None
    return [
        rrb.Spatial3DView(
            origin=log.path or "/",
            name=log.name or "arena",
            contents=[
                f"{log.path}/**",
                *(f"- {log.path}{panel_path(robot)}/**" for robot in log.label.robots),
                *(f"- {log.path}/{robot}/vision/**" for robot in log.label.robots),
                *(f"- {log.path}{strip_path(robot)}/**" for robot in log.label.robots),
            ],
            overrides={path: past for path in growing_paths},
            eye_controls=_eye_controls(log.label),
            line_grid=False,
            spatial_information=frame,
            defaults=_SOLID,
        )
    ]


def _image_views(log: ShownLog) -> list[rrb.View]:
    """Return the views of line images over time."""
    return [
        rrb.Spatial2DView(origin=f"{log.path}{strip_path(robot)}", name=f"{robot}: line image")
        for robot in robots_with_images(log.label)
    ]


def _panel_views(log: ShownLog) -> Sequence[rrb.View]:
    if "playpen.toml" not in log.label.attachments:
        return []
    if is_shadow(log.label):
        return [_surroundings(log)]
    return [
        rrb.Spatial2DView(
            origin=f"{log.path}{panel_path(robot)}",
            name=f"{robot} from above",
            visual_bounds=rrb.VisualBounds2D(x_range=bounds[0], y_range=bounds[1]),
        )
        for robot, model in _models(log).items()
        for bounds in (PanelGeometry(model.body).bounds,)
    ]


def _models(log: ShownLog) -> dict[str, RobotModel]:
    return models_of(log.label.attachments, log.label.robots)


def _surroundings(log: ShownLog) -> rrb.Spatial3DView:
    """Return the surroundings of a shadow's estimate from above, with its heading upwards."""
    frame = f"{log.name}/" if log.frame else ""
    return rrb.Spatial3DView(
        origin=log.path or "/",
        name="around the estimate",
        contents=[f"{log.path}/**", f"- {log.path}{EVENT_PATH}"],
        eye_controls=rrb.EyeControls3D(
            position=(0.0, 0.0, 0.22), look_target=(0.0, 0.0, 0.0), eye_up=(1.0, 0.0, 0.0)
        ),
        line_grid=False,
        spatial_information=rrb.archetypes.SpatialInformation(
            target_frame=f"{frame}{BASE_FRAME.format(log.label.robots[0])}"
        ),
        defaults=_SOLID,
    )


def _text_views(log: ShownLog) -> list[rrb.TextLogView]:
    return [
        rrb.TextLogView(
            name="states, alarms and events" if is_shadow(log.label) else f"{robot}: serial line and events",
            contents=[f"{log.path}{topic}" for topic in (f"/{robot}/serial", STATE, ALARMS, "/events")],
            columns=rrb.TextLogColumns(timeline_columns=[TIMELINE], text_log_columns=["body"]),
            format_options=rrb.TextLogFormat(monospace_body=True),
        )
        for robot in log.label.robots
    ]


def _curve_views(log: ShownLog) -> list[rrb.Vertical]:
    if is_shadow(log.label):
        return _residual_views(log, log.label.robots[0])
    views: list[rrb.Vertical] = []
    for robot, model in _models(log).items():
        sensors = sensor_colours(model.body)
        base = rrb.Vertical(
            _plot(log, robot, "proximity", "proximity [counts]", sensors),
            _plot(log, robot, "ambient", "ambient light [counts, low is bright]", sensors),
            *(
                _plot(log, robot, "speed", f"{side} wheel [{model.channels['speed'][0][1]}]", _WHEELS, side)
                for side in ("left", "right")
            ),
            name=robot,
            row_shares=[3, 3, 2, 2],
        )
        views.append(base)
        if model.plots:
            plots = (
                _plot(
                    log, robot, channel, title, curves_of(model, channel), y_range=_range_of(model, channel)
                )
                for channel, title in model.plots.items()
            )
            views.append(rrb.Vertical(*plots, name=f"{robot}: further sensors"))
    return views


def _range_of(model: RobotModel, channel: str) -> tuple[float, float] | None:
    """Return the fixed range of a plot of a channel; None without."""
    ends = [term.high for term in model.terms if term.name == channel == "ultrasonic"]
    return (0.0, _SONAR_MARGIN * ends[0]) if ends else None


def _residual_views(log: ShownLog, robot: str) -> list[rrb.Vertical]:
    """Return the curves of a shadow: suspected faults, residuals, and measured and expected proximity."""
    titles = (
        "proximity: measured less expected [counts]",
        "light: measured less expected [counts]",
        "wheels: pulses beyond the expected ones",
        "timing: delay of replies [ms]",
    )
    body = _models(log)[robot].body
    sensors = {name: sensor_colours(body)[name] for name in body.ring_sensors}
    curves = sensors, sensors, WHEELS, {"delay": COLD[1]}
    plots = [_plot(log, robot, FAULT_PATH, "suspected faults: probability [%]", y_range=_SUSPICION_RANGE)]
    names = [f"residual_{kind}" for kind in RESIDUALS]
    plots += [_plot(log, robot, *arguments) for arguments in zip(names, titles, curves, strict=True)]
    proximity = [
        _plot(log, "shadow", name, f"{name} proximity [counts]", sensors) for name in ("measured", "expected")
    ]
    return [
        rrb.Vertical(*plots, name="residuals", row_shares=[2, 3, 2, 2, 2]),
        rrb.Vertical(*proximity, name="proximity"),
    ]


def _plot(
    log: ShownLog,
    robot: str,
    topic: str,
    title: str,
    curves: _Curves | None = None,
    side: str = "",
    y_range: tuple[float, float] | None = None,
) -> rrb.TimeSeriesView:
    """Return a plot of a channel's curves with `side` in the name; by default of the entities below."""
    origin = f"{log.path}/{robot}/{topic}"
    events = f"{log.path}/{log.label.robots[0] if is_shadow(log.label) else robot}/events"
    lines = rr.SeriesLines.from_fields(
        names=list(curves or ()),
        colors=list((curves or {}).values()),
        # The speed of a wheel is a band, its setpoint a thin white line on it.
        widths=[4.0 if topic == "speed" and curve in ("left", "right") else 1.0 for curve in curves or ()],
        visible_series=[side in curve for curve in curves or ()],
    )
    marks = rr.SeriesPoints.from_fields(
        names=["event"], colors=[_EVENT], markers=["diamond"], marker_sizes=[5.0]
    )
    if log.last_s is None:
        bounds_ns = int(-_LEGEND_SHARE * log.end_ns), int((1 + _END_SHARE) * log.end_ns)
        start, end = (rr.TimeRangeBoundary.absolute(nanos=ns) for ns in bounds_ns)
        time_ranges = None
    else:
        start = rr.TimeRangeBoundary.cursor_relative(seconds=-log.last_s * (1 + _LEGEND_SHARE))
        end = rr.TimeRangeBoundary.cursor_relative()
        oldest = rr.TimeRangeBoundary.cursor_relative(seconds=-log.last_s)
        time_ranges = rrb.VisibleTimeRange(TIMELINE, start=oldest, end=end)
    return rrb.TimeSeriesView(
        origin=origin,
        contents=[origin if curves else f"{origin}/**", events],
        name=title,
        axis_x=rrb.archetypes.TimeAxis(view_range=rr.TimeRange(start=start, end=end)),
        axis_y=rrb.ScalarAxis(range=y_range) if y_range else None,
        plot_legend=rrb.PlotLegend(rrb.Corner2D.LeftTop),
        time_ranges=time_ranges,
        overrides={events: marks, **({origin: lines} if curves else {})},
    )


def _eye_controls(label: Label) -> rrb.EyeControls3D:
    """Return a view of the arena's centre from the front and above, at a distance that fits its size."""
    arena = playpen_of(label.attachments, "log").arena
    width, depth = arena.width_mm / 1000, arena.height_mm / 1000
    size = max(width, depth)
    return rrb.EyeControls3D(
        position=(width / 2, depth / 2 - 0.75 * size, 0.85 * size),
        look_target=(width / 2, depth / 2, 0.0),
        eye_up=(0.0, 0.0, 1.0),
    )
