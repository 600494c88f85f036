"""Recordings of a log in rerun, with and without our layout, by its readers and not by pictures."""

import os
import shutil
import stat
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from forked import run_python
from log_contents import chunks_of
from PIL import Image
from rerun.chunk import Chunk, McapReader
from scenes import arena, robot, table
from typer.testing import CliRunner

from khep_twin.cli.app import app
from khep_twin.errors import LogError
from khep_twin.log.reader import read_end_ns
from khep_twin.log.run_names import distinct_names
from khep_twin.log.viewer import replay, robot_panel
from khep_twin.log.viewer.arena import RAY_LIMIT
from khep_twin.log.viewer.replay import view, view_still
from khep_twin.ports.twin import TwinOptions, open_twin


def components(chunks: list[Chunk]) -> set[tuple[str, str]]:
    """Return entity and component of all data."""
    components: set[tuple[str, str]] = set()
    for chunk in chunks:
        names = [str(field.name) for field in chunk.to_record_batch().schema]
        components |= {(chunk.entity_path, name) for name in names if ":" in name}
    return components


EXPECTED = {
    ("/obstacles/visual_geometries/map/floor", "Boxes3D:half_sizes"),
    ("/obstacles/visual_geometries/map/wall_left", "Boxes3D:half_sizes"),
    ("/obstacles/visual_geometries/map/wall_top", "Boxes3D:half_sizes"),
    (r"/obstacles/visual_geometries/khepera0\/base_link/khepera0\/base", "Cylinders3D:radii"),
    ("/tf", "Transform3D:translation"),
    ("/tf", "Transform3D:quaternion"),
    ("/tf", "Transform3D:child_frame"),
    ("/khepera0/proximity", "Scalars:scalars"),
    ("/khepera0/ambient", "Scalars:scalars"),
    ("/khepera0/speed", "Scalars:scalars"),
    ("/khepera0/duty", "Scalars:scalars"),
    ("/khepera0/serial", "TextLog:text"),
    ("/events", "TextLog:text"),
}


def test_rerun_reads_a_log_by_itself(log: Path) -> None:
    assert components(list(McapReader(log).stream())) >= EXPECTED


def test_rerun_names_the_curves_of_a_log_by_itself(log: Path) -> None:
    chunks = [chunk for chunk in McapReader(log).stream() if chunk.entity_path == "/channel_names"]
    (text,) = (
        chunk.to_record_batch()["TextDocument:text"].to_pylist()[0][0]
        for chunk in chunks
        if ("/channel_names", "TextDocument:text") in components([chunk])
    )
    assert "\nproximity, ambient [counts]\n  [0]  left 90\n" in text
    assert "\n  [7]  back left\n\nspeed [pulses/10 ms]\n" in text
    assert "\n  [2]  setpoint left\n" in text


def test_the_boards_whole_state_opens_no_plot(log: Path) -> None:
    entities = components(list(McapReader(log).stream()))
    assert ("/khepera0/registers", "Scalars:scalars") not in entities


def test_the_scene_for_foxglove_draws_nothing_twice(log: Path) -> None:
    names = {name for entity, name in components(list(McapReader(log).stream())) if entity == "/scene"}
    assert {name for name in names if not name.startswith("Mcap")} == {
        "foxglove_msgs.msg.SceneUpdate:message"
    }


def test_a_saved_recording_holds_the_log_and_a_layout(log: Path, tmp_path: Path) -> None:
    view([log], tmp_path / "run.rrd")
    assert components(chunks_of(tmp_path / "run.rrd")) >= EXPECTED
    views = components(chunks_of(tmp_path / "run.rrd", blueprint=True))
    assert sum(name == "ViewBlueprint:class_identifier" for _, name in views) == 7
    assert os.listdir(tmp_path) == ["run.rrd"]


def test_a_saved_recording_counts_seconds_of_the_run(log: Path, tmp_path: Path) -> None:
    view([log], tmp_path / "run.rrd")
    types = {
        str(field.type)
        for chunk in chunks_of(tmp_path / "run.rrd")
        for field in chunk.to_record_batch().schema
        if field.name == "message_log_time"
    }
    assert types == {"duration[ns]"}


@pytest.mark.parametrize(
    ("save", "reason"),
    [
        ("no/run.rrd", "cannot be written: No such file or directory"),
        (".", "this is a directory"),
    ],
)
def test_a_recording_that_cannot_be_saved_is_one_line(
    log: Path, tmp_path: Path, save: str, reason: str
) -> None:
    with pytest.raises(LogError, match=reason):
        view([log], tmp_path / save)
    assert os.listdir(tmp_path) == []


def test_the_log_itself_is_not_overwritten(log: Path) -> None:
    before = log.read_bytes()
    with pytest.raises(LogError, match="this is the log itself"):
        view([log], log)
    assert log.read_bytes() == before


@pytest.mark.parametrize("size", [0, 30_000, pytest.param(100_000, marks=pytest.mark.long)])
def test_a_recording_that_fills_the_disk_is_an_error(log: Path, tmp_path: Path, size: int) -> None:
    program = (
        "import resource, sys; from pathlib import Path; from khep_twin.log.viewer.replay import view\n"
        "resource.setrlimit(resource.RLIMIT_FSIZE, (int(sys.argv[3]),) * 2)\n"
        "view([Path(sys.argv[1])], Path(sys.argv[2]))\n"
    )
    process = run_python([sys.executable, "-c", program, log, tmp_path / "run.rrd", size], timeout=30)
    assert "LogError: " in process.stderr.splitlines()[-1]
    reason = "File too large" if size else "No usable temporary directory found"
    assert f"run.rrd: the recording cannot be written: {reason}" in process.stderr.splitlines()[-1]
    assert os.listdir(tmp_path) == []


def test_without_a_screen_the_way_out_is_named(log: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr(sys, "platform", "linux")
    with pytest.raises(LogError, match=r"no screen .* --web, .* --save run\.rrd"):
        view([log])


@pytest.fixture
def viewer(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return a stand-in for rerun's viewer, which records its arguments."""
    noted, program = tmp_path / "noted", tmp_path / "viewer"
    program.write_text(f'#!/bin/sh\nls "$1" > {noted}\necho "$@" >> {noted}\n')
    program.chmod(program.stat().st_mode | stat.S_IXUSR)
    monkeypatch.setenv("RERUN_CLI_PATH", str(program))
    monkeypatch.setenv("DISPLAY", ":0")
    return noted


def test_the_viewer_listens_to_this_machine_only(log: Path, viewer: Path) -> None:
    view([log])
    recording, arguments = viewer.read_text().splitlines()
    assert recording.endswith("/run.rrd")
    assert "--bind 127.0.0.1" in arguments
    assert not Path(recording).exists()


def test_a_viewer_that_fails_is_one_line(log: Path, viewer: Path) -> None:
    (viewer.parent / "viewer").write_text("#!/bin/sh\necho 'Error: no screen' >&2\nexit 1\n")
    with pytest.raises(LogError, match=r"run\.mcap: rerun's viewer failed: no screen; .*--save run\.rrd"):
        view([log])


def test_a_recording_has_khepbase_and_what_the_sensors_look_at(log: Path, tmp_path: Path) -> None:
    view([log], tmp_path / "run.rrd")
    entities = components(chunks_of(tmp_path / "run.rrd"))
    assert {
        ("/khepera0/khepbase/outline", "LineStrips2D:strips"),
        ("/khepera0/khepbase/full", "LineStrips2D:strips"),
        ("/khepera0/khepbase/legend", "Points2D:labels"),
        ("/khepera0/khepbase/proximity", "LineStrips2D:strips"),
        ("/khepera0/khepbase/light", "LineStrips2D:strips"),
        ("/khepera0/khepbase/speed", "LineStrips2D:strips"),
        ("/obstacles/khepera0_sensors", "LineStrips3D:strips"),
        ("/obstacles/khepera0_sensors", "CoordinateFrame:frame"),
    } <= entities


def test_bars_are_filled_and_as_long_as_what_they_tell() -> None:
    values = np.array([[0.0, 0.5], [1.0, -1.0]])
    columns = {
        str(bar.component_descriptor()): bar.as_arrow_array()
        for bar in robot_panel._bars(values, np.zeros((2, 2)), (1, 2, 3))
    }
    (strips,) = (column for name, column in columns.items() if "strips" in name)
    points = np.array(strips.flatten().to_pylist())  # of each bar eight corners
    radius = robot_panel._LINE_RADIUS
    tall = points[..., 1].max(axis=1) - points[..., 1].min(axis=1) + 2 * radius
    np.testing.assert_allclose(tall, [2 * radius, 0.006, 0.012, 0.012], rtol=1e-5)
    wide = points[..., 0].max(axis=1) - points[..., 0].min(axis=1) + 2 * radius
    np.testing.assert_allclose(wide, 2 * robot_panel._HALF_WIDTH, rtol=1e-5)
    lines = np.unique(np.round(points[1, :, 0] / radius))
    assert np.diff(lines).tolist() == [2, 2, 2]  # no gap between them
    (colours,) = (column for name, column in columns.items() if "colors" in name)
    assert [colour & 0xFF for colour in colours.flatten().to_pylist()] == [0, 255, 255, 255]


def rows(recording: Path, entity: str, component: str) -> list[tuple[int, list[Any]]]:
    """Time [ns] and values of each row of an entity's component, in order of time."""
    series: list[tuple[int, list[Any]]] = []
    for chunk in chunks_of(recording):
        batch = chunk.to_record_batch()
        if chunk.entity_path == entity and component in batch.schema.names:
            at = (
                batch["message_log_time"]
                if "message_log_time" in batch.schema.names
                else [None] * batch.num_rows
            )
            times = [0 if time is None else time.value for time in at]
            series += zip(times, batch[component].to_pylist(), strict=True)
    return sorted(series, key=lambda row: row[0])


@pytest.fixture
def at_a_wall(tmp_path: Path) -> Path:
    """A recording of a robot that looks at a wall 20 mm away, with no other object near, and drives at it."""
    lamps = table("lamp", x_mm=100, y_mm=100, power_w=4)
    lamps += table("lamp", x_mm=100, y_mm=400, power_w=4, on_s=[[0, 0.5]])
    (tmp_path / "wall.toml").write_text(arena() + lamps + robot(552.5, 250))
    options = TwinOptions(noise=False, log=str(tmp_path / "wall.mcap"))
    with open_twin(tmp_path / "wall.toml", options) as twin:
        twin.robot.send(b"D,5,5\n")
        twin.advance_to(300_000_000)
        twin.world.log_event(0, "a note")
        twin.advance_to(1_000_000_000)
    view([tmp_path / "wall.mcap"], tmp_path / "wall.rrd")
    return tmp_path / "wall.rrd"


def test_curves_show_the_whole_run_and_the_legend_stands_before_it(at_a_wall: Path) -> None:
    ranges: list[tuple[int, int]] = []
    for chunk in chunks_of(at_a_wall, blueprint=True):
        batch = chunk.to_record_batch()
        if "TimeAxis:view_range" in batch.schema.names:
            ((view_range,),) = batch["TimeAxis:view_range"].to_pylist()
            ranges.append((view_range["start"], view_range["end"]))
    assert ranges == [(-160_000_000, 1_020_000_000)] * 4


def test_rays_are_as_long_as_what_they_see_and_coloured_by_the_reading(at_a_wall: Path) -> None:
    strips = rows(at_a_wall, "/obstacles/khepera0_sensors", "LineStrips3D:strips")
    colours = rows(at_a_wall, "/obstacles/khepera0_sensors", "LineStrips3D:colors")
    assert len(strips) == 11  # ten a second
    first = np.array(strips[0][1]).reshape(8, -1, 2, 3)
    lengths = np.linalg.norm(first[:, :, 1] - first[:, :, 0], axis=-1)
    # Left 10 and right 10 have their middle ray to the wall, 22.5 mm ahead; the back ones see nothing.
    np.testing.assert_allclose(lengths[2:4, 2], 0.0225 / np.cos(np.radians(8)), rtol=0.03)
    np.testing.assert_allclose(lengths[6:], RAY_LIMIT, rtol=1e-5)
    red, green = (
        (np.array(row[1]).reshape(8, -1) >> shift) & 0xFF for row in colours[:1] for shift in (24, 16)
    )
    assert (red[2] > green[2]).any()
    assert (red[6] == green[6]).all()


def test_the_trail_grows_from_pose_to_pose_without_a_gap(at_a_wall: Path) -> None:
    trails = rows(at_a_wall, "/trails/khepera0", "LineStrips3D:strips")
    strips = np.array([row[0] for _, row in trails])
    np.testing.assert_array_equal(strips[1:, 0], strips[:-1, 1])
    assert strips[0, 0, :2] == pytest.approx((0.5525, 0.25), abs=1e-4)
    assert strips[-1, 1, 0] > 0.56


def test_events_are_marked_where_the_robot_was_and_in_the_curves(at_a_wall: Path) -> None:
    labels = rows(at_a_wall, "/event_marks", "Points3D:labels")
    assert [(time_ns, row[0]) for time_ns, row in labels if "note" in row[0]] == [
        (300_000_000, "[khepera0] a note")
    ]
    marks = rows(at_a_wall, "/khepera0/events", "Scalars:scalars")
    assert (300_000_000, [0.0]) in marks


def test_the_floor_is_lit_by_the_lamps_that_are_on(at_a_wall: Path) -> None:
    one, other = (rows(at_a_wall, f"/light/{number}", "InstancePoses3D:scales") for number in range(2))
    assert [scale[0][0] for _, scale in one] == [1, 0]
    assert [scale[0][0] for _, scale in other] == [0, 1]
    assert one[1][0] == pytest.approx(500_000_000, abs=20_000_000)


def test_a_still_shows_the_end_of_the_run_unless_a_time_is_given(
    log: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    intervals: list[float] = []
    monkeypatch.setattr(replay, "write_still", lambda recording, at_s, *_: intervals.append(at_s))
    assert CliRunner().invoke(app, ["view", str(log), "--png", str(tmp_path / "a.png")]).exit_code == 0
    assert (
        CliRunner().invoke(app, ["view", str(log), "--png", str(tmp_path / "a.png"), "--at", "0"]).exit_code
        == 0
    )
    assert intervals == [2.0, 0.0]


def test_a_still_that_cannot_be_drawn_is_one_line(
    log: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("VK_ICD_FILENAMES", "VK_DRIVER_FILES"):
        monkeypatch.setenv(name, str(tmp_path / "nothing.json"))
    with pytest.raises(LogError, match=r"still\.png: rerun's viewer cannot draw here: .*mesa-vulkan-drivers"):
        view_still([log], tmp_path / "still.png")
    assert not (tmp_path / "still.png").exists()


def test_a_still_is_a_picture_of_the_viewer(log: Path, tmp_path: Path) -> None:
    target = tmp_path / "still.png"
    try:
        view_still([log], target, 1.0)
    except LogError as error:
        if "cannot draw here" in str(error):
            pytest.skip(str(error))
        raise
    picture = Image.open(target)
    assert picture.size[0] > 1000
    assert len(picture.convert("RGB").getcolors(maxcolors=1 << 24) or []) > 50


@pytest.fixture
def twins(log: Path, tmp_path: Path) -> list[Path]:
    """Two logs of one name in different folders."""
    paths = [tmp_path / "first" / "run.mcap", tmp_path / "second" / "run.mcap"]
    for path in paths:
        path.parent.mkdir()
        shutil.copy(log, path)
    return paths


def test_logs_side_by_side_keep_apart(twins: list[Path], tmp_path: Path) -> None:
    view(twins, tmp_path / "both.rrd")
    chunks = chunks_of(tmp_path / "both.rrd")
    entities = components(chunks)
    for place in (r"/first\/run", r"/second\/run"):
        assert {(place + entity, name) for entity, name in EXPECTED} <= entities
        assert (f"{place}/khepera0/khepbase/proximity", "LineStrips2D:strips") in entities
    frames = {
        (chunk.entity_path.split("/run")[0][1:-1], frame.split("/")[0])
        for chunk in chunks
        for batch in [chunk.to_record_batch()]
        for name in ("CoordinateFrame:frame", "Transform3D:child_frame", "Transform3D:parent_frame")
        if name in batch.schema.names
        for row in batch[name].to_pylist()
        for frame in row
    }
    assert frames == {("first", "first"), ("second", "second")}
    views = components(chunks_of(tmp_path / "both.rrd", blueprint=True))
    assert sum(name == "ViewBlueprint:class_identifier" for _, name in views) == 14


def test_logs_are_called_by_what_distinguishes_them() -> None:
    names = distinct_names([Path("a/run.mcap"), Path("b/run.mcap"), Path("c/other.mcap"), Path("a/run.mcap")])
    assert names == ["a/run 1", "b/run", "other", "a/run 2"]


def test_a_log_among_others_is_not_overwritten(twins: list[Path]) -> None:
    with pytest.raises(LogError, match="this is the log itself"):
        view(twins, twins[1])


def test_the_end_of_a_log_is_known_without_reading_it_all(log: Path) -> None:
    assert read_end_ns(log) == 2_000_000_000
