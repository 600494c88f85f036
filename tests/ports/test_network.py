"""TCP and RFC 2217 ports of a served twin, and several robots together."""

import os
import socket
import time
from collections.abc import Sequence
from contextlib import closing
from pathlib import Path

import pytest
import serial
from scenes import arena, robot
from served_twin import ask, connected, served, stop

from khep_twin.errors import PortError
from khep_twin.host import Khepera
from khep_twin.lab.conformance.port.check import CheckedPort
from khep_twin.lab.conformance.port.conform import checks, run_check
from khep_twin.ports.network import TcpPort, is_loopback, parse_address
from khep_twin.ports.network_host import LONGEST_LINE, SILENCE_S


# pyserial's own client of RFC 2217 has not followed Python.
@pytest.mark.filterwarnings("ignore:set:DeprecationWarning")
@pytest.mark.parametrize("kind", ["--tcp", "--rfc2217"])
def test_a_host_over_the_network_gets_its_replies(kind: str) -> None:
    with served("default", kind, "127.0.0.1:0") as (_, url):
        assert url.startswith(("socket://127.0.0.1:", "rfc2217://127.0.0.1:"))
        for _ in range(3):
            with serial.serial_for_url(url, baudrate=9600, stopbits=2, timeout=1) as port:
                port.write(b"B\nG,1,2\nH\n")
                assert [port.readline() for _ in range(3)] == [b"b,5.02,5.01\r\n", b"g\r\n", b"h,1,2\r\n"]


@pytest.mark.filterwarnings("ignore:set:DeprecationWarning")
def test_rfc2217_tells_of_a_wrong_speed_and_of_modem_lines() -> None:
    with served("default", "--rfc2217", "127.0.0.1:0") as (process, url):
        with serial.serial_for_url(url, baudrate=19200, timeout=1) as port:
            port.dtr = False
            port.rts = False
            assert port.cts
            assert ask(port, b"B\n") == b"b,5.02,5.01\r\n"
        _, errors = stop(process)
    assert "19200 baud, the robot's has 9600" in errors
    assert errors.count("for 19200 baud: serve --mode 2") == 1


@pytest.mark.parametrize("kind", ["--tcp", "--rfc2217"])
def test_a_reply_leaves_in_one_piece_when_its_last_byte_has_come(kind: str) -> None:
    with served("default", kind, "127.0.0.1:0") as (_, url), connected(url) as port:
        if kind == "--rfc2217":
            port.recv(1000)  # what the server begins the negotiation with
        for command, length in ((b"N\n", 10), (b"B\r", 13), (b"T,1,B\r\n", 30), (b"hello\n", 19)):
            start = time.monotonic()
            port.sendall(command)
            reply = port.recv(1000)
            took = time.monotonic() - start
            assert reply.endswith(b"\r\n")
            assert reply.count(b"\r\n") == 1
            assert len(reply) >= length
            assert took >= (len(command.rstrip()) + 1 + len(reply)) * 11 / 9600 * 0.98


def test_the_pace_of_a_network_port_conforms() -> None:
    pace = next(
        conformance_check
        for conformance_check in checks(False)
        if conformance_check.name.startswith("every reply starts within 10 ms")
    )
    with served("default", "--tcp", ":0") as (_, url), Khepera(url) as robot:
        # What a busy machine delays is no deviation of the port's.
        assert "" in (run_check(pace, CheckedPort(robot.port)).deviation for _ in range(20))


def test_replies_of_several_lines_leave_line_by_line() -> None:
    with served("default", "--tcp", ":0") as (_, url), connected(url) as port:
        port.sendall(b"restart\nB\nH\n")
        pieces = [port.recv(1000)]
        while not pieces[-1].startswith(b"h,"):
            pieces.append(port.recv(1000))
    assert b"".join(pieces).startswith(b"ROM of minirobot KHEPERA, Edoardo Franzi\r\nK-Team")
    assert all(piece.endswith(b"\r\n") for piece in pieces)
    assert b"".join(pieces).endswith(b"Serial Communication Protocol\r\nb,5.02,5.01\r\nh,0,0\r\n")


def test_queued_replies_leave_one_by_one() -> None:
    with served("default", "--tcp", ":0") as (_, url), connected(url) as port:
        for _ in range(5):  # until the machine is idle enough not to be late by a whole reply
            port.sendall(b"N\nO\nH\nK\n")
            pieces = [port.recv(1000)]
            while not pieces[-1].endswith(b"k,1,0,0,1,0,0\r\n"):
                pieces.append(port.recv(1000))
            assert all(piece.endswith(b"\r\n") for piece in pieces)
            if [piece[:1] for piece in pieces] == [b"n", b"o", b"h", b"k"]:
                return
    pytest.skip("the machine was late by a whole reply five times")


def test_an_unpaced_reply_leaves_in_one_piece() -> None:
    with served("default", "--tcp", ":0", "--unpaced") as (_, url), connected(url) as port:
        for _ in range(50):
            port.sendall(b"N\n")
            assert port.recv(1000).endswith(b"\r\n")


def test_a_robots_reply_leaves_in_one_piece_through_a_relay() -> None:
    with (
        served("default") as (_, device),
        served("--relay", device, "--tcp", ":0") as (_, url),
        connected(url) as port,
    ):
        for _ in range(5):
            port.sendall(b"N\n")
            reply = port.recv(1000)
            assert reply.startswith(b"n,")
            assert reply.endswith(b"\r\n")


def test_a_line_that_never_ends_leaves_after_a_moment_and_a_long_one_at_once() -> None:
    with closing(TcpPort("127.0.0.1", 0)) as server, connected(server.path) as host:
        while not server.occupied:
            server.receive(0)
        server.write(b"b,5.02\r\nh,1")
        assert host.recv(1000) == b"b,5.02\r\n"
        server.receive(0)
        host.settimeout(0.01)
        with pytest.raises(TimeoutError):
            host.recv(1000)
        host.settimeout(5)
        time.sleep(SILENCE_S * 1.1)
        server.receive(0)
        assert host.recv(1000) == b"h,1"
        server.write(b"x" * LONGEST_LINE)
        assert host.recv(1000) == b"x" * LONGEST_LINE


def test_a_second_host_is_refused_and_reported() -> None:
    with served("default", "--tcp", "127.0.0.1:0") as (process, url):
        with serial.serial_for_url(url, timeout=1) as port:
            assert ask(port, b"B\n") == b"b,5.02,5.01\r\n"
            with connected(url) as second:
                assert second.recv(10) == b""
            assert ask(port, b"E\n") == b"e,0,0\r\n"
        _, errors = stop(process)
    assert "a second host, 127.0.0.1, was refused" in errors


@pytest.mark.long
def test_a_host_that_goes_leaves_nothing_for_the_next() -> None:
    with served("default", "--tcp", "127.0.0.1:0") as (_, url):
        for _ in range(5):
            with serial.serial_for_url(url, timeout=1) as port:
                port.write(b"N\n" * 10 + b"C,12")
            time.sleep(0.05)
            with serial.serial_for_url(url, timeout=1) as port:
                assert ask(port, b"B\n") == b"b,5.02,5.01\r\n"
            time.sleep(0.05)


def test_several_robots_have_a_line_each(tmp_path: Path) -> None:
    playpen = tmp_path / "two.toml"
    playpen.write_text(arena() + robot(150, 250, 90) + robot(450, 250, 90, mode=2))
    link = tmp_path / "khepera"
    with served(str(playpen), "--link", str(link)) as (process, first):
        assert process.stdout is not None
        second = process.stdout.readline().strip()
        assert [first, second] == [f"{link}0", f"{link}1"]
        with (
            serial.Serial(first, 9600, stopbits=2, timeout=1) as left,
            serial.Serial(second, 19200, stopbits=2, timeout=1) as right,
        ):
            left.write(b"G,1,1\n")
            right.write(b"G,2,2\n")
            assert (left.readline(), right.readline()) == (b"g\r\n", b"g\r\n")
            left.write(b"H\n")
            right.write(b"H\n")
            assert (left.readline(), right.readline()) == (b"h,1,1\r\n", b"h,2,2\r\n")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["two.toml"]


def test_a_port_that_is_taken_is_reported() -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        number = server.getsockname()[1]
        with pytest.raises(PortError, match="cannot listen here: Address already in use"):
            TcpPort("127.0.0.1", number)


def test_bytes_that_no_host_takes_are_counted() -> None:
    port = TcpPort("127.0.0.1", 0)
    with connected(port.path):
        time.sleep(0.05)
        port.receive(0)
        for _ in range(10_000):
            port.write(bytes(1000))
        assert port.dropped > 1_000_000
    port.close()


def test_addresses() -> None:
    assert parse_address(":5000") == ("127.0.0.1", 5000)
    assert parse_address("[::1]:0") == ("::1", 0)
    assert is_loopback("::1")
    assert is_loopback("localhost")
    assert not is_loopback("0.0.0.0")


def test_no_descriptor_is_left_open() -> None:
    before = len(os.listdir("/proc/self/fd"))
    for _ in range(5):
        TcpPort("127.0.0.1", 0, rfc2217=True).close()
    assert len(os.listdir("/proc/self/fd")) == before


@pytest.mark.share(3)
@pytest.mark.parametrize("clock", [[], ["--clock", "wire"], ["--speed", "max"]], ids=" ".join)
def test_a_host_that_reads_gets_all_replies_to_a_burst_on_a_line_without_time(
    clock: Sequence[str],
) -> None:
    with served("default", "--tcp", ":0", "--unpaced", *clock) as (process, url):
        with connected(url) as port:
            port.sendall(b"N\n" * 500)
            replies = b""
            try:
                while replies.count(b"\n") < 500 and (chunk := port.recv(100000)):
                    replies += chunk
            except TimeoutError:
                pass
        stop(process)
    assert replies.count(b"\n") == 500


@pytest.mark.parametrize("port", ["²", "9" * 5000])
def test_a_port_that_is_no_number_is_said(port: str) -> None:
    with pytest.raises(PortError, match="expected HOST:PORT"):
        parse_address(f":{port}")


@pytest.mark.parametrize("host", [".robots", "a" * 64 + ".org"])
def test_a_host_that_is_no_name_is_said(host: str) -> None:
    with pytest.raises(PortError, match="cannot listen here: "):
        TcpPort(host, 0)
