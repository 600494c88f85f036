"""Contents of a report on a run, from its log; the layout is separate.

A report has a map with the paths of all robots, and for each robot statistics, and sensors and wheels over
time. A real robot's log has no ground truth: the report shows the replies to its host, and lists the missing
data.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from khep_twin.board.kernel import LEFT, RIGHT, Wheel
from khep_twin.drawing.paths import DrawnPath
from khep_twin.lab.experiment import run_statistics as statistics
from khep_twin.lab.report.rows import (
    Row,
    collision_rows,
    light_rows,
    motion_rows,
    near_rows,
    slip_rows,
    wire_rows,
)
from khep_twin.log.attached import calibration_of, playpen_of
from khep_twin.log.reader import Recording, TimeSeries
from khep_twin.log.robot_models import models_of
from khep_twin.log.shadow_track import ShadowTrack
from khep_twin.playpen import Playpen
from khep_twin.robots.model import RobotModel
from khep_twin.units import K213_PIXELS

_ENCODERS = [LEFT + Wheel.ENCODER, RIGHT + Wheel.ENCODER]

_UNSET = ("None", "()")


@dataclass(frozen=True, slots=True)
class RobotReport:
    """Part of a report on one robot.

    Attributes:
        name: Name of the robot.
        model: Model of the robot.
        rows: Statistics of the robot.
        missing: Sentence that lists data missing in the log; empty if there are none.
        proximity: Proximity over time [counts], or None.
        ambient: Ambient light over time [counts], or None.
        speed: Speeds left, right, setpoints left, right over time [pulses/10 ms], or None.
        vision: Line images over time, greys of 0 to 255, or None.
        extra: Further sensors of its model over time, by channel.
        dark: Dark level of ambient light [counts].
        contact: Intervals of contact (n, 2) [s].
    """

    name: str
    model: RobotModel
    rows: tuple[Row, ...]
    missing: str
    proximity: TimeSeries | None
    ambient: TimeSeries | None
    speed: TimeSeries | None
    vision: TimeSeries | None
    extra: Mapping[str, TimeSeries]
    dark: float
    contact: statistics.Floats


@dataclass(frozen=True, slots=True)
class Report:
    """Report on a run.

    Attributes:
        title: Title of the page.
        playpen: Playpen of the map; None if the log has none.
        tracks: Paths of the robots.
        robots: Parts on each robot.
        events: Faults and notes: time and robot, and text.
        settings: Versions, seed and other settings.
        shadow: Updates and alarms of a shadow's log, which has no robots; None for other logs.
    """

    title: str
    playpen: Playpen | None
    tracks: tuple[DrawnPath, ...]
    robots: tuple[RobotReport, ...]
    events: tuple[Row, ...]
    settings: tuple[Row, ...]
    shadow: ShadowTrack | None = None


def make_report(recording: Recording, source: str, shadow: ShadowTrack | None = None) -> Report:
    """Return the report on a log.

    Args:
        recording: Log.
        source: Name of the log's file for messages.
        shadow: Contents of a shadow's log; None for other logs.

    Raises:
        LogError: An attachment of the log is invalid.
    """
    metadata = recording.label.metadata
    attachments = recording.label.attachments
    playpen = playpen_of(attachments, source) if "playpen.toml" in attachments else None
    if playpen is not None:
        title = f"{'Run' if shadow is None else 'Shadow'} in the playpen {playpen.name}"
    else:
        title = f"Run of the robot at {metadata['relay']}" if "relay" in metadata else "Run"
    names = recording.label.robots if shadow is None else ()
    poses = {name: _find_series(recording, f"/{name}/pose", 3) for name in names}
    events = recording.lines.get("/events", [])
    tracks = tuple(
        DrawnPath(name, pose.times_ns / 1e9, pose.values[:, :2].astype(np.float64) * 1000)
        for name, pose in poses.items()
        if pose is not None
    )
    return Report(
        title,
        playpen,
        tracks,
        tuple(_robot_report(recording, source, playpen, index, name) for index, name in enumerate(names)),
        tuple((f"{line.time_ns / 1e9:.2f} s, {line.name}", line.text) for line in events),
        tuple((key.replace("_", " "), value) for key, value in metadata.items() if value not in _UNSET),
        shadow,
    )


def _robot_report(
    recording: Recording, source: str, playpen: Playpen | None, index: int, name: str
) -> RobotReport:
    """Return the part of the report on the robot with this index in the playpen and name in the log."""
    model = models_of(recording.label.attachments, [name], recording.series)[name]
    body = model.body
    n_around = len(body.sensor_positions)
    pose = _find_series(recording, f"/{name}/pose", 3)
    proximity, ambient, speed, registers, position = (
        _find_series(recording, f"/{name}/{channel}", len(model.channels.get(channel, ())))
        for channel in ("proximity", "ambient", "speed", "registers", "position")
    )
    counters, columns = (registers, _ENCODERS) if position is None else (position, [0, 1])
    extra = {
        channel: series
        for channel in model.plots
        if (series := _find_series(recording, f"/{name}/{channel}", len(model.channels[channel]))) is not None
    }
    vision = _find_series(recording, f"/{name}/vision", K213_PIXELS)
    lines = recording.lines.get(f"/{name}/serial", [])
    calibration = calibration_of(recording.label.attachments, name, source)
    dark = None if calibration is None else calibration.ambient.dark_counts
    dark_level = float(model.bars["light"].full if dark is None else dark)
    rows: list[Row] = [("Duration", f"{_duration_s(recording):.2f} s")]
    contact = np.zeros((0, 2))
    if pose is not None:
        rows += motion_rows(pose)
        if playpen is not None:
            values = pose.values.astype(np.float64)
            contacts = statistics.collisions(pose.times_ns / 1e9, values, playpen, body.radius)
            contact = contacts.times_s
            rows += collision_rows(contacts)
        if counters is not None and np.array_equal(counters.times_ns, pose.times_ns):
            rows += slip_rows(pose, counters.values[:, columns].astype(np.int64), body)
    if proximity is not None:
        counts = proximity.values[:, :n_around].astype(np.int64)
        rows += near_rows(statistics.near(proximity.times_ns / 1e9, counts, body.near_counts))
    if ambient is not None:
        rows += light_rows(ambient, dark_level, body.sensors, n_around)
    rows += wire_rows(lines, _duration_s(recording), model.dialect.framing)
    channels = {"pose": pose, "proximity": proximity, "ambient light": ambient, "wheel speeds": speed}
    absent = [label for label, series in channels.items() if series is None]
    if playpen is None or pose is None:
        absent += ["collisions"]
    if counters is None:
        absent += ["the wheels' counters and slip"]
    missing = f"Not in this log: {', '.join(absent)}." if absent else ""
    if absent and "relay" in recording.label.metadata:
        missing += " A real robot's log has only replies to its host, at their times."
    if ambient is not None and dark is None:
        missing += f" There is no calibration: the dark level is taken as {dark_level:g} counts."
    texts = tuple(rows), missing.strip()
    return RobotReport(name, model, *texts, proximity, ambient, speed, vision, extra, dark_level, contact)


def _find_series(recording: Recording, topic: str, width: int) -> TimeSeries | None:
    """Return a channel; None if it is missing or has another shape."""
    series = recording.series.get(topic)
    if series is None or series.values.shape[1:] != (width,):
        return None
    is_valid = len(series.values) == len(series.times_ns) and np.isfinite(series.values).all()
    return series if is_valid else None


def _duration_s(recording: Recording) -> float:
    """Return the time of the last message [s]; the run starts at 0."""
    last_ns = [int(series.times_ns[-1]) for series in recording.series.values()]
    last_ns += [lines[-1].time_ns for lines in recording.lines.values() if lines]
    return max(last_ns, default=0) / 1e9
