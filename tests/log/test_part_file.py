"""Unfinished logs: two runs of one name that begin or end at the same moment."""

import errno
import fcntl
import os
from functools import partial
from pathlib import Path

import pytest
from mcap.writer import MCAP0_MAGIC

from khep_twin.errors import LogError
from khep_twin.log.log_file import LogFile, PartFile, rename_unfinished
from khep_twin.log.reader import read_label


def test_the_remains_of_a_crash_are_locked_until_they_are_renamed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Otherwise a second run moves the file that the first has made under the name since."""
    part, rename, refused = tmp_path / "run.mcap.part", os.replace, list[str]()
    part.write_bytes(MCAP0_MAGIC)

    def amid(before: Path, after: Path) -> None:
        monkeypatch.setattr(os, "replace", rename)
        with pytest.raises(LogError) as error:
            rename_unfinished(part)
        refused.append(str(error.value))
        rename(before, after)

    monkeypatch.setattr(os, "replace", amid)
    assert rename_unfinished(part) == tmp_path / "run.mcap.part.1"
    assert refused == [f"{part}: another run is writing it; expected another name for the log"]


def test_a_file_that_another_run_took_before_it_was_locked_is_given_up(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    part, lock = tmp_path / "run.mcap.part", fcntl.flock

    def late(descriptor: int, operation: int) -> None:
        monkeypatch.setattr(fcntl, "flock", lock)
        assert rename_unfinished(part) == tmp_path / "run.mcap.part.1"
        lock(descriptor, operation)

    monkeypatch.setattr(fcntl, "flock", late)
    with pytest.raises(LogError, match="another run is writing it"):
        PartFile(part)
    assert not part.exists()


def test_a_log_that_was_finished_meanwhile_is_no_remains(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path, lock = tmp_path / "run.mcap", fcntl.flock
    log = LogFile(path, lambda: 0)

    def late(file: object, operation: int) -> None:
        monkeypatch.setattr(fcntl, "flock", lock)
        log.finish()
        lock(file, operation)  # type: ignore[arg-type]

    monkeypatch.setattr(fcntl, "flock", late)
    assert rename_unfinished(log.part) is None
    assert [path.name for path in tmp_path.iterdir()] == ["run.mcap"]


def test_a_run_that_is_given_up_removes_its_own_file_only(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It is locked until its name is gone, so that no other run's file can be under it."""
    log, close = LogFile(tmp_path / "run.mcap", lambda: 0), PartFile.close

    def amid(self: PartFile) -> None:
        assert not log.part.exists()
        close(self)

    monkeypatch.setattr(PartFile, "close", amid)
    log.discard()
    assert not log.open


def test_a_log_that_cannot_be_removed_does_not_hide_why_its_run_has_not_begun(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    log = LogFile(tmp_path / "run.mcap", lambda: 0)

    def refuse(path: Path, missing_ok: bool = False) -> None:
        raise OSError(errno.EROFS, "Read-only file system")

    monkeypatch.setattr(Path, "unlink", refuse)
    log.discard()
    assert not log.open


@pytest.mark.parametrize("occupant", ["nothing", "an earlier log", "a link"])
@pytest.mark.parametrize("links", [True, False])
def test_a_file_that_appears_under_a_logs_name_meanwhile_is_kept(
    occupant: str, links: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path, file = tmp_path / "run.mcap", tmp_path / ("other.mcap" if occupant == "a link" else "run.mcap")
    if occupant == "a link":
        path.symlink_to(file)
    if occupant == "an earlier log":
        path.write_bytes(MCAP0_MAGIC)
    if not links:
        monkeypatch.setattr(os, "link", _no_links)
    log = LogFile(path, lambda: 0)
    log.describe({}, {"robots": "khepera0"})
    file.write_text("a year's work")
    kept_log = file.with_name(f"{file.stem}.kept.mcap")
    with pytest.raises(LogError) as error:
        log.finish()
    assert str(error.value) == (f"{path}: another file exists by now and is kept; the new one is {kept_log}")
    assert file.read_text() == "a year's work"
    assert read_label(kept_log).robots == ("khepera0",)
    assert sorted(tmp_path.iterdir()) == sorted({path, file, kept_log})


@pytest.mark.parametrize("link_error", [None, errno.EPERM, errno.ENOTSUP, errno.EINVAL])
def test_a_log_takes_the_place_of_what_was_there_at_its_beginning(
    link_error: int | None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    if link_error is not None:
        monkeypatch.setattr(os, "link", partial(_no_links, error=link_error))
    for before in (None, b"", MCAP0_MAGIC):
        if before is not None:
            (tmp_path / "run.mcap").write_bytes(before)
        log = LogFile(tmp_path / "run.mcap", lambda: 0)
        log.describe({}, {"robots": "khepera0"})
        log.finish()
        assert read_label(tmp_path / "run.mcap").robots == ("khepera0",)
    assert [path.name for path in tmp_path.iterdir()] == ["run.mcap"]


def _no_links(*_: object, error: int = errno.EPERM) -> None:
    raise OSError(error, "this file system has no hard links")
