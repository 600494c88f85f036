"""Binary frames on a robot's line, of the Toy: noise, parts of frames and wrong checksums at both ends."""

import random
import threading
from collections.abc import Iterator
from contextlib import closing
from itertools import islice
from pathlib import Path
from typing import Any, cast

import pytest
import serial
from command_line import good

from khep_twin import playpen as playpens
from khep_twin.errors import PortError, ProtocolError, StoppedError
from khep_twin.host.connection import connect
from khep_twin.host.host_command import HostCommand
from khep_twin.host.host_robot import HostRobot, open_robot
from khep_twin.lab.conformance.port.check import CheckedPort, Deviation
from khep_twin.lab.experiment.replay_to_port import replay_to_port
from khep_twin.lab.experiment.wire_statistics import wire
from khep_twin.log.recorded import read_recorded_run
from khep_twin.ports.host_port import HostPort, Received
from khep_twin.ports.network import TcpPort
from khep_twin.ports.protocol_khep import Serial
from khep_twin.ports.pty import PtyPort
from khep_twin.ports.serve import serve
from khep_twin.ports.twin import Twin, TwinOptions, open_twin
from khep_twin.robots.framing import LINES, Frames
from khep_twin.robots.registry import find_model
from khep_twin.web.paced_twin import OutsideHost
from khep_twin.world import World

pytestmark = pytest.mark.usefixtures("installed_toy")

TEXT = 'version = 1\nname = "toys"\n[arena]\nwidth_mm = 600\nheight_mm = 400\n[[robot]]\nmodel = "toy"\n'
PLACE = "x_mm = 200\ny_mm = 200\nheading_deg = 0\n"
SETPOINTS = slice(13, 15)
"""Registers of the Toy."""


@pytest.fixture
def frames() -> Frames:
    """Framing of the Toy."""
    framing = find_model("toy").dialect.framing
    assert isinstance(framing, Frames)
    return framing


def frame(command: int, *values: int) -> bytes:
    """Return a frame of the Toy; 1 is its name, 2 sets the speeds, 3 reads the registers."""
    from toy_robot import model

    return model.frame(command, *values)


def open_toys(*faults: str, log: Path | None = None) -> Twin:
    """Open a twin with one Toy."""
    return open_twin(playpens.parse(TEXT + PLACE, "toys"), TwinOptions(seed=4, faults=faults, log=log))


def open_toy(twin: Twin, **options: Any) -> Any:
    """Open the Toy of a twin in this process."""
    return open_robot(find_model("toy"), Serial.of(twin, 1.0), **options)


def test_frames_and_noise_are_split_alike_in_pieces_of_any_size(frames: Frames) -> None:
    parts = [
        frame(1),
        b"\x00D,5,5\r\n",
        frame(2, 100, -100),
        frame(2, 1, 2)[:4],
        frame(3),
        b"\xc5\x09",
        frame(1),
    ]
    data = b"".join(parts)
    messages, rest = frames.split(data, to_robot=True)
    assert (b"".join(messages), rest) == (data, b"")
    assert [part for part in messages if frames.is_message(part, True)] == [
        parts[index] for index in (0, 2, 4, 6)
    ]
    rng = random.Random(5)
    for _ in range(20):
        pieces: list[bytes] = []
        rest, start = b"", 0
        while start < len(data):
            end = start + rng.randrange(1, 9)
            messages, rest = frames.split(rest + data[start:end], to_robot=True)
            pieces += messages
            start = end
        assert b"".join(pieces) + rest == data
        assert [part for part in pieces if frames.is_message(part, True)] == [parts[i] for i in (0, 2, 4, 6)]


def test_a_request_is_one_frame_in_hexadecimal_digits(frames: Frames) -> None:
    assert frames.encode("c5 01 3a") == frame(1)
    assert frames.decode(frame(1)) == "C5013A"
    for text in ("B", "", "C501", "C5013B", "C5013AC5013A", "C5013A00", "é"):
        with pytest.raises(ValueError, match="expected the hexadecimal digits of one frame"):
            frames.encode(text)
    with pytest.raises(ValueError, match="expected one line of ASCII"):
        LINES.encode("B\nB")


class Source:
    """Port from which bytes are read; the clock advances by 0.1 s with each read."""

    timeout = 1.0

    def __init__(self, data: Iterator[int]) -> None:
        self.time = 0.0
        self._data = data

    def read(self, size: int = 1) -> bytes:
        """Read bytes."""
        self.time += 0.1
        return bytes(islice(self._data, size))

    def clock(self) -> float:
        """Return the time [s]."""
        return self.time


def test_a_reply_is_read_after_noise_and_noise_without_end_is_left(frames: Frames) -> None:
    reply = frame(3, *range(17))
    for noise in (b"", b"\xc5", b"\x00\xc5\x03\xc5", frame(2)[:-1] + b"\0"):
        source = cast(Any, Source(iter(noise + reply)))
        assert frames.read(source, source.clock) == reply
    for data in (reply[:-1], b"\0" * 5, b""):
        source = cast(Any, Source(iter(data)))
        assert not frames.is_message(frames.read(source, source.clock))
    source = cast(Any, Source(iter(lambda: 0, 1)))
    assert not frames.read(source, source.clock)
    assert source.time == pytest.approx(1.1)


@pytest.mark.parametrize(
    "rubbish",
    [
        bytes(range(256)),
        b"\xc5" * 50,
        b"\xc5",
        b"\xc5\x03",
        b"\nD,5,5\n",
        b"\xc5\x02\x00\x64",
        b"\xc5\x03\x39",
    ],
)
def test_a_toy_answers_after_rubbish_at_its_line(rubbish: bytes) -> None:
    with open_toys() as twin, open_toy(twin) as toy:
        toy.port.write(rubbish)
        assert len(toy.read_panel()["proximity"]) == 5
        assert not twin.robot.registers[SETPOINTS].any()
        assert toy.time < 0.7


def test_late_replies_are_dropped_and_lost_ones_are_read_again() -> None:
    for fault in ("late:0.5:700", "garble:0.005", "drop:0.005"):
        with open_toys(fault) as twin, open_toy(twin, retries=5) as toy:
            for number in range(10):
                speed = number % 7
                try:
                    toy.set_speed(speed / 100, -speed / 100)
                except (PortError, ProtocolError):
                    assert not fault.startswith("late")
                else:
                    assert toy.read_panel()["speed"][2:] == [10 * speed, -10 * speed]
        assert not twin.robot.registers[SETPOINTS].any()


def test_a_timeout_shows_a_part_of_a_frame_as_hexadecimal_digits() -> None:
    with open_toys() as twin, open_toy(twin) as toy:
        error = toy._line.port.timeout_error("C50338", frame(3)[:2], toy.time)
    assert "no reply to 'C50338' within 1 s, only 'C503'; is" in str(error)


def test_a_frame_that_moves_is_refused_after_hold_in_any_spelling() -> None:
    with open_toys() as twin, open_toy(twin) as toy:
        toy.set_speed(0.1, 0.1)
        toy.port.write(frame(2, 200, 200)[:5])
        toy.hold()
        assert not twin.robot.registers[SETPOINTS].any()
        for text in (frame(2, 1, 1).hex(), frame(2, 1, 1).hex().upper(), frame(2, 1, 1).hex(" ")):
            with pytest.raises(StoppedError, match="'C50200010001"):
                toy.ask(text)
        with pytest.raises(StoppedError):
            toy._run(HostCommand(frame(2, 1, 1).hex(), str))
        assert toy.ask("c5013a") == "C501546F7901FD"


def test_half_a_frame_is_part_of_a_state() -> None:
    worlds = [World(playpens.parse(TEXT + PLACE, "toys")) for _ in range(2)]
    request = frame(2, 30, 40)
    worlds[0].robots[0].send(request[:4])
    worlds[0].advance(0.1)
    worlds[1].restore(worlds[0].snapshot())
    for world in worlds:
        world.robots[0].send(request[4:])
        world.advance(0.1)
        assert world.robots[0].registers[SETPOINTS].tolist() == [30, 40]


def test_a_log_shows_frames_and_noise_as_hexadecimal_digits(tmp_path: Path) -> None:
    path = tmp_path / "toy.mcap"
    with open_toy(open_toys(log=path)) as toy:
        toy.port.write(b"\x00\xff")
        toy.set_speed(0.05, -0.05)
        for _ in range(3):
            toy.read_panel()
    recorded = read_recorded_run(path)
    texts = [(line.name, line.text) for line in recorded.lines[0]]
    assert texts[:3] == [("host", "00FF"), ("host", "C5020032FFCE3A"), ("robot", "C50239")]
    statistics = wire(recorded.lines[0], find_model("toy").dialect.framing)
    assert statistics.commands == {"03": 3, "02": 2, "noise": 2}
    assert (statistics.replies, statistics.unanswered) == (5, 0)
    good("export", path, "-o", tmp_path / "toy.csv", "--transcript", tmp_path / "line.csv")
    assert "host,C5020032FFCE3A\n" in (tmp_path / "line.csv").read_text()
    (tmp_path / "toys.toml").write_text(TEXT + PLACE)
    comparison = replay_to_port(recorded, f"khep://{tmp_path}/toys.toml?seed=4")
    assert {letter: item.compared for letter, item in comparison.letters.items()} == {"02": 2, "03": 3}
    assert comparison.is_identical


@pytest.mark.parametrize("where", ["pty", "tcp"])
def test_a_host_is_served_after_one_that_left_within_a_frame(where: str, tmp_path: Path) -> None:
    with open_toys() as twin:
        port: Any = PtyPort(str(tmp_path / "toy")) if where == "pty" else TcpPort("localhost", 0)
        stop, notices = threading.Event(), list[str]()
        with closing(port):
            server = threading.Thread(
                target=serve, args=(twin, [port]), kwargs={"stop": stop.is_set, "notify": notices.append}
            )
            server.start()
            try:
                with closing(serial.serial_for_url(port.path, 57_600, timeout=60)) as host:
                    host.write(frame(1) + b"\xc5\x01\x02" + frame(2, 100, 100)[:5])
                    assert host.read(7).hex() == "c501546f7901fd"
                model = find_model("toy")
                with connect(port.path) if where == "pty" else open_robot(model, port.path) as robot:
                    assert type(robot) is model.load_class("host", HostRobot)
                    assert robot.read_panel()["speed"] == [0] * 4
            finally:
                stop.set()
                server.join()


def test_the_page_inserts_a_hosts_frames_and_stops_the_motors_after_half_a_frame() -> None:
    class Port(HostPort):
        path, dropped, occupied = "port", 0, True
        sent = b""
        replies = b""

        def descriptors(self, has_room: bool) -> list[int]:
            return []

        def settings(self) -> None: ...

        def receive(self, limit: int, is_answered: bool = False) -> Received:
            data, self.sent = self.sent[:limit], self.sent[limit:]
            return Received(data)

        def write(self, data: bytes, is_end: bool = False) -> None:
            self.replies += data

    with open_toys() as twin:
        port = Port()
        host = OutsideHost(twin, twin.robots[0], port, pytest.fail)
        port.sent = b"\0" + frame(2, 70, 70) + frame(2, 90, 90)[:4]
        for _ in range(3):
            host.insert_command(twin.advance_to)
        assert twin.robot.registers[SETPOINTS].tolist() == [70, 70]
        assert (host.commands, port.replies) == (2, frame(2))
        host.stop_motors()
        for _ in range(40):
            host.exchange(None)
            twin.advance_to(twin.world.time_ns + 2_500_000)
        assert not twin.robot.registers[SETPOINTS].any()
        assert port.replies == frame(2)


def test_a_check_reports_an_incomplete_frame(frames: Frames) -> None:
    with open_toys("drop:0.02") as twin, open_toy(twin) as toy:
        line = CheckedPort(toy.port, frames)
        deviations: list[str] = []
        for _ in range(20):
            try:
                line.ask("C50338")
            except Deviation as error:
                deviations.append(str(error))
        assert any(text.endswith("expected a complete frame") for text in deviations)
