"""`khep-twin serve --foxglove` and `run --foxglove`, compared with runs without it."""

import json
import re
import signal
import sys
import time
from pathlib import Path

import pytest
from command_line import complaint, good, khep_twin
from foxglove_client import client
from served_twin import served

from khep_twin.host import Khepera

pytest.importorskip("foxglove", reason="foxglove-sdk, the extra [foxglove], is not installed")


def test_a_served_twin_is_seen_while_a_host_drives_it() -> None:
    with served("default", "--foxglove-at", "127.0.0.1:0") as (process, path):
        assert process.stderr is not None
        announcement = process.stderr.readline()
        match = re.match(
            r"khep-twin: Foxglove connects to (ws://127\.0\.0\.1:\d+); a layout .*: (.*)\n", announcement
        )
        assert match is not None, announcement
        assert json.loads(Path(match[2]).read_text())["configById"]
        with client(match[1]) as watcher, Khepera(path) as robot:
            watcher.subscribe("/khepera0/serial", "/khepera0/speed", "/scene")
            watcher.receive_until("/scene")
            robot.set_speed(7, 3)
            line = watcher.receive_until("/khepera0/serial")[-1]
            assert b"D,7,3" in line.data
            watcher.receive_until("/khepera0/speed", line.time_ns)
            assert watcher.info["name"] == "khep_twin default"
        process.send_signal(signal.SIGINT)
        assert process.wait(30) == 0


def test_a_run_is_held_to_the_wall_clock_and_its_log_is_the_same(tmp_path: Path) -> None:
    words = ("run", "--seconds", "1", "--seed", "3")
    good(*words, "--log", "plain.mcap", folder=tmp_path)
    began = time.monotonic()
    process = khep_twin(*words, "--log", "shown.mcap", "--foxglove-at", ":0", folder=tmp_path)
    assert time.monotonic() - began >= 0.9
    assert process.returncode == 0
    assert process.stderr.startswith("khep-twin: Foxglove connects to ws://127.0.0.1:")
    assert (tmp_path / "shown.mcap").read_bytes() == (tmp_path / "plain.mcap").read_bytes()


@pytest.mark.parametrize("command", ["serve", "run"])
def test_an_address_for_other_machines_is_refused_in_one_line(command: str, tmp_path: Path) -> None:
    line = complaint(command, "--foxglove-at", "0.0.0.0:8765", folder=tmp_path, codes=[1])
    assert "expected 127.0.0.1:8765, or --allow-remote" in line


def test_an_empty_address_is_not_the_default_one(tmp_path: Path) -> None:
    line = complaint("run", "--cycles", 1, "--foxglove-at", "", folder=tmp_path, codes=[1])
    assert "expected HOST:PORT" in line


def test_a_robot_that_is_not_here_is_not_shown(tmp_path: Path) -> None:
    for words in (("run", "--port", "/dev/robot"), ("serve", "--relay", "/dev/robot")):
        line = complaint(*words, "--foxglove", folder=tmp_path, codes=[2])
        assert line.startswith("--foxglove is for a twin")


def test_without_the_package_one_line_names_the_command(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "foxglove", None)
    monkeypatch.delitem(sys.modules, "khep_twin.log.foxglove_live", raising=False)
    line = complaint("run", "--foxglove", folder=tmp_path, codes=[1])
    assert re.match("foxglove-sdk is not installed; to install it: .*pip install", line)
