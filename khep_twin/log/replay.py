"""Looking at a log in rerun: the arena, the curves and the transcript side by side, on one time axis.

rerun reads a log by itself. What is added here is a layout made for this robot, and time as seconds of the
run instead of dates in 1970; both go into a rerun recording, which is kept or shown.
"""

# rerun's types are partly unknown.
# pyright: reportUnknownMemberType=false

import os
import subprocess
import sys
import tempfile
import tomllib
from pathlib import Path
from typing import TYPE_CHECKING

from khep_twin.errors import LogError
from khep_twin.files import put_whole
from khep_twin.log.khepbase import Gatherer, panel, send_fans, send_panel
from khep_twin.log.reader import Label, read_label
from khep_twin.log.still import still
from khep_twin.units import Sensor

if TYPE_CHECKING:
    import rerun.blueprint as rrb

Colour = tuple[int, int, int]

_TIMELINE = "message_log_time"
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


def view(path: Path, save: Path | None = None) -> None:
    """Shows a log in rerun's viewer until its window is closed, or saves it as a rerun recording.

    Args:
        path: of a finished log.
        save: of the recording, by custom NAME.rrd; None opens the viewer.

    Raises:
        LogError: the log cannot be read, the recording cannot be written, or no window opens.
    """
    label = read_label(path)
    if save is not None:
        _save(path, label, save)
        return
    if sys.platform == "linux" and not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
        raise LogError(f"{path}: there is no screen to open a window on; {_wish(path)}")
    with tempfile.TemporaryDirectory(prefix="khep-twin-") as folder:
        recording = Path(folder) / f"{path.stem}.rrd"
        _save(path, label, recording)
        _show(path, recording)


def view_still(path: Path, target: Path, at_s: float) -> None:
    """Writes what the viewer shows of a log at a time, as PNG, without a screen.

    Args:
        path: of a finished log.
        target: the PNG file.
        at_s: simulated time [s].

    Raises:
        LogError: the log cannot be read, or the viewer cannot be had.
    """
    label = read_label(path)
    with tempfile.TemporaryDirectory(prefix="khep-twin-") as folder:
        recording = Path(folder) / f"{path.stem}.rrd"
        _save(path, label, recording)
        still(recording, _TIMELINE, at_s, target)


def _save(path: Path, label: Label, save: Path) -> None:
    if save.is_dir() or (save.exists() and save.samefile(path)):
        what = "a directory" if save.is_dir() else "the log itself"
        raise LogError(f"{save}: this is {what}; right is the name of a file, such as {path.stem}.rrd")
    recording = _recording(path, label)
    try:
        put_whole(save, recording)
    except OSError as error:
        raise LogError(f"{save}: the recording cannot be written: {error.strerror}") from error


def _recording(path: Path, label: Label) -> bytes:
    """The log and its layout as rerun has them in a file.

    Made in memory, because rerun itself may wait for ever for a disk that is full.
    """
    import rerun as rr
    from rerun.chunk import McapReader

    with rr.RecordingStream("khep_twin", recording_id=path.stem) as recording:
        stream = recording.binary_stream()
        recording.send_blueprint(_layout(label))
        recording.send_recording_name(path.stem)
        gatherer = Gatherer()
        chunks = McapReader(path, timeline_type="duration_ns").stream()
        rr.send_chunks(gatherer.passing(chunks, _TIMELINE), recording=recording)
        for robot in label.robots:
            if (samples := gatherer.samples(robot)) is not None:
                send_panel(recording, robot, samples, _TIMELINE)
            text = label.attachments.get(f"calibration/{robot}.toml")
            if text is not None:
                send_fans(recording, robot, tuple(tomllib.loads(text)["heading_deg"]))
        # Read once: each reading ends the file.
        return stream.read() or b""


def _layout(label: Label) -> "rrb.Blueprint":
    import rerun as rr
    import rerun.blueprint as rrb

    # Of a real robot nobody knows where it was.
    known = "playpen.toml" in label.attachments
    solid = [shape.from_fields(fill_mode="solid") for shape in (rr.Boxes3D, rr.Cylinders3D, rr.Ellipsoids3D)]
    shown = ["/**", *(f"- {panel(robot)}/**" for robot in label.robots)]
    arena = [
        rrb.Spatial3DView(
            name="arena", contents=shown, eye_controls=_eye(label), line_grid=False, defaults=solid
        )
        for _ in range(known)
    ]
    transcripts = [
        rrb.TextLogView(
            name=f"{robot}: serial line and events",
            contents=[f"/{robot}/serial", "/events"],
            columns=rrb.TextLogColumns(timeline_columns=[_TIMELINE], text_log_columns=["body"]),
            format_options=rrb.TextLogFormat(monospace_body=True),
        )
        for robot in label.robots
    ]
    bases = [
        rrb.Spatial2DView(
            origin=panel(robot),
            name=f"{robot} from above",
            visual_bounds=rrb.VisualBounds2D(x_range=(-0.045, 0.045), y_range=(-0.055, 0.045)),
        )
        for robot in label.robots
        for _ in range(known)
    ]
    curves = [
        rrb.Vertical(
            _plot(f"/{robot}/proximity", "proximity [counts]", _SENSORS),
            _plot(f"/{robot}/ambient", "ambient light [counts, low is bright]", _SENSORS),
            _plot(f"/{robot}/speed", "wheel speed [pulses/10 ms]", _WHEELS),
            name=robot,
        )
        for robot in label.robots
    ]
    return rrb.Blueprint(
        rrb.Horizontal(
            rrb.Vertical(
                *arena,
                rrb.Horizontal(*(rrb.Tabs(*bases) for _ in range(known)), rrb.Tabs(*transcripts)),
                row_shares=[2, 1] if known else [1],
            ),
            rrb.Tabs(*curves),
        ),
        rrb.TimePanel(timeline=_TIMELINE, state="collapsed"),
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
    )


def _plot(origin: str, name: str, curves: dict[str, Colour]) -> "rrb.TimeSeriesView":
    import rerun as rr
    import rerun.blueprint as rrb

    lines = rr.SeriesLines.from_fields(names=list(curves), colors=list(curves.values()))
    return rrb.TimeSeriesView(origin=origin, name=name, overrides={origin: lines})


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


def _show(path: Path, recording: Path) -> None:
    # The viewer takes recordings from the network too; nobody but this machine shall send it any.
    command = [sys.executable, "-m", "rerun", str(recording), "--bind", "127.0.0.1", "--port", "auto"]
    done = subprocess.run(command, stderr=subprocess.PIPE, text=True, check=False)
    if done.returncode:
        reason = done.stderr.strip().splitlines()[-1:] or [f"code {done.returncode}"]
        raise LogError(f"{path}: rerun's viewer failed: {reason[0].removeprefix('Error: ')}; {_wish(path)}")


def _wish(path: Path) -> str:
    return f"right here is to save a recording, --save {path.stem}.rrd, and to open that where there is one"
