"""Notes of servers in the private folder."""

from pathlib import Path

import pytest

from khep_twin.errors import PortError
from khep_twin.ports import service_registry
from khep_twin.ports.service_registry import registered_ports, served_ports


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setattr(service_registry, "private_folder", lambda: tmp_path)
    monkeypatch.setattr(service_registry.threading, "get_native_id", lambda: 1)
    return tmp_path


def test_what_is_registered_is_served_until_the_end(folder: Path) -> None:
    with registered_ports(["/dev/pts/1"], "default  playpen"):
        assert served_ports() == [("/dev/pts/1", "default playpen")]
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
