"""`khep-twin shadow`: a robot followed from a log."""

import re
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest
from command_line import khep_twin

from benchmarks.stand_ins import Truth, record
from khep_twin import playpen as playpens
from khep_twin.shadow.alarms import Alarm
from khep_twin.shadow.shadow import Shadow, Update

SOME = ("--particles", "100")


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The line of a stand-in robot, asked N and H for 8 s."""
    path = tmp_path_factory.mktemp("stand-in") / "robot.mcap"
    record(path, playpens.load("obstacles"), seed=1, seconds=8, host="wall follower", asks_counters=True)
    return path


def test_it_tells_where_the_robot_is_and_what_was_learned(log: Path) -> None:
    done = khep_twin("shadow", "obstacles", log, *SOME)
    assert done.returncode == 0, done.stderr
    pose, reckoning, wheels = done.stdout.splitlines()
    found = [float(number) for number in re.findall(r"(\S+) mm \+-", pose)]
    assert found == pytest.approx(Truth.load(log.with_suffix(".npz")).poses[-1, :2] * 1e3, abs=20)
    assert reckoning.startswith("reckoning  ")
    assert wheels.startswith("wheels     radius 7.")
    assert "s followed in" in done.stderr


def test_it_follows_the_same_way_each_time_and_by_the_seed_another(log: Path) -> None:
    one, two, other = (
        khep_twin("shadow", "obstacles", log, *SOME, "--until", 3, "--seed", seed).stdout
        for seed in (1, 1, 2)
    )
    assert one == two != other


def test_an_alarm_is_a_line_and_ends_it_where_that_is_wanted(
    log: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    alarm = Alarm("stuck sensor 3", "proximity", 1_900_000_000, 2_000_000_000, 0.97)
    inner = Shadow.feed

    def feed(self: Shadow, time_ns: int, to_robot: bool, data: bytes) -> Iterator[Update]:
        for update in inner(self, time_ns, to_robot, data):
            if 2_000_000_000 < time_ns < 3_000_000_000:
                update = replace(update, alarms=(alarm,))
            elif 3_000_000_000 < time_ns < 3_050_000_000:
                update = replace(update, ended=(replace(alarm, ended_ns=time_ns),))
            yield update

    monkeypatch.setattr(Shadow, "feed", feed)
    told = khep_twin("shadow", "obstacles", log, *SOME, "--until", 4)
    assert told.returncode == 0
    first, second, *_ = told.stdout.splitlines()
    assert first.strip().startswith("2.0")
    assert first.endswith("s  stuck sensor 3: proximity, since 1.90 s, 97% sure")
    assert second.endswith("s  stuck sensor 3: proximity, since 1.90 s, over")
    ended = khep_twin("shadow", "obstacles", log, *SOME, "--exit-on", "alarm")
    assert ended.returncode == 4
    assert ended.stdout.splitlines()[0] == first
    assert ended.stderr.startswith("2.0")


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--start", "left"], "--start left: expected known, unknown or X,Y,HEADING, such as 100,250,90"),
        (["--within", "10"], "--within 10: expected MM,DEG, such as 10,5"),
        (["--robot", "1"], "robot 1; expected one of 0 to 0, as the log has them"),
        (["-o", "LOG"], "this is what is read; expected a file of its own"),
    ],
)
def test_what_cannot_be_is_one_line(log: Path, options: list[str], message: str) -> None:
    words = [str(log) if each == "LOG" else each for each in options]
    done = khep_twin("shadow", "obstacles", log, *words)
    assert done.returncode in (1, 2)
    assert message in done.stderr
    assert len(done.stderr.splitlines()) == 1
