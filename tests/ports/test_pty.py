"""The pseudo-terminal without a twin."""

import errno
import os
import select
import termios
from pathlib import Path

import pytest
import serial

from khep_twin.board.uart import LineSettings
from khep_twin.errors import PortError
from khep_twin.ports import pty as pty_module
from khep_twin.ports.event_sources import OpenEvents
from khep_twin.ports.link import private_folder
from khep_twin.ports.pty import PtyPort

from test_terminal_hosts import opened  # isort: skip


def test_it_is_raw_and_silent_before_anybody_opens_it() -> None:
    with PtyPort() as port:
        port.write(b"hello\r\n")
        assert port.receive(100).data == b""
        flags = termios.tcgetattr(port.descriptor)[3]
        assert not flags & (termios.ECHO | termios.ICANON)


def test_no_free_terminal_is_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    for number in (errno.ENOSPC, errno.EMFILE):

        def refuse(number: int = number) -> tuple[int, int]:
            raise OSError(number, os.strerror(number))

        monkeypatch.setattr(os, "openpty", refuse)
        with pytest.raises(
            PortError, match=rf"is available: {os.strerror(number)}; expected a free one, or --tcp"
        ):
            PtyPort()


def test_bytes_pass_unchanged_both_ways() -> None:
    every = bytes(range(256))
    with PtyPort() as port, serial.Serial(port.path, 9600, stopbits=2, timeout=1) as host:
        host.write(every)
        host.flush()
        assert port.receive(1000).data == every
        port.write(every)
        assert host.read(256) == every


def test_settings_are_those_that_the_host_has_now() -> None:
    with PtyPort() as port, serial.Serial(port.path, 9600, stopbits=2) as host:
        assert port.settings() == LineSettings(9600, 2)
        host.baudrate = 57600
        assert port.settings() == LineSettings(57600, 2)
        host.stopbits = 1
        assert port.settings() == LineSettings(57600, 1)


def test_a_host_may_come_and_go() -> None:
    with PtyPort() as port:
        for _ in range(3):
            with serial.Serial(port.path, 38400, timeout=1) as host:
                host.write(b"B\n")
                assert port.receive(100).data == b"B\n"
            assert port.receive(100).data == b""


def test_a_host_that_never_reads_loses_bytes_and_blocks_no_other() -> None:
    with PtyPort() as port:
        for _ in range(100):
            port.write(bytes(1000))
        assert port.dropped > 50_000


def test_leftovers_of_a_host_are_removed(monkeypatch: pytest.MonkeyPatch) -> None:
    with PtyPort() as port:
        with serial.Serial(port.path, 9600, timeout=1) as host:
            assert not port.receive(1000).hosts_left
            host.write(bytes(3000))
            assert len(port.receive(1000).data) == 1000
            port.write(b"unread\r\n")
        received = port.receive(1000)
        assert (received.hosts_left, received.data, received.last_data) == (True, b"", bytes(2000))
        # A host that comes at once has its own settings; for others they are put back.
        monkeypatch.setattr(pty_module, "_RESTORE_S", 0.0)
        assert not port.receive(1000).hosts_left
        with open(port.path, "rb", buffering=0) as next_host:
            os.set_blocking(next_host.fileno(), False)
            assert next_host.read(100) is None


@pytest.mark.parametrize("is_read", [True, False])
def test_a_host_that_may_have_got_an_old_reply_is_reported(
    monkeypatch: pytest.MonkeyPatch, is_read: bool
) -> None:
    monkeypatch.setattr(pty_module, "_TRANSIT_S", 0.0)
    with PtyPort() as port:
        with serial.Serial(port.path, 9600, timeout=1) as host:
            host.write(b"B\n")
            assert port.receive(100).data == b"B\n"
            port.write(b"b\r\n")
            # Once there, it is either read, or unread however long the host stays.
            assert select.select([host.fileno()], [], [], 10)[0]
            if is_read:
                assert host.read(3) == b"b\r\n"
            for _ in range(3):
                port.receive(100)
        with serial.Serial(port.path, 9600, timeout=0) as next_host:
            next_host.read(100)
            received = port.receive(100)
    assert received.hosts_left
    assert [*received.notices] == ([] if is_read else [pty_module._MIXED_NOTICE])


def test_a_host_that_reads_an_old_reply_before_it_is_flushed_is_reported(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    with PtyPort() as port:
        with serial.Serial(port.path, 9600, timeout=1) as host:
            host.write(b"B\n")
            assert port.receive(100).data == b"B\n"
            port.write(b"b\r\n")
        flush, came = port._drop_replies, list[int]()

        def come_and_flush() -> int:
            came.append(os.open(port.path, os.O_RDWR | os.O_NOCTTY))
            assert os.read(came[0], 3) == b"b\r\n"
            return flush()

        monkeypatch.setattr(port, "_drop_replies", come_and_flush)
        received = port.receive(100)
        os.close(came[0])
    assert received.hosts_left
    assert [*received.notices] == [pty_module._MIXED_NOTICE]


def test_a_link_leads_to_the_terminal_and_goes_with_it(tmp_path: Path) -> None:
    link = tmp_path / "khepera"
    with PtyPort(link) as port:
        assert port.path == str(link)
        assert os.readlink(link) == port.name
        with serial.Serial(str(link), timeout=1) as host:
            host.write(b"x")
            assert port.receive(10).data == b"x"
    assert not os.path.lexists(link)


def test_the_link_of_a_killed_server_is_replaced_and_a_foreign_link_survives(tmp_path: Path) -> None:
    link = tmp_path / "khepera"
    link.symlink_to("/dev/pts/9999")
    (tmp_path / ".khepera.lock").write_text("/dev/pts/9999")
    with PtyPort(link) as port:
        assert os.readlink(link) == port.name
        link.unlink()
        link.symlink_to("/dev/null")
    assert os.readlink(link) == "/dev/null"


@pytest.mark.parametrize("left", ["", "/dev/pts/9998"])
@pytest.mark.parametrize("target", ["/dev/null", "/dev/pts/9999", "gone/precious"])
def test_a_link_of_others_is_left_alone_also_where_its_target_is_gone(
    tmp_path: Path, target: str, left: str
) -> None:
    link, lock = tmp_path / "khepera", tmp_path / ".khepera.lock"
    link.symlink_to(target)
    if left:
        lock.write_text(left)
    with pytest.raises(PortError, match=f"khepera: this link leads to {target} and is not ours; name"):
        PtyPort(link)
    assert os.readlink(link) == target
    assert lock.exists() == bool(left)


def test_a_server_killed_while_it_makes_its_link_leaves_none_that_cannot_be_replaced(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    link, lock = tmp_path / "khepera", tmp_path / ".khepera.lock"
    for name in ("ftruncate", "pwrite", "symlink"):
        link.unlink(missing_ok=True)
        link.symlink_to("/dev/pts/9999")
        lock.write_text("/dev/pts/9999")

        def kill(*arguments: object) -> int:
            raise KeyboardInterrupt

        with monkeypatch.context() as killed:
            killed.setattr(os, name, kill)
            with pytest.raises(KeyboardInterrupt):
                PtyPort(link)
        with PtyPort(link) as port:
            assert os.readlink(link) == port.name


def test_a_host_that_sets_no_speed_has_that_of_the_robots_line(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pty_module, "_RESTORE_S", 0.0)
    with PtyPort() as port:
        with serial.Serial(port.path, 19200, timeout=1):
            port.receive(100)
            port.set_baud(38400)
            port.receive(100)
            assert port.settings() == LineSettings(19200, 1)  # a host's own
        port.receive(100)
        port.receive(100)
        with open(port.path, "rb", buffering=0):
            assert port.settings() == LineSettings(38400, 2)
        port.receive(100)
        port.set_baud(57600)  # where no host is there
        port.receive(100)
        assert port.settings() == LineSettings(57600, 2)


def test_what_is_no_link_is_left_alone(tmp_path: Path) -> None:
    file = tmp_path / "precious"
    file.write_text("data")
    with pytest.raises(PortError, match="precious: it exists and is not a symbolic link"):
        PtyPort(file)
    assert file.read_text() == "data"
    with pytest.raises(PortError, match="nowhere/link: cannot make this link: No such file or directory"):
        PtyPort(tmp_path / "nowhere" / "link")


def test_no_descriptor_is_left_open(tmp_path: Path) -> None:
    before = len(os.listdir("/proc/self/fd"))
    for _ in range(5):
        PtyPort().close()
        with pytest.raises(PortError):
            PtyPort(tmp_path / "nowhere" / "link")
    assert len(os.listdir("/proc/self/fd")) == before


def test_other_users_can_neither_read_nor_write_a_terminal() -> None:
    with PtyPort() as port:
        assert os.stat(port.name).st_uid == os.getuid()
        # The group, tty, may write messages to it where the system is set so.
        assert os.stat(port.name).st_mode & 0o057 == 0


def test_a_directory_that_others_can_write_to_is_no_private_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    folder = tmp_path / "khep_twin"
    folder.mkdir()
    folder.chmod(0o777)
    with pytest.raises(PortError, match="not a directory of this user's alone"):
        private_folder()
    folder.rmdir()
    (tmp_path / "other").mkdir()
    folder.symlink_to(tmp_path / "other")
    with pytest.raises(PortError, match=r"not a directory of this user's alone|cannot make"):
        private_folder()


def test_bytes_that_found_no_room_before_their_host_left_are_not_the_next_one_s() -> None:
    with PtyPort() as port:
        host = opened(port)
        port.receive(100)
        os.write(host, b"N\n" * 500)
        assert port.receive(100).data == b"N\n" * 50
        assert port.receive(0).data == b""
        os.close(host)
        host = opened(port)
        os.write(host, b"B\n")
        received = port.receive(0)
        print(received.hosts_left, len(received.last_data), received.data[-20:], received.notices)
        assert received.hosts_left
        assert (received.last_data, received.data) == (b"N\n" * 450, b"B\n")
        assert len(received.notices) == 1
        os.close(host)


def test_a_write_that_was_read_early_and_reported_with_a_later_one_is_no_silent_crossing(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    with PtyPort() as port:
        host = opened(port)
        port.receive(100)
        os.write(host, b"N\n")
        with monkeypatch.context() as patch:
            # The bytes are there before the event that reports them.
            patch.setattr(OpenEvents, "drain", lambda _: ())
            assert port.receive(100).data == b"N\n"
        os.write(host, b"H\n")
        os.close(host)
        host = opened(port)
        os.write(host, b"B\n")
        received = port.receive(100)
        print(received)
        assert received.hosts_left
        assert received.data == b"B\n" or received.notices
        os.close(host)


def test_bytes_that_were_read_in_several_calls_do_not_hide_a_later_write_of_their_host() -> None:
    with PtyPort() as port:
        host = opened(port)
        port.receive(100)
        os.write(host, b"N\n" * 100)
        assert port.receive(100).data == b"N\n" * 50
        assert port.receive(100).data == b"N\n" * 50
        port.receive(100)
        os.write(host, b"H\n")
        os.close(host)
        host = opened(port)
        os.write(host, b"B\n")
        received = port.receive(100)
        assert (received.hosts_left, received.last_data, received.data) == (True, b"H\n", b"B\n")
        os.close(host)
