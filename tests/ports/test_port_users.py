"""Users of a port, detected without opening it."""

import errno
import os
import socket
import subprocess
import sys
import tty
from collections.abc import Iterator
from pathlib import Path

import pytest
import serial

from khep_twin.errors import PortInUse
from khep_twin.host.discovery import identify_robot
from khep_twin.ports import port_users
from khep_twin.ports.port_users import port_user

if not Path("/proc/self/fd").exists():
    pytest.skip("there is no /proc here", allow_module_level=True)

HOLDS = "import os, sys; os.open(sys.argv[1], os.O_RDWR | os.O_NOCTTY); print(); sys.stdin.read()"


@pytest.fixture
def terminal() -> Iterator[tuple[int, int, str]]:
    """A pseudo-terminal with its master side here, and one descriptor of the host's side open."""
    master, host_side = os.openpty()
    tty.setraw(host_side)
    yield master, host_side, os.ttyname(host_side)
    os.close(master)
    os.close(host_side)


def test_who_keeps_the_far_end_is_no_host_and_another_process_is(
    terminal: tuple[int, int, str], tmp_path: Path
) -> None:
    _, _, path = terminal
    link = tmp_path / "robot"
    link.symlink_to(path)
    assert port_user(path) == ""
    with subprocess.Popen(
        [sys.executable, "-c", HOLDS, path], stdin=subprocess.PIPE, stdout=subprocess.PIPE
    ) as host:
        assert host.stdout is not None
        host.stdout.readline()
        for name in (path, str(link)):
            assert port_user(name).startswith(f"process {host.pid} (")
        with pytest.raises(PortInUse, match=f"{path}: in use by process {host.pid}"):
            identify_robot(path)
        host.communicate()
    assert port_user(path) == ""


def test_a_host_in_the_process_of_the_far_end_is_one(terminal: tuple[int, int, str]) -> None:
    _, _, path = terminal
    second = os.open(path, os.O_RDWR | os.O_NOCTTY)
    assert port_user(path).startswith(f"process {os.getpid()} ")
    os.close(second)


def test_the_lock_file_of_a_living_process_counts(
    terminal: tuple[int, int, str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    _, _, path = terminal
    monkeypatch.setattr(port_users, "_LOCKS", tmp_path)
    lock = tmp_path / f"LCK..{os.path.basename(path)}"
    lock.write_text(f"{os.getpid():10}\n")
    assert port_user(path).startswith(f"process {os.getpid()} ")
    lock.write_text(f"{2**22 + 1:10}\n")
    assert port_user(path) == ""
    lock.write_text("")
    assert port_user(path) == ""
    link = tmp_path / "robot"
    link.symlink_to(path)
    (tmp_path / "LCK..robot").write_text(f"{os.getpid():10}\n")
    assert port_user(str(link)).startswith(f"process {os.getpid()} ")


def test_a_lock_of_a_holder_that_cannot_be_seen_counts(
    terminal: tuple[int, int, str], monkeypatch: pytest.MonkeyPatch
) -> None:
    import fcntl

    _, host_side, path = terminal
    fcntl.flock(host_side, fcntl.LOCK_EX)
    assert port_user(path) == ""
    with pytest.raises(PortInUse, match="in use by a program that has locked it"):
        identify_robot(path)


def test_a_port_that_its_holder_has_made_exclusive_is_in_use(
    terminal: tuple[int, int, str], monkeypatch: pytest.MonkeyPatch
) -> None:
    # TIOCEXCL, which holds against users that are not root.
    def refuse(url: str, **options: object) -> None:
        raise serial.SerialException(errno.EBUSY, f"could not open port {url}: [Errno 16] {os.strerror(16)}")

    monkeypatch.setattr(serial, "serial_for_url", refuse)
    with pytest.raises(PortInUse, match="in use by a program that has locked it"):
        identify_robot(terminal[2])


@pytest.mark.parametrize("address", ["127.0.0.1", "0.0.0.0", "::1", "::"])
def test_an_established_connection_holds_a_port_of_the_network(address: str) -> None:
    family = socket.AF_INET6 if ":" in address else socket.AF_INET
    try:
        server = socket.create_server((address, 0), family=family)
    except OSError:
        pytest.skip(f"nothing can listen at {address} here")
    near = {"0.0.0.0": "127.0.0.1", "::": "::1"}.get(address, address)
    with server:
        number = server.getsockname()[1]
        host_text = f"[{address}]" if ":" in address else address
        url = f"socket://{host_text}:{number}"
        assert port_user(url) == ""
        with socket.create_connection((near, number), timeout=5):
            assert port_user(url) == "a connection"
            with pytest.raises(PortInUse, match="in use by a connection"):
                identify_robot(url)


@pytest.mark.parametrize("url", ["/nowhere", "khep://default", "socket://", "socket://127.0.0.1:x", "\0"])
def test_what_is_no_port_here_has_no_holder(url: str) -> None:
    assert port_user(url) == ""


def test_a_file_that_is_no_device_has_no_holder(tmp_path: Path) -> None:
    with (tmp_path / "file").open("w") as file:
        assert port_user(file.name) == ""


@pytest.mark.parametrize(("held_path", "is_user"), [("/dev/null", True), ("/dev/zero", False)])
def test_only_a_process_with_the_same_device_is_its_user(
    held_path: str, is_user: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    descriptors = tmp_path / "123" / "fd"
    descriptors.mkdir(parents=True)
    (descriptors / "3").symlink_to(held_path)
    (tmp_path / "123" / "stat").write_text("123 (host) S 1 1 1 0 -1")
    (tmp_path / "123" / "comm").write_text("host\n")
    monkeypatch.setattr(port_users, "_PROCESSES", tmp_path)
    assert port_user("/dev/null") == ("process 123 (host)" if is_user else "")
