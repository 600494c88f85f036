"""Users' files: special files are refused without waiting, and input files are never replaced or moved."""

import os
import socket
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from mcap.writer import MCAP0_MAGIC

from khep_twin import playpen
from khep_twin.cli import app as cli
from khep_twin.errors import KhepTwinError, LogError
from khep_twin.files.atomic import atomic_file, write_atomic
from khep_twin.lab.experiment.controller_files import find_controller
from khep_twin.lab.experiment.series_files import read_series
from khep_twin.lab.sensor_test import sensor_files
from khep_twin.log.reader import read_log
from khep_twin.log.recover import recover
from khep_twin.log.tail import GrowingLog
from khep_twin.playpen import Playpen, bitmap_files
from khep_twin.ports.twin import TwinOptions, open_twin
from khep_twin.sensing import calibration
from khep_twin.sweep import study
from khep_twin.sweep.shards import work_of

LONG = 60.0
"""Time-out on a busy machine [s]."""

STUDY = """version = 1
name = "study"
playpens = ["default"]
controllers = ["braitenberg"]
seeds = 1
seconds = 1
output = "out"

[[{kind}]]
name = "one"
{key}
"""


def _genomes(path: Path) -> None:
    file = path.with_name("study.toml")
    file.write_text(STUDY.format(kind="network", key='genomes = "genomes.csv"'))
    work_of(study.load(file))


def _program(path: Path) -> None:
    file = path.with_name("study.toml")
    file.write_text(STUDY.format(kind="program", key='file = "program.py:mind"'))
    work_of(study.load(file))


def _log(path: Path) -> None:
    open_twin("default", TwinOptions(log=str(path.with_suffix(""))))


READERS: dict[str, tuple[str, Callable[[Path], object]]] = {
    "playpen": ("arena.toml", Playpen.load),
    "calibration": ("robot.toml", lambda path: calibration.read(str(path))),
    "bitmap": ("scan.mat", bitmap_files.read),
    "picture": ("scan.png", bitmap_files.read),
    "sensor test": ("run.csv", sensor_files.load),
    "log": ("run.mcap", read_log),
    "interrupted log": ("run.mcap.part", recover),
    "growing log": ("run.mcap.part", GrowingLog),
    "part of a new log": ("run.mcap.part", _log),
    "controller": ("mine.py", lambda path: find_controller(str(path))),
    "series": ("series.json", lambda path: read_series(path.parent)),
    "study": ("study.toml", study.load),
    "genomes": ("genomes.csv", _genomes),
    "program": ("program.py", _program),
}


@contextmanager
def special_file(kind: str, path: Path) -> Iterator[None]:
    """Create a special file under a name."""
    if kind == "pipe":
        os.mkfifo(path)
    elif kind == "socket":
        with socket.socket(socket.AF_UNIX) as end:
            end.bind(os.path.relpath(path))  # names of sockets are limited in length
            yield
        return
    elif kind == "device":
        path.symlink_to("/dev/zero")
    else:
        path.mkdir()
    yield


def failure(call: Callable[[], object]) -> BaseException | None:
    """Return the error of a call that must not block; None without."""
    failures: list[BaseException] = []

    def run() -> None:
        try:
            call()
        except BaseException as error:  # returned to the caller
            failures.append(error)

    thread = threading.Thread(target=run, daemon=True)
    thread.start()
    thread.join(LONG)
    assert not thread.is_alive(), "it waits"
    return failures[0] if failures else None


@pytest.mark.parametrize("kind", ["pipe", "socket", "device", "directory"])
@pytest.mark.parametrize("reader", READERS)
def test_what_is_no_file_is_refused_at_once(reader: str, kind: str, tmp_path: Path) -> None:
    name, call = READERS[reader]
    path = tmp_path / name
    with special_file(kind, path):
        status = path.lstat()
        error = failure(lambda: call(path))
        assert (path.lstat().st_ino, path.lstat().st_mode) == (status.st_ino, status.st_mode)
    assert isinstance(error, KhepTwinError), repr(error)
    message = str(error)
    assert name in message
    assert "\n" not in message
    expected = "this is no regular file; expected the name of a file"
    assert ("s a directory" if kind == "directory" else expected) in message


def test_a_log_moves_nothing_away_but_logs(tmp_path: Path, field: playpen.Playpen) -> None:
    arena = tmp_path / "run.mcap.part"
    arena.write_text(playpen.dump(field))
    with pytest.raises(LogError, match=r"run\.mcap\.part: this is no unfinished log; expected another name"):
        open_twin(str(arena), TwinOptions(log=str(tmp_path / "run.mcap")))
    assert [path.name for path in tmp_path.iterdir()] == ["run.mcap.part"]
    for torn in (b"", MCAP0_MAGIC[:3]):
        arena.write_bytes(torn)
        with open_twin(field, TwinOptions(log=str(tmp_path / "run.mcap"))):
            pass
        assert (tmp_path / "run.mcap.part.1").read_bytes() == torn
        (tmp_path / "run.mcap.part.1").unlink()


def test_a_file_that_is_written_takes_no_other_ones_name_meanwhile(tmp_path: Path) -> None:
    path, existing = tmp_path / "a.csv", [tmp_path / ".a.csv.part", tmp_path / ".a.csv.part1"]
    existing[0].write_text("mine")
    existing[1].symlink_to("nowhere")
    write_atomic(path, b"data")
    assert path.read_bytes() == b"data"
    assert existing[0].read_text() == "mine"
    assert os.readlink(existing[1]) == "nowhere"
    assert {*tmp_path.iterdir()} == {path, *existing}


@pytest.mark.parametrize(
    "command",
    [
        "playpen draw arena.png -o arena.png",
        "playpen draw arena.png -o linked.png",
        "playpen compile arena.png -o arena.png --force",
        "playpen import arena.png -o arena.png --force",
        "rollout --seconds 1 --playpen arena.png --picture arena.png",
        "run --seconds 1 --playpen arena.png --log run.mcap --picture arena.png",
        "fit run.csv=wall@22mm --start arena.png -o arena.png --force",
    ],
)
def test_what_is_read_is_not_replaced(
    command: str,
    tmp_path: Path,
    field: playpen.Playpen,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("arena.png").write_text(playpen.dump(field))
    Path("linked.png").symlink_to("arena.png")
    monkeypatch.setattr("sys.argv", ["khep-twin", *command.split()])
    with pytest.raises(SystemExit) as exit_error:
        cli.main()
    assert exit_error.value.code == 1
    name = "linked.png" if "linked" in command else "arena.png"
    message = f"khep-twin: {name}: this is an input file; expected a separate file\n"
    assert capsys.readouterr() == ("", message)
    assert Path("arena.png").read_text() == playpen.dump(field)
    assert {path.name for path in tmp_path.iterdir()} == {"arena.png", "linked.png"}


def test_a_file_is_on_the_disk_before_it_is_renamed_and_its_name_after(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Check the order that keeps the new file, not an empty or the old one, after a power failure."""
    calls: list[str] = []
    synchronize, rename, new_name = os.fsync, os.replace, os.link

    def fsync(descriptor: int) -> None:
        calls.append("folder" if os.path.isdir(f"/proc/self/fd/{descriptor}") else "file")
        assert calls[-1] == "folder" or os.fstat(descriptor).st_size == 4
        synchronize(descriptor)

    def replace(source: Path, target: Path) -> None:
        calls.append("rename")
        rename(source, target)

    def link(source: Path, target: Path) -> None:
        calls.append("name")
        new_name(source, target)

    monkeypatch.setattr(os, "fsync", fsync)
    monkeypatch.setattr(os, "replace", replace)
    monkeypatch.setattr(os, "link", link)
    write_atomic(tmp_path / "file", b"four")
    assert calls == ["file", "rename", "folder"]
    calls.clear()
    twin = open_twin("default", TwinOptions(log=str(tmp_path / "run.mcap")))
    monkeypatch.setattr(os, "fsync", lambda descriptor: calls.append("file"))
    twin.close()
    assert calls == ["file", "name"]


def test_a_file_that_is_replaced_keeps_who_may_read_it(tmp_path: Path) -> None:
    path = tmp_path / "mine.toml"
    path.touch(mode=0o600)
    write_atomic(path, b"new")
    assert path.read_bytes() == b"new"
    assert path.stat().st_mode & 0o777 == 0o600


def test_a_file_that_appears_while_another_is_written_is_kept(tmp_path: Path) -> None:
    """For example, under the name of a table that a command is computing."""
    path = tmp_path / "table.csv"

    def write() -> None:
        with atomic_file(path, replace=False) as file:
            file.write(b"rows")
            path.write_text("a year's work")

    for number in ("", ".2"):
        with pytest.raises(KhepTwinError, match=rf"the new one is .*/table\.kept{number}\.csv"):
            write()
    path.write_bytes(b"")
    with atomic_file(path, replace=False) as file:
        file.write(b"new")
    assert {file_path.name: file_path.read_bytes() for file_path in tmp_path.iterdir()} == {
        "table.csv": b"new",
        "table.kept.csv": b"rows",
        "table.kept.2.csv": b"rows",
    }
