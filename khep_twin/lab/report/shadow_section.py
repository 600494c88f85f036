"""Section of a report on a shadow's log: the estimated path, residuals and alarms."""

# matplotlib's own annotations leave keyword arguments open.
# pyright: reportUnknownMemberType=false

import math
import re
from collections.abc import Callable, Iterator
from textwrap import fill

import matplotlib.style
import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import EllipseCollection
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Circle
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

from khep_twin.drawing import map as drawing
from khep_twin.drawing.map import POINT_LIMIT, STYLE
from khep_twin.drawing.symbols import INK, Look
from khep_twin.lab.experiment.run_statistics import Floats
from khep_twin.lab.report.figure import axes_edges, sensor_height, sensor_panels, style_time_axes, thin_curve
from khep_twin.lab.report.rows import Row
from khep_twin.log.shadow_channels import REGION_SIGMAS, STATE_COLOURS, PoseState
from khep_twin.log.shadow_track import ShadowTrack
from khep_twin.playpen import Playpen

Draw = Callable[[Figure, ShadowTrack, tuple[float, float]], None]
"""Function that draws a picture in a figure; the corner is the lower left [inch]."""

DEFINITIONS: tuple[Row, ...] = (
    ("Spread", "standard deviation of the estimate, in x and y together, and of the heading"),
    ("Dead reckoning", "pose by the commands alone, of the calibration's robot from the playpen's start"),
    (
        "Residuals",
        "measured less expected: counts of proximity and light; pulses of the wheels beyond those that "
        "commands make, since H was asked last; time of a reply beyond that of its bytes",
    ),
    ("Sureness", "probability of the fault, among all that were considered, when the alarm began"),
    (
        "States",
        "followed: the pose is known, and its region holds it; unsure: known to less, or contradicted by "
        "replies; lost: searched for, where dots of the map are poses that it may have had",
    ),
    ("Suspected", "faults that explain the replies better than a sound robot does, too little for an alarm"),
)

_STATES_HEIGHT, _WHEELS_HEIGHT = 2.6, 4.6
"""Heights of the pictures [inch]."""

_STATES = {state: f"#{bytes(colour).hex()}" for state, colour in STATE_COLOURS.items()}
_ESTIMATE = _STATES[PoseState.FOLLOWED]
_RECKONED, _RESIDUAL, _ALARM = "#464646", "#2f6fb0", "#c2452d"
_MAX_CURVES = 8
"""Largest number of suspected faults that are drawn, the most probable ones."""
_ELLIPSES, _CLOUDS = 60, 20
"""Largest numbers of ellipses, and of clouds of particles, on a map."""

_SENSOR = re.compile(r"sensor (\d+)")


def rows(track: ShadowTrack) -> Iterator[Row]:
    """Yield the statistics of a shadow as rows."""
    if not len(track.times_ns):
        yield "Updates", "none: no reply had values"
        return
    seconds = track.times_ns[-1] / 1e9
    yield "Duration", f"{seconds:.2f} s"
    yield "Updates", f"{len(track.times_ns)}, {len(track.times_ns) / max(seconds, 1e-9):.1f} a second"
    if track.states:
        times = track.state_times
        yield "States", f"{times}; lost {'once' if times.n_losses == 1 else f'{times.n_losses} times'}"
        highest = _peak_probabilities(track)
        suspects = ", ".join(f"{name} up to {100 * peak:.0f} %" for name, peak in highest[:_MAX_CURVES])
        remainder = f" and {len(highest) - _MAX_CURVES} more" if len(highest) > _MAX_CURVES else ""
        yield "Suspected", f"{suspects}{remainder}" or "nothing"
    position_mm, heading_deg = _spreads(track)
    yield "Spread of the position", _quantiles(position_mm, "mm")
    yield "Spread of the heading", _quantiles(heading_deg, "°")
    error_mm = _reckoning_error_mm(track)
    errors = f"{error_mm[-1]:.0f} mm from the estimate in the end, {error_mm.max():.0f} mm at most"
    yield "Dead reckoning", errors
    for kind in ("proximity", "light"):
        residuals = _known_residuals(track, kind)[1]
        if len(residuals):
            yield f"{kind.title()}, residual", f"{_rms(residuals):.0f} counts rms"
    if len(wheels := _known_residuals(track, "wheels")[1]):
        yield "Wheels, residual", f"{_rms(wheels):.1f} pulses rms"
    yield "Alarms", f"{len(track.alarms)}"


def alarm_rows(track: ShadowTrack) -> list[Row]:
    """Return a row per alarm."""
    return [
        (
            alarm.fault,
            f"since {alarm.since_ns / 1e9:.2f} s, reported at {alarm.raised_ns / 1e9:.2f} s, "
            f"{100 * alarm.sureness:.1f} % sure, in {alarm.channel}; "
            + ("lasts" if alarm.ended_ns is None else f"ended at {alarm.ended_ns / 1e9:.2f} s"),
        )
        for alarm in track.alarms
    ]


def draw_map(playpen: Playpen, track: ShadowTrack) -> Figure:
    """Draw the estimated path with its spread, and dead reckoning."""
    figure = drawing.draw(playpen)
    axes = figure.axes[0]
    limits = axes.axis()
    with matplotlib.style.context(STYLE):
        stride = slice(None, None, -(-len(track.times_ns) // POINT_LIMIT) or 1)
        reckoned, pose = 1000 * track.reckoned[stride], 1000 * track.pose[stride]
        states = _states_at(track, track.times_ns[stride])
        lost = np.array([state is PoseState.LOST for state in states], bool)
        pose[lost] = np.nan
        axes.plot(*reckoned[:, :2].T, color=_RECKONED, lw=0.9, ls=(0, (4, 2)), zorder=4)
        axes.plot(*pose[:, :2].T, color=_ESTIMATE, lw=1.3, zorder=5)
        indices = np.unique(np.linspace(0, max(len(pose) - 1, 0), min(_ELLIPSES, len(pose))).astype(int))
        indices = indices[~lost[indices]]
        sizes, angles_deg = _ellipse_axes(track.covariance[stride][indices])
        colours = [_STATES[states[index]] for index in indices]
        look: Look = {"facecolors": colours, "alpha": 0.2, "zorder": 4}
        # Particles at the times when the robot was lost are its possible poses.
        searching = [state is PoseState.LOST for state in _states_at(track, track.particles_ns)]
        dots = 1000 * track.particles[searching][-_CLOUDS:, :, :2].reshape(-1, 2)
        axes.plot(*dots.T, ".", color=_STATES[PoseState.LOST], ms=1.5, alpha=0.5, zorder=4)
        placement: Look = {"units": "xy", "offsets": pose[indices, :2], "offset_transform": axes.transData}
        axes.add_collection(EllipseCollection(sizes[:, 0], sizes[:, 1], angles_deg, **placement, **look))
        radius_mm = 1000 * playpen.robots[0].body.radius
        for path, colour in ((pose, _ESTIMATE), (reckoned, _RECKONED)):
            if len(path) and not np.isnan(path[-1]).any():
                axes.add_patch(Circle(path[-1, :2].tolist(), radius_mm, fill=False, ec=colour, lw=1, ls="--"))
        axes.axis(limits)
        handles = [
            Line2D([], [], color=_ESTIMATE, lw=1.3, label="estimate, 95 % region"),
            *(
                Line2D([], [], color=_STATES[state], lw=5, alpha=0.4, label=state)
                for state in (PoseState.UNSURE, PoseState.LOST)
                if any(state is entry for _, entry in track.states)
            ),
            Line2D([], [], color=_RECKONED, lw=0.9, ls=(0, (4, 2)), label="dead reckoning"),
        ]
        axes.legend(
            handles=handles, loc="lower right", bbox_to_anchor=(1, 1), fontsize=8, ncols=4, frameon=False
        )
    return figure


def pictures(track: ShadowTrack) -> list[tuple[Draw, float, str]]:
    """Return drawing function, height [inch] and name of each picture."""
    states = [(_draw_states, _STATES_HEIGHT, "States and suspected faults")]
    return [
        *(states if track.states else []),
        (_draw_sensors, sensor_height(track.sensors), "Residuals of the sensors"),
        (_draw_wheels, _WHEELS_HEIGHT, "Residuals of wheels and timing, and spread"),
    ]


def _draw_states(figure: Figure, track: ShadowTrack, corner: tuple[float, float]) -> None:
    """Draw a strip of the states, and below it the probabilities of the suspected faults."""
    grid = axes_edges(figure, corner, _STATES_HEIGHT, left=0.98, right=0.1)
    grid["bottom"] += 0.4 / figure.get_figheight()
    cells = figure.add_gridspec(2, 1, hspace=0.25, height_ratios=[1, 6], **grid)
    strip, curves = (figure.add_subplot(cells[row, 0]) for row in range(2))
    end_s = float(track.times_ns[-1]) / 1e9 if len(track.times_ns) else 1.0
    for axes in (strip, curves):
        style_time_axes(axes)
        axes.set_xlim(0, end_s)
    starts_s = [*(time_ns / 1e9 for time_ns, _ in track.states), end_s]
    for state in PoseState:
        indices = [number for number, (_, entry) in enumerate(track.states) if entry is state]
        spans = [(starts_s[number], starts_s[number + 1] - starts_s[number]) for number in indices]
        strip.broken_barh(spans, (0, 1), color=_STATES[state], alpha=0.6, lw=0, label=state)
    strip.set(yticks=[], ylim=(0, 1))
    strip.tick_params(labelbottom=False)
    strip.set_title("states", fontsize=9, loc="left", color=INK)
    strip_legend: Look = {"loc": "lower right", "bbox_to_anchor": (1, 0.8), "frameon": False}
    strip.legend(ncols=3, fontsize=8, **strip_legend)
    names = [name for name, _ in _peak_probabilities(track)[:_MAX_CURVES]]
    times_s = [time_ns / 1e9 for time_ns, _ in track.suspected]
    for name in names:
        probabilities = [
            100 * sum(fault.probability for fault in suspected if fault.name == name)
            for _, suspected in track.suspected
        ]
        curves.step([*times_s, end_s], [*probabilities, probabilities[-1]], where="post", lw=1, label=name)
    if names:
        curve_legend: Look = {"loc": "upper center", "bbox_to_anchor": (0.45, -0.3), "frameon": False}
        curves.legend(ncols=4, fontsize=7, **curve_legend)
    else:
        curves.text(0.5, 0.5, "nothing", transform=curves.transAxes, ha="center", va="center")
    curves.set_ylim(0, 105)
    curves.set_ylabel("suspected\n[%]", fontsize=8)
    curves.yaxis.set_label_coords(-0.07, 0.5)
    curves.set_xlabel("time [s]", fontsize=8)
    for alarm in track.alarms:
        end_ns = track.times_ns[-1] if alarm.ended_ns is None else alarm.ended_ns
        curves.axvspan(alarm.raised_ns / 1e9, end_ns / 1e9, color=_ALARM, alpha=0.12, lw=0.6, zorder=0)


def _peak_probabilities(track: ShadowTrack) -> list[tuple[str, float]]:
    """Return the suspected faults with their highest probabilities, the most probable first."""
    highest: dict[str, float] = {}
    for _, suspected in track.suspected:
        for fault in suspected:
            highest[fault.name] = max(fault.probability, highest.get(fault.name, 0.0))
    return sorted(highest.items(), key=lambda item: -item[1])


def _states_at(track: ShadowTrack, times_ns: NDArray[np.int64]) -> list[PoseState]:
    """Return the state at each time, "followed" if the log has none."""
    states = [PoseState.FOLLOWED, *(state for _, state in track.states)]
    starts_ns = [time_ns for time_ns, _ in track.states]
    return [states[row] for row in np.searchsorted(starts_ns, times_ns, side="right").tolist()]


def _draw_sensors(figure: Figure, track: ShadowTrack, corner: tuple[float, float]) -> None:
    """Draw the residuals of proximity and light, a strip for each sensor."""
    kinds, names = ("proximity", "light"), [fill(name, 9) for name in track.sensors]
    titles = [f"{kind}: measured less expected [counts]" for kind in kinds]
    columns = sensor_panels(figure, corner, sensor_height(names), titles, -0.16, names)
    for panels, kind in zip(columns, kinds, strict=True):
        times_s, values = _known_residuals(track, kind)
        high = float(np.abs(values).max(initial=1.0))
        for sensor, axes in enumerate(panels):
            _set_time_axis(axes, track)
            axes.set(ylim=(-high, high), yticks=(-round(high), 0, round(high)) if sensor == 0 else [0])
            if len(values):
                axes.plot(*thin_curve(times_s, values[:, sensor]), color=_RESIDUAL, lw=0.7)
                _mark_alarms(axes, track, kind, sensor)
            elif sensor == 3:
                axes.text(0.5, 0.5, "not asked", transform=axes.transAxes, ha="center", va="center")


def _draw_wheels(figure: Figure, track: ShadowTrack, corner: tuple[float, float]) -> None:
    """Draw the residuals of wheels and timing, the spread and dead reckoning."""
    grid = axes_edges(figure, corner, _WHEELS_HEIGHT, left=0.98, right=0.1)
    cells = figure.add_gridspec(4, 1, hspace=0.35, **grid)
    wheels_s, wheels = _known_residuals(track, "wheels")
    timing_s, timing = _known_residuals(track, "timing")
    times_s = track.times_ns / 1e9
    sides = [("left", wheels_s, wheels[:, 0]), ("right", wheels_s, wheels[:, 1])]
    panels: list[tuple[str, str, list[tuple[str, Floats, Floats]]]] = [
        ("beyond commands\n[pulses]", "wheels", sides),
        ("delay of replies\n[ms]", "line", [("", timing_s, 1000 * timing[:, 0])]),
        ("spread of the\nposition [mm]", "", [("", times_s, _spreads(track)[0])]),
        ("dead reckoning\noff by [mm]", "", [("", times_s, _reckoning_error_mm(track))]),
    ]
    for row, (label, channel, curves) in enumerate(panels):
        axes = figure.add_subplot(cells[row, 0])
        style_time_axes(axes)
        _set_time_axis(axes, track)
        for (name, curve_s, values), colour in zip(curves, (_RESIDUAL, "#b8860b"), strict=False):
            axes.plot(*thin_curve(curve_s, values), color=colour, lw=0.8, label=name)
        if not len(curves[0][1]):
            axes.text(0.5, 0.5, "not asked", transform=axes.transAxes, ha="center", va="center")
        elif channel:
            _mark_alarms(axes, track, channel)
        if len(curves) > 1 and len(curves[0][1]):
            axes.legend(loc="lower right", bbox_to_anchor=(1, 0.94), ncols=2, fontsize=8, frameon=False)
        axes.yaxis.set_major_locator(MaxNLocator(3))
        axes.set_ylabel(label, fontsize=8)
        axes.yaxis.set_label_coords(-0.07, 0.5)
        axes.tick_params(labelbottom=row == len(panels) - 1)
    figure.axes[-1].set_xlabel("time [s]", fontsize=8)


def _set_time_axis(axes: Axes, track: ShadowTrack) -> None:
    axes.set_xlim(0, float(track.times_ns[-1]) / 1e9 if len(track.times_ns) else 1.0)
    axes.axhline(0, color=INK, alpha=0.4, lw=0.5, ls=":")


def _mark_alarms(axes: Axes, track: ShadowTrack, channel: str, sensor: int | None = None) -> None:
    """Mark the alarms of a channel; alarms that name a sensor are marked at this sensor only."""
    for alarm in track.alarms:
        match = _SENSOR.search(alarm.fault)
        if alarm.channel == channel and (sensor is None or match is None or int(match[1]) == sensor):
            end_ns = track.times_ns[-1] if alarm.ended_ns is None else alarm.ended_ns
            axes.axvspan(alarm.since_ns / 1e9, end_ns / 1e9, color=_ALARM, alpha=0.18, lw=0.6, zorder=0)


def _known_residuals(track: ShadowTrack, kind: str) -> tuple[Floats, Floats]:
    """Return times [s] and values of the known residuals of a kind."""
    values = track.residuals[kind]
    is_known = ~np.isnan(values).any(axis=1)
    return track.times_ns[is_known] / 1e9, values[is_known]


def _spreads(track: ShadowTrack) -> tuple[Floats, Floats]:
    """Return standard deviations of the position [mm] and the heading [degrees]."""
    variances = np.maximum(np.diagonal(track.covariance, axis1=1, axis2=2), 0)
    return 1000 * np.sqrt(variances[:, :2].sum(axis=1)), np.degrees(np.sqrt(variances[:, 2]))


def _reckoning_error_mm(track: ShadowTrack) -> Floats:
    return 1000 * np.hypot(*(track.reckoned - track.pose)[:, :2].T)


def _ellipse_axes(covariances: Floats) -> tuple[Floats, Floats]:
    """Return widths and heights (n, 2) [mm] and angles [degrees] of 95 % ellipses of positions."""
    if not len(covariances):
        return np.zeros((0, 2)), np.zeros(0)
    values, vectors = np.linalg.eigh(covariances[:, :2, :2])
    turns: NDArray[np.float64] = np.degrees(np.arctan2(vectors[:, 1, 0], vectors[:, 0, 0]))
    return 2000 * REGION_SIGMAS * np.sqrt(np.maximum(values, 0)), turns


def _quantiles(values: Floats, unit: str) -> str:
    median, high = np.quantile(values, (0.5, 0.95)).tolist()
    return f"{median:.1f} {unit} median, {high:.1f} {unit} at 95 %"


def _rms(values: Floats) -> float:
    return math.sqrt(float(np.mean(values * values)))
