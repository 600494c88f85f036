"""The bytes of a line out of a log: of a relay's, or of a twin's."""

from pathlib import Path

import pytest
import scenes
from twins import SECOND

from khep_twin import playpen as playpens
from khep_twin.errors import LogError
from khep_twin.log.line_recorder import LineRecorder
from khep_twin.ports.twin import TwinOptions, open_twin
from khep_twin.robots.khepera4.registers import Control, DspicRegister
from khep_twin.robots.khepera4.robot import Khepera4Robot
from khep_twin.shadow.recording import read_recording


def test_a_relays_log_gives_its_lines_in_order_with_their_times(tmp_path: Path) -> None:
    path, clock = tmp_path / "line.mcap", iter(range(1000, 9000, 1000))
    recorder = LineRecorder(path, {"baud": 19200}, lambda: next(clock))
    pieces = [(True, b"N\n"), (False, b"n,1,2"), (False, b",3\r\n"), (True, b"D,1,1\nH\n")]
    for to_robot, data in pieces:
        recorder.on_bytes(to_robot, data)
    recorder.close()
    recording = read_recording(path)
    assert (recording.name, recording.baud) == ("khepera0", 19200)
    assert [(chunk.time_ns, chunk.to_robot, chunk.data) for chunk in recording.chunks] == [
        (1000, True, b"N\n"),
        (3000, False, b"n,1,2,3\n"),
        (4000, True, b"D,1,1\n"),
        (4000, True, b"H\n"),
    ]


def test_a_twins_log_gives_the_line_of_the_robot_that_is_asked_for(tmp_path: Path) -> None:
    path = tmp_path / "twin.mcap"
    two = playpens.parse(scenes.arena(300, 200) + scenes.robot(100, 100) + scenes.robot(200, 100), "two")
    with open_twin(two, TwinOptions(seed=3, log=str(path))) as twin:
        for robot, command in zip(twin.world.robots, (b"N\n", b"O\n"), strict=True):
            robot.send(command)
        twin.advance_to(SECOND)
    for index, letter in enumerate("no"):
        recording = read_recording(path, index)
        assert recording.name == f"khepera{index}"
        assert [chunk.data[:1].decode().lower() for chunk in recording.chunks if chunk.time_ns][-2:] == [
            letter
        ] * 2
    with pytest.raises(LogError, match="robot 2; expected one of 0 to 1, as the log has them"):
        read_recording(path, 2)


def test_the_registers_of_a_robot_without_a_host_are_replies_and_commands(tmp_path: Path) -> None:
    path = tmp_path / "program.mcap"
    with open_twin("arena4", TwinOptions(seed=1, log=str(path))) as twin:
        robot = twin.world.robots[0]
        assert isinstance(robot, Khepera4Robot)
        robot.dspic.write(bytes([DspicRegister.PWM_ORDER_LEFT, 0x58, 0x02, 0xA8, 0xFD]))
        robot.dspic.write(bytes([DspicRegister.CONTROL, Control.OPEN_LOOP]))
        twin.advance_to(SECOND // 5)
    recording = read_recording(path)
    data = [chunk.data for chunk in recording.chunks if chunk.time_ns == SECOND // 5]
    assert data[::2] == [b"N\n", b"G\n", b"R\n", b"L,600,-600\n"]
    assert [reply[:1] for reply in data[1::2]] == [b"n", b"g", b"r", b"l"]
    assert [reply.count(b",") for reply in data[1::2]] == [12, 5, 2, 0]
    with_reads = {chunk.time_ns for chunk in recording.chunks if chunk.data.startswith(b"R")}
    assert sorted(with_reads) == [0, SECOND // 10, SECOND // 5]


def test_a_log_without_a_line_is_an_error_of_one_line(tmp_path: Path) -> None:
    path = tmp_path / "line.mcap"
    LineRecorder(path, {"baud": "fast"}, lambda: 0).close()
    with pytest.raises(LogError, match="nothing crossed the line of khepera0; expected a host's commands"):
        read_recording(path)
    with pytest.raises(LogError, match=r"none\.mcap"):
        read_recording(tmp_path / "none.mcap")


def test_a_log_that_does_not_tell_its_speed_has_none(tmp_path: Path) -> None:
    path = tmp_path / "line.mcap"
    recorder = LineRecorder(path, {}, lambda: 0)
    recorder.on_bytes(True, b"N\n")
    recorder.close()
    assert read_recording(path).baud is None
