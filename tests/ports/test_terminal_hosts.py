"""Hosts on a terminal, by the kernel's reports."""

import fcntl
import os
import random
import select
import subprocess
import sys
import termios

import pytest
from forked import Forked

from khep_twin.ports import pty as pty_module
from khep_twin.ports.host_writes import Change
from khep_twin.ports.pty import PtyPort
from khep_twin.ports.terminal_hosts import TerminalHosts


@pytest.fixture(params=["inotify", "no inotify"])
def port(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch):
    if request.param == "no inotify":
        monkeypatch.setattr(pty_module, "open_events", lambda path: None)
    with PtyPort() as port:
        yield port


def opened(port: PtyPort, flags: int = os.O_RDWR) -> int:
    return os.open(port.path, flags | os.O_NOCTTY)


def test_of_two_descriptors_of_one_process_one_may_close(port: PtyPort) -> None:
    first, second = opened(port), opened(port)
    port.receive(100)
    os.close(second)
    assert not port.receive(100).hosts_left
    assert port.occupied
    os.close(first)
    assert port.receive(100).hosts_left
    assert not port.occupied


def test_descriptors_opened_and_closed_between_two_looks_leave_the_first_host_here(port: PtyPort) -> None:
    host = opened(port)
    subprocess.run(["stty", "-F", port.path, "9600"], check=True)
    assert not port.receive(100).hosts_left
    for _ in range(3):
        os.close(opened(port))
    assert not port.receive(100).hosts_left
    assert port.occupied
    os.write(host, b"B\n")
    assert port.receive(100).data == b"B\n"
    os.close(host)


def test_a_descriptor_that_is_inherited_keeps_the_host_here(port: PtyPort) -> None:
    host = opened(port)
    with subprocess.Popen(["cat"], stdin=subprocess.PIPE, pass_fds=[host]) as child:
        os.close(host)
        assert not port.receive(100).hosts_left
        assert port.occupied
        child.communicate()
    assert port.receive(100).hosts_left


def test_a_host_that_came_and_went_unseen_has_left(port: PtyPort) -> None:
    host = opened(port)
    os.write(host, b"D,1,1\nD,0,")
    os.close(host)
    received = port.receive(4)
    assert (received.hosts_left, received.last_data, received.data) == (True, b"D,1,1\nD,0,", b"")
    assert not port.receive(100).hosts_left


def test_a_lock_of_a_host_that_is_here_stays_and_goes_with_it(port: PtyPort) -> None:
    host, other = opened(port), opened(port)
    fcntl.ioctl(host, termios.TIOCEXCL)
    port.receive(100)
    os.close(other)
    port.receive(100)
    state = fcntl.ioctl(host, 0x80045440, bytes(4))
    assert any(state)
    os.close(host)
    assert port.receive(100).hosts_left
    host = opened(port)
    assert not any(fcntl.ioctl(host, 0x80045440, bytes(4)))
    os.close(host)


def test_replies_that_were_not_read_are_flushed_when_the_next_host_is_here_already() -> None:
    with PtyPort() as port:
        host = opened(port)
        port.receive(100)
        port.write(b"n,1,2\r\n")
        os.close(host)
        host = opened(port)
        os.write(host, b"B\n")
        received = port.receive(100)
        assert (received.hosts_left, received.last_data, received.data) == (True, b"", b"B\n")
        assert len(received.notices) == 1
        os.set_blocking(host, False)
        with pytest.raises(BlockingIOError):
            os.read(host, 100)
        os.close(host)


@pytest.mark.parametrize(
    ("before", "after"),
    [
        (b"N\n", b"B\n"),
        (b"N\nN\r\nC,12\n", b"B\n"),
        (b"", b"B\n"),
        (b"D,0,0\n", b""),
        (b"N\n", b"B"),
        (b"B\nC,12", b"T,1,B\n"),
        # A host that has taken back what it wrote, and one that speaks another protocol through a relay.
        (None, bytes(range(256))),
    ],
)
def test_lines_of_the_next_host_are_distinguished_from_those_of_the_one_before(
    before: bytes | None, after: bytes
) -> None:
    with PtyPort() as port:
        host = opened(port)
        port.receive(100)
        os.write(host, b"N\n" if before is None else before)
        if before is None:
            # As if flushed by the host, which takes back only what the kernel has not moved on.
            assert select.select([port.descriptor], [], [], 10)[0]
            assert os.read(port.descriptor, 100) == b"N\n"
        os.close(host)
        host = opened(port)
        os.write(host, after)
        received = port.receive(1)
        assert (received.hosts_left, received.last_data, received.data) == (True, before or b"", after)
        os.close(host)


def test_settings_that_a_host_makes_as_another_leaves_are_its_own(
    port: PtyPort, monkeypatch: pytest.MonkeyPatch
) -> None:
    first, later = opened(port), list[int]()
    set_speed(first, termios.B19200)
    port.receive(100)
    os.close(first)

    poll = TerminalHosts.poll

    def come_after_the_last_poll(watched: TerminalHosts, wrote: bool) -> Change:
        change = poll(watched, wrote)
        if not wrote and not change.hosts_left:
            later.append(opened(port))
            set_speed(later[0], termios.B57600)
        return change

    with monkeypatch.context() as patch:
        patch.setattr(TerminalHosts, "poll", come_after_the_last_poll)
        assert port.receive(100).hosts_left
    assert termios.tcgetattr(later[0])[5] == termios.B57600
    monkeypatch.setattr(pty_module, "_RESTORE_S", 0.0)
    port.receive(100)
    assert termios.tcgetattr(later[0])[5] == termios.B57600
    os.close(later[0])


def test_settings_are_put_back_while_other_terminals_are_busy(
    port: PtyPort, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(pty_module, "_RESTORE_S", 0.0)
    with PtyPort() as other:
        host = opened(port)
        set_speed(host, termios.B57600)
        port.receive(100)
        os.close(host)
        assert port.receive(100).hosts_left
        os.close(opened(other))
        port.receive(100)
        host = opened(port)
        assert termios.tcgetattr(host)[5] == termios.B9600
        os.close(host)


def test_bytes_that_were_read_before_a_host_left_are_not_the_next_one_s(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    with PtyPort() as port:
        hosts = [opened(port)]
        port.receive(100)
        os.close(hosts.pop())
        hosts.append(opened(port))
        os.write(hosts[0], b"N\n")
        poll = TerminalHosts.poll

        def poll_and_be_followed(watched: TerminalHosts, wrote: bool) -> Change:
            change = poll(watched, wrote)
            if len(hosts) == 1:
                os.close(hosts[0])
                hosts.append(opened(port))
                os.write(hosts[1], b"B\nO\n")
            return change

        monkeypatch.setattr(TerminalHosts, "poll", poll_and_be_followed)
        received = port.receive(100)
        assert (received.hosts_left, received.last_data, received.data) == (True, b"N\n", b"B\nO\n")
        os.close(hosts[1])


def set_speed(host: int, speed: int) -> None:
    flags = termios.tcgetattr(host)
    flags[4] = flags[5] = speed
    termios.tcsetattr(host, termios.TCSANOW, flags)


def is_held(hosts: TerminalHosts) -> bool:
    return True


def test_a_host_that_is_still_closing_has_left_when_the_next_one_comes(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    with PtyPort() as port:
        host = opened(port)
        port.receive(100)
        with monkeypatch.context() as patch:
            # The kernel reports a closing before the terminal is hung up.
            patch.setattr(TerminalHosts, "_has_host", is_held)
            os.close(host)
            assert not port.receive(100).hosts_left
        host = opened(port)
        os.write(host, b"B\n")
        received = port.receive(100)
        assert (received.hosts_left, received.data) == (True, b"B\n")
        os.close(host)


@pytest.mark.share(2)
@pytest.mark.parametrize("rounds", [300, 2000])
def test_random_openings_and_closings_are_followed(rounds: int, port: PtyPort) -> None:
    rng = random.Random(1)
    descriptors: list[int] = []
    for _ in range(rounds):
        before = len(descriptors)
        for _ in range(rng.randrange(1, 4)):
            if descriptors and rng.random() < 0.5:
                os.close(descriptors.pop(rng.randrange(len(descriptors))))
            elif len(descriptors) < 5:
                descriptors.append(opened(port, rng.choice([os.O_RDWR, os.O_RDONLY, os.O_WRONLY])))
        left = port.receive(100).hosts_left
        assert port.occupied == bool(descriptors)
        if before and not descriptors:
            assert left
    for descriptor in descriptors:
        os.close(descriptor)


def test_a_host_that_floods_the_line_as_another_leaves_holds_nothing_up() -> None:
    with PtyPort() as port:
        os.close(opened(port))
        program = (
            "import os, sys\nhost = os.open(sys.argv[1], os.O_RDWR)\nwhile True: os.write(host, bytes(4096))"
        )
        with Forked([sys.executable, "-c", program, port.path]) as flood:
            while not select.select([port.descriptor], [], [], 1)[0]:
                pass
            received = port.receive(100)
            flood.kill()
        assert received.hosts_left
        assert 0 < len(received.data + received.last_data) <= 100 + 65536
