"""The log of a shadow: what is written of its updates, and reads back."""

import hashlib
import json
from pathlib import Path

import numpy as np
import pytest
from shadow_updates import ALARM, MS, updates, written

from khep_twin import playpen as playpens
from khep_twin.errors import LogError
from khep_twin.log.channels import UNSURE_POSE, Level, pose_message
from khep_twin.log.line_recorder import LineRecorder
from khep_twin.log.log_file import LogFile
from khep_twin.log.reader import read_raw, read_series
from khep_twin.log.shadow_channels import (
    LIGHT,
    PROXIMITY,
    TIMING,
    WHEELS,
    Alarm,
    read_shadow,
)
from khep_twin.playpen import Playpen
from khep_twin.shadow.shadow import ShadowSettings
from khep_twin.shadow.shadow_log import ShadowLog


def test_what_is_written_reads_back(tmp_path: Path) -> None:
    found = read_shadow(written(tmp_path / "shadow.mcap"))
    given = list(updates())
    assert found.times_ns.tolist() == [update.time_ns for update in given]
    assert np.allclose(found.pose, [update.estimate.pose for update in given], atol=1e-12)
    assert np.array_equal(found.covariance, [update.estimate.covariance for update in given])
    assert np.allclose(found.reckoned, [update.reckoned for update in given], atol=1e-12)
    assert np.array_equal(found.expected, [update.expected for update in given])
    assert np.array_equal(found.measured, [update.measured for update in given], equal_nan=True)
    assert np.array_equal(
        found.residuals[:, PROXIMITY], [update.residuals.proximity for update in given], equal_nan=True
    )
    assert np.isnan(found.residuals[:, LIGHT]).all()
    assert found.residuals[0, WHEELS].tolist() == [1.0, -2.0]
    assert np.isnan(found.residuals[:, TIMING]).tolist() == [False, True] * 30 + [False]
    assert found.particles_ns.tolist() == [0, 1000 * MS, 2000 * MS, 3000 * MS]
    first, last = given[0].particles[[0, -1]]
    assert np.array_equal(found.particles[0, [0, -1]], [first, last])


def test_an_alarm_has_a_line_at_its_beginning_and_one_at_its_end(tmp_path: Path) -> None:
    path = written(tmp_path / "shadow.mcap")
    lines = read_series(path).lines["/shadow/alarms"]
    assert [(line.time_ns, line.level, line.name, line.text) for line in lines] == [
        (1000 * MS, Level.WARN, "proximity", "stuck sensor 2: since 0.800 s, 97.5 % sure"),
        (2000 * MS, Level.INFO, "proximity", "stuck sensor 2: ended, since 0.800 s"),
    ]
    expected = Alarm(ALARM.fault, "proximity", 800 * MS, 1000 * MS, 0.975, 2000 * MS)
    assert read_shadow(path).alarms == [expected]


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
    assert (tmp_path / "shadow.mcap.part").stat().st_size > 10_000
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
    log.add("/shadow/pose", UNSURE_POSE, 0, pose_message(0, (0.1, 0.2, 0.3), np.eye(3)))
    log.finish()
    expected = r"/shadow/reckoned: 0 messages; expected 1, at the times of /shadow/pose"
    with pytest.raises(LogError, match=expected):
        read_shadow(path)
