"""Notes of servers in the private folder."""

from pathlib import Path

import pytest

from khep_twin.errors import PortError
from khep_twin.ports import service_registry
from khep_twin.ports.service_registry import registered_ports, served_ports, served_speed


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setattr(service_registry, "private_folder", lambda: tmp_path)
    monkeypatch.setattr(service_registry.threading, "get_native_id", lambda: 1)
    return tmp_path


def test_what_is_registered_is_served_until_the_end(folder: Path) -> None:
    with registered_ports(["/dev/pts/1"], "default  playpen"):
        assert served_ports() == [("/dev/pts/1", "default playpen", 1.0)]
    assert not [*folder.iterdir()]


def test_a_full_disk_is_said_in_one_line(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The note could be opened but not written, which ended the twin of a page."""
    monkeypatch.setattr(service_registry, "_is_locked", lambda _: True)
    (folder / "1.served").symlink_to("/dev/full")
    with pytest.raises(PortError, match=r"1\.served: cannot be written: No space left on device"):
        with registered_ports(["/dev/pts/1"], "default"):
            raise AssertionError
    assert not [*folder.iterdir()]


def test_a_server_that_ends_while_it_is_listed_is_not_listed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(service_registry, "private_folder", lambda: tmp_path)
    note = tmp_path / "1.served"
    note.touch()

    def ended_at_once(note: Path) -> bool:
        note.unlink()
        return True

    monkeypatch.setattr(service_registry, "_is_locked", ended_at_once)
    assert served_ports() == []


def test_the_speed_of_a_server_is_that_of_each_name_of_its_port(folder: Path) -> None:
    link = folder / "khepera"
    link.symlink_to("/dev/pts/1")
    with registered_ports([str(link), "socket://127.0.0.1:5000"], "default", 0.25):
        for name in (str(link), "/dev/pts/1", "socket://localhost:5000"):
            assert served_speed(name) == 0.25
        for name in ("/dev/pts/2", "socket://localhost:5001", "rfc2217://127.0.0.1:5000", "socket://[::1"):
            assert served_speed(name) == 1.0


def test_an_entry_without_a_speed_is_not_listed(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(service_registry, "_is_locked", lambda _: True)
    (folder / "1.served").write_text("default\n/dev/pts/1")
    assert served_ports() == []
    assert served_speed("/dev/pts/1") == 1.0
