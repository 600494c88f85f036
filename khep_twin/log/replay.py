"""Looking at a log in rerun, with a layout made for this robot: arena, sensor curves, wheels and transcript.

rerun reads the log's channels by itself; here it is only told which views to open, and that times are
durations and not dates.
"""

# rerun's types are partly unknown.
# pyright: reportUnknownMemberType=false, reportUnknownVariableType=false

import os
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from khep_twin import playpen, units
from khep_twin.errors import LogError
from khep_twin.log.reader import Run, read
from khep_twin.units import Sensor

if TYPE_CHECKING:
    import rerun.blueprint as rrb

TIMELINE = "message_log_time"
"""What rerun calls the simulated time of a log's messages."""


def view(path: Path, save: Path | None = None) -> None:
    """Opens a log in rerun's viewer, or writes it with its layout as a recording.

    Args:
        path: of the log.
        save: file to write, by custom NAME.rrd; None opens the viewer.

    Raises:
        LogError: the log cannot be read, the file cannot be written, or there is no screen for the viewer.
    """
    run = read(path)
    screen = os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY") or sys.platform != "linux"
    if save is None and not screen:
        raise LogError(f"{path}: no screen to open rerun on; right is to add --save FILE.rrd")
    import rerun as rr
    from rerun.chunk import McapReader

    # By name, so that no date of making gets into the file.
    with rr.RecordingStream("khep_twin", recording_id=path.stem) as recording:
        part = None if save is None else save.with_name(save.name + ".part")
        if part is None:
            rr.spawn(recording=recording, default_blueprint=layout(run))
        else:
            try:
                part.open("wb").close()
            except OSError as error:
                raise LogError(f"{save}: cannot be written: {error.strerror}") from error
            recording.save(part, default_blueprint=layout(run))
        rr.send_chunks(McapReader(path, timeline_type="duration_ns").stream(), recording=recording)
        recording.flush()
        recording.disconnect()
    if part is not None and save is not None:
        os.replace(part, save)


def layout(run: Run) -> "rrb.Blueprint":
    """Which views a log is opened with."""
    import rerun.blueprint as rrb

    robots = list(run.robots)
    size = playpen.parse(run.attachments["playpen.toml"], "playpen.toml").arena
    width, depth = units.metres(size.width_mm), units.metres(size.height_mm)
    # From the side of the lower wall, high enough to look over it.
    away = max(width, depth)
    eye = rrb.EyeControls3D(
        position=(width / 2, depth / 2 - 0.65 * away, 0.9 * away),
        look_target=(width / 2, depth / 2 - 0.05 * away, 0.0),
        eye_up=(0.0, 0.0, 1.0),
    )
    arena = rrb.Spatial3DView(origin="/", name="Playpen", contents=["/**"], eye_controls=eye, line_grid=False)
    transcripts = [rrb.TextLogView(origin=f"/{name}/serial", name=f"{name}: serial line") for name in robots]
    curves = [rrb.Vertical(*_curves(name), name=name) for name in robots]
    return rrb.Blueprint(
        rrb.Horizontal(
            rrb.Vertical(arena, rrb.Tabs(*transcripts), row_shares=[3, 2]),
            rrb.Tabs(*curves),
            column_shares=[1, 1],
        ),
        rrb.TimePanel(timeline=TIMELINE, state="collapsed"),
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
    )


def _curves(name: str) -> "list[rrb.TimeSeriesView]":
    import rerun as rr
    import rerun.blueprint as rrb

    sensors = [sensor.name.lower().replace("_", " ") for sensor in Sensor]
    wheels = ["left", "right", "left setpoint", "right setpoint"]
    series = {
        "proximity": (
            "Proximity [counts]",
            sensors,
            True,
        ),
        # The same sensors in the same colours: one legend does for both.
        "ambient": (
            "Ambient light [counts, low is bright]",
            sensors,
            False,
        ),
        "speed": ("Wheel speed [pulses/10 ms]", wheels, True),
        "duty": ("Motor duty [-255 to 255]", wheels[:2], False),
    }
    return [
        rrb.TimeSeriesView(
            origin=f"/{name}/{topic}",
            name=title,
            overrides={
                f"/{name}/{topic}": rr.SeriesLines(
                    names=labels, colors=_COLOURS[: len(labels)], widths=[1.5] * len(labels)
                )
            },
            plot_legend=rrb.PlotLegend(rrb.Corner2D.RightTop, visible=legend),
        )
        for topic, (title, labels, legend) in series.items()
    ]


# Left and right in cold and warm colours, the two at the back in greys.
_COLOURS = [
    [66, 133, 244],
    [0, 188, 212],
    [105, 220, 160],
    [255, 214, 90],
    [255, 145, 60],
    [235, 70, 70],
    [200, 200, 200],
    [130, 130, 130],
]
