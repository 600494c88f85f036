"""Repetition: a log alone reproduces its run, and a different run is detected, with its time."""

import json
import os
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from command_line import good, khep_twin
from log_rewriting import rewritten
from relay_logs import relayed
from served_twin import served

from khep_twin import playpen
from khep_twin.board.uart import HostEvent, HostEventKind, LineSettings
from khep_twin.errors import LogError
from khep_twin.host import Gripper, Khepera
from khep_twin.interventions.move_robot import scan
from khep_twin.lab.experiment.controllers import braitenberg
from khep_twin.lab.experiment.multi_robot import run_together
from khep_twin.lab.experiment.repeat import Divergence, repeat
from khep_twin.log.channels import TextLine, line_message
from khep_twin.log.decoding import read_line
from khep_twin.log.host_events import events_message, read_events
from khep_twin.log.recorded import read_recorded_run
from khep_twin.log.recover import recover
from khep_twin.log.run_description import version_differences
from khep_twin.playpen import Playpen
from khep_twin.ports.protocol_khep import Serial
from khep_twin.ports.twin import TwinOptions, open_twin
from khep_twin.sensing import calibration

SECOND = 1_000_000_000


def again(path: Path) -> Divergence | None:
    return repeat(read_recorded_run(path))


@pytest.fixture(scope="module")
def driven(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A log of ten seconds of a Braitenberg vehicle."""
    path = tmp_path_factory.mktemp("logs") / "run.mcap"
    good("run", "--playpen", "obstacles", "--seconds", 10, "--seed", 5, "--log", path)
    return path


@pytest.mark.long
def test_what_another_robot_was_asked_before_all_sensors_were_converted_is_repeated(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    with open_twin(Playpen.load("swarm"), TwinOptions(unpaced=True, log=str(path))) as twin:
        twin.world.advance_to(SECOND)
        twin.world.robots[1].send(b"N\n")
        scan(twin.world)
        twin.world.advance_to(SECOND + 1_000_000)
    assert again(path) is None


def test_a_log_whose_host_sends_before_the_reply_is_complete_repeats_when_sorted_by_time(
    tmp_path: Path,
) -> None:
    path = tmp_path / "run.mcap"
    with open_twin(Playpen.load("default"), TwinOptions(unpaced=True, log=str(path))) as twin:
        for _ in range(5):
            twin.robot.send(b"N\nD,1,1\n")
            twin.world.advance(0.02)
            twin.robot.send(b"B\n")
            twin.world.advance(0.05)
    by_time = rewritten(
        path, tmp_path / "sorted.mcap", order=lambda messages: sorted(messages, key=_log_time)
    )
    assert again(path) is None
    assert again(by_time) is None


def _log_time(message: Any) -> int:
    return message[2].log_time


@pytest.mark.share(2)
@pytest.mark.parametrize("seconds", [8, 60])
def test_a_run_with_noise_spread_and_faults_is_the_same_in_another_process(
    seconds: int, tmp_path: Path
) -> None:
    path = tmp_path / "run.mcap"
    faults = ("drop:0.001", "garble:0.001", "late:0.1:60", "stuck:2@5", f"dead:left@{seconds // 2}")
    words = [word for fault in faults for word in ("--fault", fault)]
    program = tmp_path / "patient.py"
    program.write_text(
        "from khep_twin.errors import KhepTwinError\n"
        "def controller(robot):\n"
        "    try:\n"
        "        robot.set_speed(6, 4 if max(robot.proximity()) < 300 else -4)\n"
        "    except KhepTwinError:\n"
        "        robot.sleep(0.1)\n"
    )
    options = ("--playpen", "obstacles", "--seed", 9, "--vary", "on", "--battery-used-min", 20)
    good("run", program, *options, "--seconds", seconds, "--log", path, *words)
    command = [sys.executable, "-m", "khep_twin", "repeat", str(path)]
    environment = {**os.environ, "PYTHONHASHSEED": "12"}
    completed = subprocess.run(command, capture_output=True, text=True, check=False, env=environment)
    assert (completed.returncode, completed.stderr) == (0, ""), completed
    assert completed.stdout.startswith(f"identical: {seconds}.")


@pytest.mark.share(2)
@pytest.mark.parametrize(
    "options",
    [
        TwinOptions(seed=2, mode=2),
        TwinOptions(seed=2, unpaced=True),
        TwinOptions(seed=2, faults=("brown-out@3",)),
        TwinOptions(seed=2, noise=False, rom="khepera2", mode=9),
    ],
    ids=["19200 baud", "unpaced", "brown-out", "Khepera II"],
)
def test_ways_to_run_repeat(tmp_path: Path, options: TwinOptions) -> None:
    with open_twin("two-lamps", options) as twin:
        twin.record(tmp_path / "run.mcap")
        for _ in range(50):
            twin.robot.send(b"N\nO\nD,5,3\n")
            twin.advance_to(twin.world.time_ns + SECOND // 7)
    assert again(tmp_path / "run.mcap") is None


def test_exchanges_without_time_and_a_reply_under_way_at_the_end_repeat(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    with open_twin("default", TwinOptions(unpaced=True, faults=("drop:0.2",), log=str(path))) as twin:
        port = Serial.of(twin, timeout=0.02)
        for _ in range(20):
            for word in (b"N\n", b"O\n", b"H\n"):
                port.write(word)
                port.read_until(b"\n")
    assert again(path) is None
    with open_twin("default", TwinOptions(log=str(path))) as twin:
        twin.robot.send(b"restart\n")
        twin.advance_to(30_000_000)
        twin.robot.send(b"N\nD,5")
        twin.advance_to(33_000_000)
    recorded = read_recorded_run(path)
    assert recorded.last_ns == 33_000_000 < recorded.lines[0][-1].time_ns
    assert repeat(recorded) is None


def test_the_demonstration_program_repeats_without_a_host(tmp_path: Path) -> None:
    with open_twin("obstacles", TwinOptions(mode=0, log=str(tmp_path / "run.mcap"))) as twin:
        twin.advance_to(10 * SECOND)
    assert again(tmp_path / "run.mcap") is None


def test_a_gripper_repeats(tmp_path: Path) -> None:
    with Khepera(f"khep://gripper?log={tmp_path}/run.mcap") as robot:
        gripper = Gripper(robot)
        gripper.lower()
        gripper.wait()
        robot.set_speed(5, 5)
        robot.sleep(2)
    assert again(tmp_path / "run.mcap") is None


def test_two_robots_repeat(tmp_path: Path) -> None:
    text = playpen.dump(Playpen.load("default"))
    second = "\n[[robot]]\nx_mm = 100\ny_mm = 100\nheading_deg = 45\n"
    two_robots = playpen.parse(text + second, "both")

    def drive(robot: Khepera) -> None:
        for _ in range(100):
            braitenberg(robot)

    run_together(two_robots, [drive, drive], TwinOptions(seed=4, log=str(tmp_path / "run.mcap")))
    recorded = read_recorded_run(tmp_path / "run.mcap")
    assert {index for _, index, _ in recorded.events} == {0, 1}
    assert repeat(recorded) is None


def test_a_host_that_takes_back_changes_its_speed_and_hangs_up_repeats(tmp_path: Path) -> None:
    options = TwinOptions(strict_line=True, log=str(tmp_path / "run.mcap"))
    with Serial.of(open_twin("default", options), timeout=0.5) as port:
        port.write(b"D,5,5\nN\nO\nE\n")
        port.sleep(0.01)
        port.reset_output_buffer()
        port.write(b"\n")
        port.readline()
        port.baudrate = 19200
        with pytest.warns(UserWarning, match="garbled"):
            port.write(b"N\nN\n")
        port.sleep(0.3)
        port.baudrate = 9600
        port.write(b"\nD,9,9\nH\nE")
        port.twin.robot.disconnect()
        port.sleep(1)
    recorded = read_recorded_run(tmp_path / "run.mcap")
    assert {event.kind for _, _, event in recorded.events} == {
        HostEventKind.SEND,
        HostEventKind.DISCONNECT,
        HostEventKind.FLUSH,
        HostEventKind.LINE_SETTINGS,
        HostEventKind.NOTE,
    }
    assert repeat(recorded) is None


@pytest.mark.long
def test_a_run_served_by_the_clock_on_the_wall_repeats(tmp_path: Path) -> None:
    with served("--log", str(tmp_path / "run.mcap")) as (_, port):
        for _ in range(2):
            with Khepera(port) as robot:
                robot.set_speed(4, 5)
                for _ in range(10):
                    robot.proximity()
                robot.port.write(b"N\nO\nD,0,0\nE")
            time.sleep(1)  # until the twin knows that its host has gone
    recorded = read_recorded_run(tmp_path / "run.mcap")
    assert HostEventKind.DISCONNECT in {event.kind for _, _, event in recorded.events}
    assert repeat(recorded) is None


def test_one_altered_byte_of_a_reply_is_found(tmp_path: Path, driven: Path) -> None:
    altered: list[tuple[int, str]] = []

    def alter(topic: str, time_ns: int, data: bytes) -> bytes:
        if not topic.endswith("/serial") or time_ns < 6 * SECOND or altered:
            return data
        line = read_line(data)
        if line.name != "robot" or not line.text.startswith("n,"):
            return data
        altered.append((time_ns, line.text))
        text = line.text[:-1] + ("0" if line.text[-1] != "0" else "1")
        return line_message(TextLine(line.time_ns, line.level, line.name, text))

    path = rewritten(driven, tmp_path / "altered.mcap", alter)
    difference = again(path)
    assert difference is not None
    ((time_ns, text),) = altered
    assert (difference.time_ns, difference.channel) == (time_ns, "/khepera0/serial")
    assert text in difference.repeated
    completed = khep_twin("repeat", path)
    assert completed.returncode == 3
    first, *_ = completed.stdout.splitlines()
    assert first == f"different from {time_ns / 1e9:.4f} s on, /khepera0/serial"


def test_a_wheel_larger_by_a_thousandth_is_found(tmp_path: Path, driven: Path) -> None:
    def enlarge(name: str, data: bytes) -> bytes:
        if not name.startswith("calibration/"):
            return data
        radius = calibration.read("khepera1")[0].wheels.radius_mm
        changed = f"[wheels]\nradius_mm = {radius * 1.001}\n"
        return data + changed.encode()

    difference = again(rewritten(driven, tmp_path / "run.mcap", attachment=enlarge))
    assert difference is not None
    assert difference.channel == "/state"
    assert difference.time_ns < SECOND


def test_an_altered_byte_of_a_host_is_found(tmp_path: Path, driven: Path) -> None:
    def alter(topic: str, time_ns: int, data: bytes) -> bytes:
        if not topic.endswith("/host_events"):
            return data
        return events_message([(known_ns, altered(event)) for known_ns, event in read_events(data)])

    def altered(event: HostEvent) -> HostEvent:
        return event._replace(data=b"H\n") if 5 * SECOND < event.at_ns < 5.05 * SECOND else event

    difference = again(rewritten(driven, tmp_path / "run.mcap", alter))
    assert difference is not None
    assert 5 * SECOND < difference.time_ns < 5.1 * SECOND


def test_a_calibration_by_path_comes_from_the_log(tmp_path: Path) -> None:
    calibration_path = tmp_path / "separate.toml"
    calibration_path.write_text(calibration.read("khepera1")[1])
    text = playpen.dump(Playpen.load("obstacles"))
    assert "[[robot]]\n" in text
    obstacles = playpen.parse(text, "own")
    robots = tuple(
        robot.model_copy(update={"calibration": str(calibration_path)}) for robot in obstacles.robots
    )
    obstacles = obstacles.model_copy(update={"robots": robots})
    with open_twin(obstacles, TwinOptions(log=str(tmp_path / "run.mcap"))) as twin:
        twin.robot.send(b"D,5,5\n")
        twin.advance_to(2 * SECOND)
    calibration_path.unlink()
    assert again(tmp_path / "run.mcap") is None


def test_a_rescued_log_repeats_as_far_as_it_goes(tmp_path: Path, driven: Path) -> None:
    part = tmp_path / "torn.mcap.part"
    data = driven.read_bytes()
    for size in (len(data) * 6 // 10, len(data) * 9 // 10):
        part.write_bytes(data[:size])
        assert again(recover(part).path) is None


def test_what_differs_from_here_is_said_before_it_starts(tmp_path: Path, driven: Path) -> None:
    assert version_differences(read_recorded_run(driven).label) == []
    path = rewritten(driven, tmp_path / "run.mcap", facts={"mujoco": "3.0.0", "machine": "Plan9 pdp11"})
    completed = khep_twin("repeat", path)
    assert completed.returncode == 0
    first, second = completed.stderr.splitlines()
    assert "made with mujoco 3.0.0, here is " in first
    assert "made with machine Plan9 pdp11, here is " in second


def test_what_cannot_be_repeated_is_one_line(tmp_path: Path, driven: Path) -> None:
    def without(name: str) -> Callable[[str, bytes], bytes | None]:
        return lambda attachment, data: None if attachment == name else data

    def with_log(name: str, data: bytes) -> bytes:
        if name != "configuration.json":
            return data
        return json.dumps({**json.loads(data), "log": str(tmp_path / "trap.mcap"), "seed": "x"}).encode()

    paths = [
        rewritten(driven, tmp_path / f"{number}.mcap", attachment=change)
        for number, change in enumerate(
            (without("playpen.toml"), without("calibration/khepera0.toml"), with_log)
        )
    ]
    (tmp_path / "text.mcap").write_text("no log")
    robot = relayed(tmp_path / "robot.mcap", [(0, True, b"N\n")])
    for path in (*paths, tmp_path / "text.mcap", robot, tmp_path / "none.mcap", tmp_path):
        completed = khep_twin("repeat", path)
        assert (completed.returncode, completed.stdout) == (1, ""), completed
        assert len(completed.stderr.splitlines()) == 1, completed
    with pytest.raises(LogError, match="made at a real robot; expected --port"):
        again(robot)
    assert not (tmp_path / "trap.mcap").exists()


def test_an_act_survives_its_message() -> None:
    events = [
        (
            12_345_678_902,
            HostEvent(HostEventKind.SEND, 12_345_678_901, LineSettings(9600, 2), bytes(range(256))),
        ),
        (12_345_678_903, HostEvent(HostEventKind.LINE_SETTINGS, 0, None)),
        (12_345_678_904, HostEvent(HostEventKind.FLUSH, 5, LineSettings(0, 1))),
    ]
    assert list(read_events(events_message(events))) == events
