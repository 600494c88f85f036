"""Hosts at a network port that leave, that only finish sending, or that never read."""

import errno
import os
import resource
import socket
import struct
import time
from collections.abc import Callable, Iterator
from contextlib import closing

import pytest

from khep_twin.board.uart import LineSettings
from khep_twin.ports.host_port import NoticeLimit, Received
from khep_twin.ports.network import TcpPort
from khep_twin.ports.network_host import ANSWERS_LIMIT, LAST_LIMIT, QUEUE_LIMIT, WAITING_LIMIT, NetworkHost

TIMEOUT_S = 20.0


@pytest.fixture
def port() -> Iterator[TcpPort]:
    with closing(TcpPort("127.0.0.1", 0)) as port:
        yield port


@pytest.fixture
def negotiating() -> Iterator[TcpPort]:
    with closing(TcpPort("127.0.0.1", 0, rfc2217=True)) as port:
        yield port


def connect(port: TcpPort) -> socket.socket:
    number = int(port.path.rpartition(":")[2])
    return socket.create_connection(("127.0.0.1", number), timeout=TIMEOUT_S)


def wait_for(
    port: TcpPort, is_expected: Callable[[Received], object], limit: int = 0, answered: bool = False
) -> Received:
    """Poll the port until a result is as expected."""
    end = time.monotonic() + TIMEOUT_S
    while not is_expected(received := port.receive(limit, answered)):
        assert time.monotonic() < end, "this did not come"
        time.sleep(0.001)
    return received


def narrow(port: TcpPort) -> None:
    """Reduce the system's buffer of unread bytes."""
    with socket.socket(fileno=os.dup(port.descriptors(False)[0])) as server:
        server.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, 4096)


def connect_host(port: TcpPort) -> socket.socket:
    """Connect a host, and wait until the port has accepted it."""
    host = connect(port)
    wait_for(port, lambda _: port.occupied)
    return host


def test_the_next_host_s_negotiation_begins_at_the_speed_of_the_robots_line(
    port: TcpPort, negotiating: TcpPort
) -> None:
    with connect_host(negotiating):
        negotiating.set_baud(38400)
        assert negotiating.settings() == LineSettings(9600, 2)
    wait_for(negotiating, lambda received: received.hosts_left, answered=True)
    with connect_host(negotiating):
        assert negotiating.settings() == LineSettings(38400, 2)
    port.set_baud(38400)
    with connect_host(port):
        assert port.settings() is None  # plain bytes have no speed


def close(host: socket.socket) -> None:
    host.close()


def reset(host: socket.socket) -> None:
    host.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
    host.close()


def finish(host: socket.socket) -> None:
    host.shutdown(socket.SHUT_WR)


@pytest.mark.parametrize("leave", [close, reset, finish])
@pytest.mark.parametrize("size", [0, 6, 12_000, 20_000, 1_000_000])
def test_a_host_that_leaves_makes_room_at_once_however_much_it_left(
    port: TcpPort, leave: Callable[[socket.socket], None], size: int
) -> None:
    with connect_host(port) as first:
        first.settimeout(0.2)
        flood = b"D,1,2\n" * (size // 6 + 1)
        try:
            for at in range(0, size, 65536):
                first.sendall(flood[at : min(at + 65536, size)])
        except TimeoutError:
            pass  # no more of it finds room
        leave(first)
        with connect(port) as second:
            second.sendall(b"B\n")
            received = wait_for(port, lambda received: received.hosts_left, 10)
            assert received.last_data == flood[: len(received.last_data)]
            assert len(received.last_data) <= LAST_LIMIT
            if leave is not reset:
                assert len(received.last_data) == min(size, LAST_LIMIT)
            data = received.data or wait_for(port, lambda received: received.data, 10).data
            assert data == b"B\n"
            port.write(b"b\r\n")
            assert second.recv(100) == b"b\r\n"


def test_a_reset_connection_is_gone_without_a_next_host_and_its_commands_are_kept(port: TcpPort) -> None:
    with connect_host(port) as host:
        host.sendall(b"D,0,0\n" * 5)
        while port.receive(6).data != b"D,0,0\n":
            pass
        reset(host)
        received = wait_for(port, lambda received: received.hosts_left)
    assert received.last_data == b"D,0,0\n" * 4
    assert not port.occupied


def test_a_second_host_is_refused_and_costs_the_first_nothing(port: TcpPort) -> None:
    sent = bytes(range(1, 255)) * 50
    with connect_host(port) as first:
        first.sendall(sent)
        with connect(port) as second:
            notices = wait_for(port, lambda received: received.notices).notices
            assert notices == ["a second host, 127.0.0.1, was refused: the port is taken"]
            assert second.recv(10) == b""
        data = b""
        while len(data) < len(sent):
            data += wait_for(port, lambda received: received.data, 1000).data
    assert data == sent


def test_a_host_with_too_much_waiting_gives_way_and_is_reported(port: TcpPort) -> None:
    with connect_host(port) as first:
        first.sendall(b"\n" * WAITING_LIMIT)
        with connect(port):
            received = wait_for(port, lambda received: received.hosts_left)
            assert received.last_data == b"\n" * LAST_LIMIT
            assert received.notices == [
                "a host, 127.0.0.1, gave way to the next, 127.0.0.1: 16384 bytes or more of it were waiting"
            ]
            assert first.recv(10) == b""


def test_hosts_that_come_and_go_while_no_one_polls_follow_one_another(port: TcpPort) -> None:
    for text in (b"one\n", b"two", b"three\n"):
        with connect(port) as host:
            host.sendall(text)
    with connect(port) as host:
        host.sendall(b"B\n")
        calls: list[tuple[bytes, bytes]] = []
        while not calls or calls[-1][1] != b"B\n":
            received = wait_for(port, lambda received: received.hosts_left or received.data, 100)
            calls.append((received.last_data, received.data))
        # The bytes of no two of them come in the same part of the same call.
        assert b"|".join(part for call in calls for part in call if part) == b"one\n|two|three\n|B\n"


def test_a_host_that_has_finished_sending_gets_its_replies_and_is_let_go(port: TcpPort) -> None:
    with connect_host(port) as host:
        host.sendall(b"B\nN\n")
        finish(host)
        assert wait_for(port, lambda received: received.data, 100).data == b"B\nN\n"
        assert not port.receive(100).hosts_left
        port.write(b"b\r\n")
        assert not port.receive(100).hosts_left
        port.write(b"n\r\n")
        assert wait_for(port, lambda received: received.hosts_left, 100, answered=True).last_data == b""
        replies = b""
        while chunk := host.recv(100):
            replies += chunk
    assert replies == b"b\r\nn\r\n"


def test_a_host_that_has_finished_sending_does_not_keep_the_server_awake(port: TcpPort) -> None:
    with connect_host(port) as host:
        assert len(port.descriptors(True)) == 2
        finish(host)
        wait_for(port, lambda _: len(port.descriptors(True)) == 1, 100)
        assert port.occupied


def test_replies_that_found_no_room_leave_when_there_is_some(port: TcpPort) -> None:
    narrow(port)
    with connect_host(port) as host:
        lines = 0
        while not port.dropped:
            port.write(b"x" * 510 + b"\r\n")
            lines += 1
        is_expected, got = lines * 512 - port.dropped, 0
        while got < is_expected:
            port.receive(0)  # nothing is written any more
            got += len(host.recv(65536))
    assert got == is_expected


def test_escapes_are_never_cut_for_a_host_that_does_not_read_in_time(negotiating: TcpPort) -> None:
    narrow(negotiating)
    with connect_host(negotiating) as host:
        while negotiating.dropped < 3 * QUEUE_LIMIT:
            negotiating.write(b"\xffx" * 254 + b"\xff\r\n")
        host.settimeout(0.2)
        got = b""
        try:
            while True:
                negotiating.receive(0)
                got += host.recv(65536)
        except TimeoutError:
            pass
    greeting = bytes.fromhex("fffb01 fffb03 fffd00 fffb2c")
    assert got.startswith(greeting)
    assert b"\xff" not in got.removeprefix(greeting).replace(b"\xff\xff", b"")


def test_a_host_that_negotiates_on_and_never_reads_is_cut_off(negotiating: TcpPort) -> None:
    question = bytes.fromhex("fffa2c0100000000fff0")
    narrow(negotiating)
    number = int(negotiating.path.rpartition(":")[2])
    with socket.socket() as host:
        host.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        host.connect(("127.0.0.1", number))
        host.setblocking(False)
        end, received = time.monotonic() + TIMEOUT_S, Received()
        while not received.hosts_left and time.monotonic() < end:
            try:
                host.send(question * 100)
            except (BlockingIOError, ConnectionError):
                pass
            received = negotiating.receive(1024)
    assert len(received.notices) == 1
    assert received.notices[0].startswith("a host, 127.0.0.1, was cut off: ")
    assert f"{ANSWERS_LIMIT // 1000}" in received.notices[0]
    assert received.notices[0].endswith("expected a host that reads its answers")


@pytest.mark.parametrize(
    "beginning", [b"POST / HTTP/1.1", b"OPTIONS / HTTP/1.1", b"GET / HTTP/1.1", b"\x16\x03\1"]
)
@pytest.mark.parametrize("limit", [6, 1024])
@pytest.mark.parametrize("is_negotiated", [False, True])
def test_a_browser_is_cut_off_before_a_command_in_its_request_is_taken(
    port: TcpPort, negotiating: TcpPort, beginning: bytes, limit: int, is_negotiated: bool
) -> None:
    served = negotiating if is_negotiated else port
    with connect(served) as page:
        page.sendall(beginning + b"\r\nHost: 127.0.0.1\r\n\r\nD,10,10\nD,10,10\n")
        data, received = b"", Received()
        end = time.monotonic() + TIMEOUT_S
        while not received.hosts_left and time.monotonic() < end:
            received = served.receive(limit)
            data += received.data + received.last_data
    assert b"\n" not in data
    assert len(received.notices) == 1
    assert received.notices[0].endswith("as a browser does; expected a robot's host")
    assert not served.occupied


@pytest.mark.parametrize("number", [errno.ETIMEDOUT, errno.EHOSTUNREACH, errno.ENETDOWN, errno.ECONNRESET])
def test_an_error_of_the_network_is_a_host_that_has_gone(number: int) -> None:
    class Failing(socket.socket):
        def recv(self, *args: object) -> bytes:
            raise OSError(number, os.strerror(number))

        def send(self, *args: object) -> int:
            raise OSError(number, os.strerror(number))

    for is_sent_to in (True, False):
        with closing(Failing()) as client:
            host = NetworkHost(client, "127.0.0.1", None)
            if is_sent_to:
                host.write(b"b\r\n")
            else:
                assert host.receive(10) == b""
            assert host.is_lost
            assert host.receive(LAST_LIMIT) == b""


def test_a_host_that_finds_no_descriptor_is_reported_and_let_in_later(port: TcpPort) -> None:
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    with connect(port) as host:
        descriptors = [os.dup(host.fileno())]
        try:
            resource.setrlimit(resource.RLIMIT_NOFILE, (max(map(int, os.listdir("/proc/self/fd"))) + 2, hard))
            try:
                while True:
                    descriptors.append(os.dup(host.fileno()))
            except OSError:
                pass
            notices = port.receive(10).notices
            assert notices == ["a host could not be let in: Too many open files"]
            assert not port.occupied
        finally:
            for descriptor in descriptors:
                os.close(descriptor)
            resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))
        host.sendall(b"B\n")
        assert wait_for(port, lambda received: received.data, 10).data == b"B\n"


def test_no_more_waits_here_than_is_bounded(port: TcpPort) -> None:
    with connect_host(port) as host:
        host.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, 4096)
        host.settimeout(0.2)
        sent = 0
        try:
            while sent < 10_000_000:
                sent += host.send(bytes(4096))
        except TimeoutError:
            pass
    assert sent < 1_000_000


def test_the_system_looks_for_hosts_that_vanish(port: TcpPort) -> None:
    with connect_host(port):
        (client,) = set(port.descriptors(True)) - set(port.descriptors(False))
        with socket.socket(fileno=os.dup(client)) as end:
            assert end.getsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE)
            assert end.getsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY)
            if option := getattr(socket, "TCP_KEEPIDLE", None):
                assert end.getsockopt(socket.IPPROTO_TCP, option) == 10


def test_notices_are_rationed_and_those_left_out_are_counted(monkeypatch: pytest.MonkeyPatch) -> None:
    now = [100.0]
    monkeypatch.setattr(time, "monotonic", lambda: now[0])
    limit = NoticeLimit()
    assert limit.admit(map(str, range(15))) == [str(number) for number in range(10)]
    assert limit.admit(["more"]) == []
    now[0] += 11
    assert limit.admit(["a", "b"]) == ["a (6 more notices were not printed)"]
    now[0] += 1000
    assert len(limit.admit(["c"] * 20)) == 10


def test_a_reply_without_a_line_end_is_sent_at_the_end_of_the_reply() -> None:
    client, peer = socket.socketpair()
    with closing(client), closing(peer):
        peer.setblocking(False)
        host = NetworkHost(client, "127.0.0.1", None)
        host.write(b"\xc5\x01")
        with pytest.raises(BlockingIOError):
            peer.recv(10)
        host.write(b"\x3a", is_end=True)
        assert peer.recv(10) == b"\xc5\x01\x3a"
