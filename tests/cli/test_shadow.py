"""`khep-twin shadow`: a robot followed from a log."""

import re
import signal
import socket
import subprocess
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest
import serial
from command_line import complaint, good, khep_twin
from served_twin import served

from khep_twin.cli.shadow_process import ShadowProcess
from khep_twin.log.reader import read_arrays, read_log
from khep_twin.log.shadow_channels import Alarm, PoseState
from khep_twin.playpen import Playpen
from khep_twin.sensing import calibration
from khep_twin.shadow.shadow import Shadow
from khep_twin.shadow.update import Update
from stand_ins.recordings import Truth, record

SOME = ("--particles", "100")


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The line of a stand-in robot, asked N and H for 5 s."""
    path = tmp_path_factory.mktemp("stand-in") / "robot.mcap"
    record(path, Playpen.load("obstacles"), seed=1, seconds=5, host="wall follower", asks_counters=True)
    return path


def test_it_tells_where_the_robot_is_and_what_was_learned(log: Path) -> None:
    process = khep_twin("shadow", "obstacles", log, *SOME)
    assert process.returncode == 0, process.stderr
    state, pose, reckoning, wheels = process.stdout.splitlines()
    assert re.fullmatch(
        r"state      followed at the end; followed \S+ %, unsure \S+ %, lost \S+ % of the time", state
    )
    positions = [float(number) for number in re.findall(r"(\S+) mm \+-", pose)]
    assert positions == pytest.approx(Truth.load(log.with_suffix(".npz")).poses[-1, :2] * 1e3, abs=20)
    assert reckoning.startswith("reckoning  ")
    assert wheels.startswith("wheels     radius 7.")
    assert "s followed in" in process.stderr


def test_a_host_that_never_asks_n_is_followed_by_its_counters_which_is_said(tmp_path: Path) -> None:
    script = tmp_path / "counts.py"
    script.write_text("def controller(robot):\n    robot.position()\n    robot.set_speed(5, 5)\n")
    good("run", script, "--playpen", "obstacles", "--seconds", 2, "--log", tmp_path / "counts.mcap")
    process = khep_twin("shadow", "obstacles", tmp_path / "counts.mcap", *SOME)
    assert process.returncode == 0, process.stderr
    assert (
        "no reply to N was heard; expected some: the pose is by commands and counters alone" in process.stderr
    )


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
    process = khep_twin("shadow", "obstacles", log, *SOME, "--until", 4)
    assert process.returncode == 0
    first, second, *_ = process.stdout.splitlines()
    assert first.strip().startswith("2.0")
    assert first.endswith("s  stuck sensor 3: proximity, since 1.90 s, 97% sure")
    assert second.endswith("s  stuck sensor 3: proximity, since 1.90 s, over")
    ended = khep_twin("shadow", "obstacles", log, *SOME, "--exit-on", "alarm")
    assert ended.returncode == 4
    assert ended.stdout.splitlines()[0] == first
    assert ended.stderr.startswith("2.0")


def test_a_robot_that_is_lost_and_found_is_a_line_each_and_ends_it_where_that_is_wanted(
    log: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    inner = Shadow.feed

    def feed(self: Shadow, time_ns: int, to_robot: bool, data: bytes) -> Iterator[Update]:
        for update in inner(self, time_ns, to_robot, data):
            second = time_ns // 1_000_000_000
            state = {2: PoseState.LOST, 3: PoseState.UNSURE}.get(second, PoseState.FOLLOWED)
            yield replace(update, state=state, alarms=(), ended=())

    monkeypatch.setattr(Shadow, "feed", feed)
    process = khep_twin("shadow", "obstacles", log, *SOME, "--exit-on", "alarm")
    assert process.returncode == 0
    lost, followed, state, *_ = process.stdout.splitlines()
    assert re.fullmatch(r" +2\.\d\d s  lost: its place is searched for", lost)
    assert re.fullmatch(r" +4\.\d\d s  found: at \d+, \d+ mm, -?\d+ degrees", followed)
    assert state.startswith("state      followed at the end; followed ")
    ended = khep_twin("shadow", "obstacles", log, *SOME, "--exit-on", "alarm", "--exit-on", "lost")
    assert ended.returncode == 5
    assert ended.stdout.splitlines()[0] == lost
    assert ended.stdout.splitlines()[1].startswith("state      lost at the end")


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--start", "left"], "--start left: expected known, unknown or X,Y,HEADING, such as 100,250,90"),
        (["--within", "10"], "--within 10: expected MM,DEG, such as 10,5"),
        (["--robot", "1"], "obstacles: robot 1; expected 0, as it has 1"),
        (["--poll"], "--poll is for a robot at --relay, not for a log"),
        (["--relay", "loop://"], "--relay follows a robot, not a log; expected one of them"),
        (["-o", "LOG"], "this is an input file; expected a separate file"),
    ],
)
def test_what_cannot_be_is_one_line(log: Path, options: list[str], message: str) -> None:
    words = [str(log) if option == "LOG" else option for option in options]
    assert message in complaint("shadow", "obstacles", log, *words)


def test_a_calibration_is_taken_from_what_a_shadow_has_learned(
    log: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with monkeypatch.context() as strict:
        strict.setattr("khep_twin.lab.fit.shadow_fit.MAX_DEVIATION_RATIO", 0.01)
        early = khep_twin("fit", "--from", log, "--playpen", "obstacles")
        assert "determines nothing better than it was known" in early.stderr
    monkeypatch.setattr("khep_twin.lab.fit.shadow_fit.MAX_DEVIATION_RATIO", 0.8)  # by a log of five seconds
    shadow, fitted_path = tmp_path / "shadow.mcap", tmp_path / "mine.toml"
    good("shadow", "obstacles", log, "-o", shadow)
    output = good("fit", "--from", shadow, "-o", fitted_path)
    assert "(95 %)" in output
    assert calibration.read(str(fitted_path))[0].source.endswith("; learned by a shadow in shadow.mcap")
    # The log of a relay is followed first, in the same way.
    again = khep_twin("fit", "--from", log, "--playpen", "obstacles")
    assert again.stdout == output.replace(f"calibration   {fitted_path}\n", "")
    for words, message in (
        (["--from", log], "no shadow's log; expected one, or --playpen with a relay's log"),
        (["--from", shadow, "--ruler-mm", "1"], "--ruler-mm is for recorded tests, not for --from"),
        ([], "nothing to fit; expected tests such as straight.mcap=998mm, or --from LOG"),
    ):
        assert message in complaint("fit", *words, codes=[2])


def test_a_robot_is_followed_beside_its_host_as_its_log_is_afterwards(tmp_path: Path) -> None:
    line, shadow = tmp_path / "line.mcap", tmp_path / "shadow.mcap"
    with (
        served("obstacles", "--seed", "1") as (_, robot),
        served(
            *("obstacles", "--relay", robot, *SOME, "--poll", "--log", str(line), "-o", str(shadow)),
            command="shadow",
        ) as (process, path),
    ):
        with serial.Serial(path, 9600, stopbits=2, timeout=20) as port:
            for request in (b"D,3,3\n", b"N\n", b"N\n"):
                port.write(request)
                assert port.readline()[:1] == request[:1].lower()
            # Polls of the silence that follows are no business of the host's.
            part, sizes = line.with_name("line.mcap.part"), set[int]()
            deadline = time.monotonic() + 60
            while len(sizes) < 4 and time.monotonic() < deadline:
                time.sleep(0.05)
                sizes.add(part.stat().st_size)
            port.write(b"B\n")
            assert port.readline() == b"b,5.02,5.01\r\n"
        process.send_signal(signal.SIGINT)
        output, errors = process.communicate(timeout=60)
    assert process.returncode == 0, errors
    assert [line[:10].rstrip() for line in output.splitlines()] == ["state", "pose", "reckoning", "wheels"]
    polled = [entry.text for entry in read_log(line).robots["khepera0"].serial if entry.text == "H"]
    assert polled
    assert len(read_arrays(shadow)[1]["/shadow/residuals"][0]) >= 3
    assert len(read_arrays(shadow)[1]["/shadow/learned"][0]) >= 1


@pytest.mark.parametrize(("code", "is_requested"), [(4, True), (5, True), (1, False)])
def test_a_relay_ends_with_a_shadow_that_has_ended_as_asked_and_goes_on_without_another(
    code: int, is_requested: bool, capsys: pytest.CaptureFixture[str]
) -> None:
    relay_end, shadow_end = socket.socketpair()
    with relay_end, shadow_end, subprocess.Popen(["true"]) as program:
        process = ShadowProcess(program, relay_end)
        line = process.make_listener(lambda: 0)
        line.flush()
        assert not process.has_ended_on_event()
        shadow_end.send(bytes([code]))
        shadow_end.close()
        while not line.is_broken:
            line.flush()
        assert process.has_ended_on_event() is is_requested
        assert process.finish() == code
    message = f"khep-twin: the shadow has ended with code {code}; the relay continues without it\n"
    assert capsys.readouterr().err == ("" if is_requested else message)


def test_a_time_beyond_the_end_is_the_end_and_an_odd_seed_is_refused(log: Path) -> None:
    good("shadow", "obstacles", log, *SOME, "--until", "inf")
    line = complaint("shadow", "obstacles", log, "--seed", -1, codes=[1])
    assert line == "seed = -1; expected an integer from 0 to 2**63-1"


def test_a_start_outside_the_arena_is_refused(log: Path) -> None:
    line = complaint("shadow", "obstacles", log, "--start", "99999,5,0")
    assert line.startswith("--start 99999,5,0: outside; expected a place in the arena of ")
