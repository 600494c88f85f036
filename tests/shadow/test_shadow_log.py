"""The log of a shadow: its updates, written and read back."""

import hashlib
import json
import re
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from log_rewriting import rewritten
from nine_sensors import SENSORS, nine_playpen
from shadow_updates import ALARM, MS, SUSPICION, updates, written

from khep_twin import playpen as playpens
from khep_twin.errors import LogError
from khep_twin.log.channels import POSE_WITH_COVARIANCE, Level, TextLine, line_message, pose_message
from khep_twin.log.line_recorder import LineRecorder
from khep_twin.log.log_file import LogFile
from khep_twin.log.reader import read_raw, read_series
from khep_twin.log.recover import recover
from khep_twin.log.shadow_channels import Alarm, PoseState, Suspicion
from khep_twin.log.shadow_track import read_shadow
from khep_twin.playpen import Playpen
from khep_twin.shadow.shadow import ShadowSettings
from khep_twin.shadow.shadow_log import ShadowLog


def test_what_is_written_reads_back(tmp_path: Path) -> None:
    log = read_shadow(written(tmp_path / "shadow.mcap"))
    expected = list(updates())
    assert log.times_ns.tolist() == [update.time_ns for update in expected]
    assert np.allclose(log.pose, [update.estimate.pose for update in expected], atol=1e-12)
    assert np.array_equal(log.covariance, [update.estimate.covariance for update in expected])
    assert np.allclose(log.reckoned, [update.reckoned for update in expected], atol=1e-12)
    assert np.array_equal(log.expected, [update.expected for update in expected])
    assert np.array_equal(log.measured, [update.measured for update in expected], equal_nan=True)
    proximity = [update.residuals.proximity for update in expected]
    assert np.array_equal(log.residuals["proximity"], proximity, equal_nan=True)
    assert np.isnan(log.residuals["light"]).all()
    assert log.residuals["wheels"][0].tolist() == [1.0, -2.0]
    assert np.isnan(log.residuals["timing"]).ravel().tolist() == [False, True] * 30 + [False]
    assert log.particles_ns.tolist() == [0, 1000 * MS, 2000 * MS, 3000 * MS]
    first, last = expected[0].particles[[0, -1]]
    assert np.array_equal(log.particles[0, [0, -1]], [first, last])


def test_a_log_has_as_many_sensors_as_its_robot(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    log = read_shadow(written(tmp_path / "nine.mcap", playpen=nine_playpen(tmp_path, monkeypatch)))
    expected = list(updates(9))
    assert log.sensors == SENSORS
    assert np.array_equal(log.expected, [update.expected for update in expected])
    proximity = [update.residuals.proximity for update in expected]
    assert np.array_equal(log.residuals["proximity"], proximity, equal_nan=True)
    assert [log.residuals[kind].shape for kind in ("light", "wheels", "timing")] == [
        (61, 9),
        (61, 2),
        (61, 1),
    ]
    assert log.residuals["wheels"][0].tolist() == [1.0, -2.0]


def test_an_alarm_has_a_line_at_its_beginning_and_one_at_its_end(tmp_path: Path) -> None:
    path = written(tmp_path / "shadow.mcap")
    lines = read_series(path).lines["/shadow/alarms"]
    assert [(line.time_ns, line.level, line.name, line.text) for line in lines] == [
        (1000 * MS, Level.WARN, "proximity", "stuck sensor 2: since 0.800 s, 97.5 % sure"),
        (2000 * MS, Level.INFO, "proximity", "stuck sensor 2: ended, since 0.800 s"),
    ]
    expected = Alarm(ALARM.fault, "proximity", 800 * MS, 1000 * MS, 0.975, 2000 * MS)
    assert read_shadow(path).alarms == [expected]


def test_a_state_has_a_line_where_it_begins_and_suspected_faults_where_they_change(tmp_path: Path) -> None:
    path = tmp_path / "shadow.mcap"
    log = ShadowLog(path, Playpen.load("obstacles"), ShadowSettings())
    slip = Suspicion(("slipping wheel left", "weak motor left"), "wheels", 900 * MS, 0.3)
    for update in updates():
        # Less than 5 % from what was written last, and then more; names that change places are the same.
        rising = 0.6 + 0.03 * ((update.time_ns - 800 * MS) // (50 * MS))
        suspicions = tuple(replace(suspicion, probability=rising) for suspicion in update.suspected)
        if update.time_ns >= 950 * MS and suspicions:
            suspicions += (replace(slip, faults=slip.faults[:: -1 if update.time_ns > 950 * MS else 1]),)
        log.write(replace(update, suspected=suspicions))
    log.close()
    series = read_series(path).lines
    assert [(line.time_ns // MS, line.level, line.text) for line in series["/shadow/state"]] == [
        (0, Level.INFO, "followed"),
        (2000, Level.INFO, "unsure"),
    ]
    suspicion_text = "stuck sensor 2, dead sensor 2: proximity, since 0.800 s"
    assert [(line.time_ns // MS, line.text) for line in series["/shadow/suspected"]] == [
        (800, f"{suspicion_text}, 60.0 %"),
        (900, f"{suspicion_text}, 66.0 %"),
        (
            950,
            f"{suspicion_text}, 69.0 %; slipping wheel left, weak motor left: wheels, since 0.900 s, 30.0 %",
        ),
        (1000, "none"),
    ]
    read = read_shadow(path)
    assert read.states == [(0, PoseState.FOLLOWED), (2000 * MS, PoseState.UNSURE)]
    assert read.suspected[2] == (950 * MS, (replace(SUSPICION, probability=0.69), slip))
    assert read.suspected[3] == (1000 * MS, ())
    assert str(read.state_times) == "followed 66.7 %, unsure 33.3 %, lost 0.0 % of the time"


def test_a_log_without_states_and_suspected_faults_is_read(tmp_path: Path) -> None:
    def before(topic: str) -> str:
        return f"/older{topic}" if topic in ("/shadow/state", "/shadow/suspected") else topic

    log = read_shadow(rewritten(written(tmp_path / "new.mcap"), tmp_path / "old.mcap", rename=before))
    assert log.states == log.suspected == []
    assert len(log.alarms) == 1
    assert str(log.state_times) == "of no time"


@pytest.mark.parametrize(
    ("topic", "text", "error"),
    [
        ("state", "Lost", "state Lost; expected one of followed, unsure, lost"),
        ("suspected", "", "suspected ; expected FAULT: CHANNEL, since SECONDS s, PERCENT %"),
        ("suspected", "slip: wheels, since 1 s, 101 %", "suspected slip: wheels, since 1 s, 101 %"),
        ("suspected", "none; none", "suspected none; expected FAULT"),
        ("suspected", "\x1b[2J", r"suspected '\x1b[2J'; expected FAULT"),
    ],
)
def test_a_line_that_tells_no_state_or_no_suspected_faults_is_one_line(
    topic: str, text: str, error: str, tmp_path: Path
) -> None:
    def other(logged_topic: str, time_ns: int, message: bytes) -> bytes:
        is_it = logged_topic == f"/shadow/{topic}"
        return line_message(TextLine(time_ns, Level.INFO, topic, text)) if is_it else message

    log = rewritten(written(tmp_path / "shadow.mcap"), tmp_path / "x.mcap", other)
    with pytest.raises(LogError, match=rf"/shadow/{topic} at 0\.\d000 s: {re.escape(error)}"):
        read_shadow(log)


def test_the_same_updates_give_the_same_bytes_and_name_the_log_they_are_from(tmp_path: Path) -> None:
    parent = tmp_path / "robot.mcap"
    parent.write_bytes(b"a robot's log")
    one, two = (written(tmp_path / f"{name}.mcap", parent) for name in ("one", "two"))
    assert one.read_bytes() == two.read_bytes()
    label = read_shadow(one).label
    assert label.metadata["parent"] == "robot.mcap"
    assert label.metadata["parent_sha256"] == hashlib.sha256(b"a robot's log").hexdigest()
    assert label.metadata["khep_twin"]
    assert json.loads(label.attachments["configuration.json"])["seed"] == 7
    assert playpens.parse(label.attachments["playpen.toml"], "playpen.toml") == Playpen.load("obstacles")


def test_the_robot_of_the_scene_is_at_the_estimate(tmp_path: Path) -> None:
    path = written(tmp_path / "shadow.mcap")
    series = read_series(path).series
    assert np.allclose(series["/khepera0/pose"].values, read_shadow(path).pose, atol=1e-9)


def test_a_log_that_was_not_closed_is_kept(tmp_path: Path) -> None:
    path = tmp_path / "shadow.mcap"
    log = ShadowLog(path, Playpen.load("obstacles"), ShadowSettings(), flush_ns=500 * MS)
    for update in updates():
        log.write(update)
    assert not path.exists()
    part = tmp_path / "shadow.mcap.part"
    assert part.stat().st_size > 10_000
    recover(shutil.copyfile(part, tmp_path / "torn.mcap.part"))
    found = read_shadow(tmp_path / "torn.mcap")
    assert found.states == [(0, PoseState.FOLLOWED), (2000 * MS, PoseState.UNSURE)]
    assert [len(suspected) for _, suspected in found.suspected] == [1, 0]
    log.close()
    assert len(read_raw(path, lambda topic: topic == "/shadow/pose")[1]["/shadow/pose"]) == 61


def test_a_log_of_a_robot_is_no_log_of_a_shadow(tmp_path: Path) -> None:
    path = tmp_path / "robot.mcap"
    LineRecorder(path, {"baud": 9600}, lambda: 0).close()
    with pytest.raises(LogError, match=r"no log of a shadow; expected one of khep-twin shadow -o"):
        read_shadow(path)


def test_numbers_at_other_times_than_the_pose_are_one_line(tmp_path: Path) -> None:
    path = tmp_path / "shadow.mcap"
    log = LogFile(path, lambda: 0)
    log.describe({}, {"robots": "khepera0", "shadow": "1"})
    log.add("/shadow/pose", POSE_WITH_COVARIANCE, 0, pose_message(0, (0.1, 0.2, 0.3), np.eye(3)))
    log.finish()
    expected = r"/shadow/reckoned: 0 messages; expected 1, at the times of /shadow/pose"
    with pytest.raises(LogError, match=expected):
        read_shadow(path)
