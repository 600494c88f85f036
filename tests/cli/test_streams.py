"""Standard streams that cannot be written, or without a reader: one line, and no data is lost."""

import errno
import os
import resource
import signal
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from functools import partial
from pathlib import Path

import pytest
from typer.testing import CliRunner

from khep_twin import playpen
from khep_twin.cli import app as cli
from khep_twin.host import Khepera
from khep_twin.log.reader import read_log

PROGRAM = (sys.executable, "-m", "khep_twin")

LONG = 120.0
"""How long anything may take on a busy machine [s]."""

FULL = "khep-twin: standard output: cannot be written: No space left on device\n"
CLOSED = "khep-twin: standard output: cannot be written: it is closed\n"

TALKS = """import sys

def controller(robot):
    print("at", robot.time)
    sys.stdout.close()
    robot.set_speed(5, 5)
"""

full = pytest.mark.skipif(not os.path.exists("/dev/full"), reason="/dev/full is Linux's")


@contextmanager
def started(
    words: Sequence[str], folder: Path, output: str, errors: str = "pipe"
) -> Iterator["subprocess.Popen[str]"]:
    """A command with streams that are "full", "closed", "unread" or a "pipe"."""
    kinds = {1: output, 2: errors}

    def close() -> None:
        for number, kind in kinds.items():
            if kind == "closed":
                os.close(number)

    with ExitStack() as stack:
        streams: list[int] = []
        for kind in kinds.values():
            if kind == "full":
                streams.append(os.open("/dev/full", os.O_WRONLY))
            elif kind == "unread":
                reader, writer = os.pipe()
                os.close(reader)
                streams.append(writer)
            else:
                streams.append(subprocess.PIPE)
                continue
            stack.callback(os.close, streams[-1])
        process = subprocess.Popen(
            [*PROGRAM, *words],
            stdin=subprocess.DEVNULL,
            stdout=streams[0],
            stderr=streams[1],
            cwd=folder,
            text=True,
            preexec_fn=close,
        )
        stack.callback(process.kill)
        yield process


def run(words: str, folder: Path, output: str, errors: str = "pipe") -> tuple[int, str]:
    """A command's exit code, and what it says."""
    with started(words.split(), folder, output, errors) as process:
        error_text = process.communicate(timeout=LONG)[1]
        return process.returncode, error_text or ""


@pytest.mark.share(4)
@full
@pytest.mark.parametrize("words", ["playpen list", "--help", "playpen compile default", "run --help"])
def test_output_that_is_full_is_one_line(words: str, tmp_path: Path) -> None:
    assert run(words, tmp_path, "full") == (1, FULL)


@pytest.mark.parametrize(
    ("output", "ends"),
    [
        pytest.param("full", (1, FULL), marks=full),
        pytest.param("closed", (1, CLOSED), marks=pytest.mark.long),
        pytest.param("unread", (128 + signal.SIGPIPE, ""), marks=pytest.mark.long),
    ],
)
def test_a_run_that_cannot_print_keeps_its_log_and_its_picture(
    output: str, ends: tuple[int, str], tmp_path: Path
) -> None:
    (tmp_path / "talks.py").write_text(TALKS)
    words = "run talks.py --cycles 20 --log run.mcap --picture run.png --save series"
    assert run(words, tmp_path, output) == ends
    assert len(read_log(tmp_path / "run.mcap").robots["khepera0"].serial) >= 40
    assert (tmp_path / "run.png").read_bytes().startswith(b"\x89PNG")
    assert len((tmp_path / "series" / "runs.csv").read_text().splitlines()) == 2
    assert not [*tmp_path.glob("*.part")]


@pytest.mark.share(3)
@pytest.mark.parametrize("change", ["sys.stdout.close()", "sys.stdout = None", "sys.stderr = None"])
def test_a_program_may_put_anything_in_a_streams_place(change: str, tmp_path: Path) -> None:
    (tmp_path / "mine.py").write_text(f"import sys\n\ndef after(run):\n    {change}\n")
    words = "run braitenberg --cycles 3 --on-run-end mine.py --log run.mcap"
    assert run(words, tmp_path, "pipe") == (0, "")
    assert read_log(tmp_path / "run.mcap").robots["khepera0"].serial


def test_a_series_whose_reader_has_gone_ends_after_its_run(tmp_path: Path) -> None:
    words = "run --cycles 2 --runs 90000 --save series"
    assert run(words, tmp_path, "unread") == (128 + signal.SIGPIPE, "")
    assert len((tmp_path / "series" / "runs.csv").read_text().splitlines()) == 2


@pytest.mark.share(3)
@pytest.mark.parametrize("errors", ["closed", "full", "unread"])
def test_trouble_that_cannot_be_reported_is_in_the_exit_code(errors: str, tmp_path: Path) -> None:
    assert run("run nobody.py", tmp_path, "pipe", errors) == (1, "")
    assert run("run --seconds -1", tmp_path, "pipe", errors) == (2, "")
    assert run("playpen list", tmp_path, "pipe", errors) == (0, "")


@pytest.mark.share(3)
@pytest.mark.parametrize(("output", "code"), [("closed", 1), ("full", 1), ("unread", 128 + signal.SIGPIPE)])
def test_a_server_that_cannot_print_its_path_serves_all_the_same(
    output: str, code: int, tmp_path: Path
) -> None:
    words = ["serve", "--link", "./robot", "--log", "run.mcap"]
    with started(words, tmp_path, output) as process:
        deadline = time.monotonic() + LONG
        # What is served is told before the first byte is taken.
        while not (tmp_path / "robot").is_symlink() and process.poll() is None:
            assert time.monotonic() < deadline
            time.sleep(0.02)
        with Khepera(str(tmp_path / "robot")) as robot:
            robot.versions()
        process.terminate()
        errors = process.communicate(timeout=LONG)[1]
    assert process.returncode == code, errors
    assert errors.count("cannot be written") == (output != "unread")
    assert "Traceback" not in errors
    assert read_log(tmp_path / "run.mcap").robots["khepera0"].serial


def test_too_few_descriptors_are_one_line() -> None:
    def allow(number: int, limit: int) -> None:
        resource.setrlimit(resource.RLIMIT_NOFILE, (number, limit))

    for words in (["run", "--cycles", "5"], ["serve"], ["design", "--no-browser"]):
        process = subprocess.run(
            [*PROGRAM, *words],
            capture_output=True,
            text=True,
            timeout=LONG,
            preexec_fn=lambda: allow(8, 8),
        )
        message = "khep-twin: 8 files may be open at once; expected 64 or more, see ulimit -n\n"
        assert (process.returncode, process.stdout, process.stderr) == (1, "", message)
    # A lower limit of one's own choice is raised.
    set_limit = partial(allow, 8, resource.getrlimit(resource.RLIMIT_NOFILE)[1])
    process = subprocess.run(
        [*PROGRAM, "playpen", "list"], capture_output=True, timeout=LONG, preexec_fn=set_limit
    )
    assert (process.returncode, process.stderr) == (0, b"")


def test_a_descriptor_that_runs_out_later_is_one_line(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def refuse() -> list[str]:
        raise OSError(errno.EMFILE, os.strerror(errno.EMFILE))

    monkeypatch.setattr(playpen, "names", refuse)
    monkeypatch.setattr(sys, "argv", ["khep-twin", "playpen", "list"])
    with pytest.raises(SystemExit) as ended:
        cli.main()
    assert ended.value.code == 1
    expected = "expected fewer that are open, or more that may be: ulimit -n"
    assert capsys.readouterr() == ("", f"khep-twin: Too many open files; {expected}\n")


def test_a_current_directory_that_is_gone_is_one_line_where_it_is_needed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "gone").mkdir()
    monkeypatch.chdir(tmp_path / "gone")
    (tmp_path / "gone").rmdir()
    message = "khep-twin: the current directory no longer exists; expected an existing one\n"
    for words, code, printed in (
        ("run --cycles 3", 0, ("3 cycles in 0.1 s", "")),
        ("design --no-browser", 1, ("", message.strip())),
    ):
        monkeypatch.setattr(sys, "argv", ["khep-twin", *words.split()])
        with pytest.raises(SystemExit) as ended:
            cli.main()
        assert ended.value.code == code
        output, errors = capsys.readouterr()
        assert (output.partition("\n")[0], errors.strip()) == printed


@pytest.mark.parametrize("kind", ["-1", "0", "1", "2", "2147483648", "9" * 30, "shut", "read", "own"])
def test_a_ready_fd_that_was_not_given_to_write_to_is_refused(kind: str) -> None:
    reader, writer = os.pipe()
    os.set_inheritable(reader, True)
    if kind == "shut":
        os.close(writer)
    number = {"shut": writer, "read": reader, "own": writer}.get(kind, kind)
    result = CliRunner().invoke(cli.app, ["serve", "default", f"--ready-fd={number}"])
    os.close(reader)
    if kind != "shut":
        os.close(writer)
    trouble = {"shut": "is not open; ", "own": "is not open; ", "read": "is not open for writing; "}
    expected = "expected 3 or above, open for writing, such as --ready-fd 3 3>ready"
    assert result.exit_code == 2
    assert result.stderr == f"khep-twin: --ready-fd {number}: {trouble.get(kind, '')}{expected}\n"
