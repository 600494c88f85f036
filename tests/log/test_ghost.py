"""Views of a shadow's log: the estimated robot and its particles."""

# rerun's types are partly unknown.
# pyright: reportUnknownMemberType=false, reportUnknownVariableType=false, reportUnknownArgumentType=false

import os
import shutil
from pathlib import Path

import numpy as np
import pytest
import rerun as rr
from log_contents import times_of, values_of
from log_rewriting import rewritten
from nine_sensors import nine_playpen
from shadow_updates import MS, updates, written

from khep_twin.errors import LogError
from khep_twin.log.channels import TextLine, line_message
from khep_twin.log.reader import read_label, read_series
from khep_twin.log.shadow_channels import LINE_TOPICS, STATE_COLOURS, PoseState
from khep_twin.log.shadow_track import read_shadow
from khep_twin.log.tail import GrowingLog
from khep_twin.log.viewer.ghost import Ghost
from khep_twin.log.viewer.live import follow
from khep_twin.log.viewer.replay import view
from khep_twin.playpen import Playpen
from khep_twin.shadow.shadow import ShadowSettings
from khep_twin.shadow.shadow_log import ShadowLog
from khep_twin.shadow.shadow_viewer import ShadowViewer


def times_ms(recording: Path) -> dict[str, list[int]]:
    """Times at which something is shown, by entity [ms]."""
    return {
        entity: [time_ns // MS for time_ns in times_ns] for entity, times_ns in times_of(recording).items()
    }


def test_a_view_of_a_shadow_has_estimate_reckoning_particles_rays_and_residuals(tmp_path: Path) -> None:
    view([written(tmp_path / "shadow.mcap")], tmp_path / "shadow.rrd")
    times = times_ms(tmp_path / "shadow.rrd")
    expected = list(range(0, 3001, 50))
    for name in ("reckoned", "spread", "expected", "measured"):
        assert times[f"/ghost/{name}"] == expected
    assert times["/ghost/particles"] == [0, 1000, 2000, 3000]
    assert times["/trails/khepera0"] == times["/trails/reckoned"] == expected[1:]
    assert "/ghost/truth" not in times
    # Without what was not asked, which would interrupt the curves.
    assert times["/khepera0/residual_proximity"] == expected[::2]
    assert times["/khepera0/residual_wheels"] == expected
    assert "/khepera0/residual_light" not in times
    assert times["/event_marks"] == times["/khepera0/events"] == [1000, 2000]
    assert times["/shadow/state"] == [0, 2000]


def test_a_view_has_a_ray_and_a_residual_for_each_sensor(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    recording = tmp_path / "nine.rrd"
    view([written(tmp_path / "nine.mcap", playpen=nine_playpen(tmp_path, monkeypatch))], recording)
    for place, component in (
        ("/ghost/expected", "LineStrips3D:strips"),
        ("/khepera0/residual_proximity", "Scalars:scalars"),
        ("/shadow/measured", "Scalars:scalars"),
    ):
        assert {len(values) for _, values in values_of(recording, place, component)} == {9}


def test_a_suspected_fault_is_a_curve_and_the_region_has_the_colour_of_the_state(tmp_path: Path) -> None:
    view([written(tmp_path / "shadow.mcap")], tmp_path / "shadow.rrd")
    place = r"/khepera0/suspected/dead\ sensor\ 2\ or\ stuck\ sensor\ 2"
    curves = values_of(tmp_path / "shadow.rrd", place, "Scalars:scalars")
    assert [(time_ns // MS, *value) for time_ns, value in curves] == [(800, 60.0), (1000, 0.0)]
    colours = values_of(tmp_path / "shadow.rrd", "/ghost/spread", "LineStrips3D:colors")
    packed = {state: int.from_bytes(bytes([*colour, 255]), "big") for state, colour in STATE_COLOURS.items()}
    followed, unsure = packed[PoseState.FOLLOWED], packed[PoseState.UNSURE]
    clouds = values_of(tmp_path / "shadow.rrd", "/ghost/particles", "Points3D:colors")
    assert [value for _, (value, *_) in clouds] == [followed] * 2 + [unsure] * 2
    assert [value for _, (value,) in colours] == [followed] * 40 + [unsure] * 21


@pytest.mark.parametrize("topic", LINE_TOPICS[:2])
def test_a_state_or_suspected_faults_that_cannot_be_are_one_line(topic: str, tmp_path: Path) -> None:
    def other(marked_topic: str, time_ns: int, message: bytes) -> bytes:
        return line_message(TextLine(time_ns, 20, "x", "Odd")) if marked_topic == topic else message

    log = rewritten(written(tmp_path / "shadow.mcap"), tmp_path / "x.mcap", other)
    with pytest.raises(LogError, match=rf"{topic} at 0\.\d000 s: \w+ Odd; expected "):
        view([log], tmp_path / "x.rrd")


def test_the_truth_is_shown_if_the_log_that_was_read_lies_beside(log: Path, tmp_path: Path) -> None:
    robot = tmp_path / "run.mcap"
    shutil.copyfile(log, robot)
    shadow = written(tmp_path / "shadow.mcap", robot)
    view([shadow], tmp_path / "shadow.rrd")
    poses = read_series(robot).series["/khepera0/pose"].times_ns // MS
    assert times_ms(tmp_path / "shadow.rrd")["/trails/truth"] == poses[1:].tolist()
    with robot.open("ab") as file:
        file.write(b"another log by now")
    view([shadow], tmp_path / "alone.rrd")
    assert "/trails/truth" not in times_ms(tmp_path / "alone.rrd")


def test_a_ray_ends_where_a_facing_wall_would_give_the_reading(tmp_path: Path) -> None:
    path = written(tmp_path / "shadow.mcap")
    ghost = Ghost(read_label(path), path)
    counts = ghost._gain / (20 + ghost._offset) ** 2 - ghost._threshold  # pyright: ignore[reportPrivateUsage]
    nothing = np.full(8, np.nan)
    near, none, empty = ghost._wall_distances(np.array([counts, np.zeros(8), nothing]))  # pyright: ignore[reportPrivateUsage]
    assert near == pytest.approx(0.02)
    assert (none > 0.03).all()
    assert not empty.any()


def test_a_shadow_is_shown_while_it_goes_on(tmp_path: Path) -> None:
    path = tmp_path / "shadow.mcap"
    log = ShadowLog(path, Playpen.load("obstacles"), ShadowSettings(), flush_ns=500 * MS)
    with GrowingLog(path) as growing:
        for update in updates():
            log.write(update)
        log.close()
        with rr.RecordingStream("khep_twin") as recording:
            recording.save(tmp_path / "live.rrd")
            follow(growing, recording, lambda: False)
    times = times_ms(tmp_path / "live.rrd")
    assert times["/ghost/reckoned"] == list(range(0, 3001, 50))
    assert sorted(times["/shadow/alarms"]) == [1000, 2000]


def test_a_viewer_that_cannot_open_is_told_and_leaves_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    monkeypatch.setattr("tempfile.tempdir", None)
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    with ShadowViewer(Playpen.load("obstacles"), ShadowSettings()) as viewer:
        for update in updates():
            viewer.show(update)
        viewer.wait(lambda: False)
    assert "there is no screen to open a window on" in capfd.readouterr().err
    assert os.listdir(tmp_path) == []


def test_a_viewer_of_a_log_that_is_written_anyway_writes_none(tmp_path: Path) -> None:
    path = written(tmp_path / "shadow.mcap")
    with ShadowViewer(Playpen.load("obstacles"), ShadowSettings(), path) as viewer:
        for update in updates():
            viewer.show(update)
    assert len(read_shadow(path).times_ns) == 61
    assert os.listdir(tmp_path) == ["shadow.mcap"]
