"""Folders written completely or not at all."""

from pathlib import Path

import pytest

from khep_twin.errors import KhepTwinError
from khep_twin.files.folders import atomic_folder


def test_what_appears_under_its_name_meanwhile_is_kept(tmp_path: Path) -> None:
    target = tmp_path / "data-v0"

    def write() -> None:
        with atomic_folder(target, False):
            target.mkdir()
            (target / "notes").write_text("a year's work")

    with pytest.raises(
        KhepTwinError, match=r"another file exists by now and is kept; the new one is .*data-v0\.kept"
    ):
        write()
    assert (target / "notes").read_text() == "a year's work"
    assert sorted(path.name for path in tmp_path.iterdir()) == ["data-v0", "data-v0.kept"]


def test_a_folder_is_there_when_it_is_complete_and_its_parents_only_then(tmp_path: Path) -> None:
    target = tmp_path / "new" / "folder"

    def fail() -> None:
        with atomic_folder(target, False) as folder:
            (folder / "file").touch()
            raise ValueError("broken")

    with pytest.raises(ValueError, match="broken"):
        fail()
    assert not [*tmp_path.iterdir()]
    with atomic_folder(target, False) as folder:
        (folder / "file").touch()
        assert not target.exists()
    assert [path.name for path in target.iterdir()] == ["file"]
