"""The bottom line of a terminal, and the output above it."""

import os
import pty
import re
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from io import StringIO
from pathlib import Path

import pytest
import typer

from khep_twin.cli.progress import progress
from khep_twin.status_line import announced, status_line


class Terminal(StringIO):
    """A stream that says it is a terminal."""

    def isatty(self) -> bool:
        return True

    @property
    def screen(self) -> list[str]:
        """Lines as a person sees them in the end."""
        lines = [""]
        column = 0
        for part in re.split(r"(\r|\n|\033\[K)", self.getvalue()):
            if part == "\r":
                column = 0
            elif part == "\n":
                lines.append("")
                column = 0
            elif part == "\033[K":
                lines[-1] = lines[-1][:column]
            else:
                lines[-1] = lines[-1][:column] + part + lines[-1][column + len(part) :]
                column += len(part)
        return lines


@contextmanager
def at_a_terminal() -> Iterator[Terminal]:
    """One terminal at both outputs."""
    terminal = Terminal()
    with redirect_stdout(terminal), redirect_stderr(terminal):
        yield terminal


def test_lines_of_output_and_a_progress_bar_never_share_a_line() -> None:
    with at_a_terminal() as terminal:
        with progress() as show:
            assert show is not None
            for number in range(4):
                show(number / 4)
                typer.echo(f"run {number}")
                print("a warning", file=sys.stderr)
                print("in two", end="")
                show(number / 4 + 0.1)
                print(" parts")
                assert terminal.screen[-1].startswith("running  [#")
        typer.echo("the end")
    expected = [line for number in range(4) for line in (f"run {number}", "a warning", "in two parts")]
    assert terminal.screen == [*expected, "the end", ""]


def test_the_outputs_are_the_same_objects_again_after_a_bar() -> None:
    with at_a_terminal() as terminal:
        try:
            with progress():
                assert sys.stdout is not terminal
                raise KeyboardInterrupt
        except KeyboardInterrupt:
            pass
        assert sys.stdout is sys.stderr is terminal
    assert terminal.screen == [""]


def test_an_output_that_is_no_terminal_is_left_alone() -> None:
    piped = StringIO()
    with at_a_terminal(), redirect_stdout(piped), progress():
        assert sys.stdout is piped
        print("data")
    assert piped.getvalue() == "data\n"


def test_no_line_is_shown_where_another_program_may_print_on_the_terminal(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    reader, writer = os.pipe()
    with at_a_terminal() as terminal, open(writer, "w") as piped, redirect_stdout(piped):
        with status_line() as line, announced("begun", lambda: "amid", lambda: "ended"):
            assert line is None
        assert terminal.getvalue() == "begun\nended\n"
    os.close(reader)
    monkeypatch.setenv("TERM", "dumb")
    with at_a_terminal() as terminal, progress() as show:
        assert show is None
    assert terminal.getvalue() == ""


def test_long_work_shows_its_progress_in_place_of_the_bar_which_comes_back() -> None:
    looks = iter(range(100))
    with at_a_terminal() as terminal:
        with progress() as show:
            assert show is not None
            show(0.5)
            with announced("begun", lambda: f"compiling, look {next(looks)}", lambda: "ended"):
                end = time.monotonic() + 30
                while "compiling, look 1" not in terminal.getvalue() and time.monotonic() < end:
                    time.sleep(0.05)
                assert "compiling, look 0" in terminal.getvalue()
            assert "compiling, look 1" in terminal.getvalue()
            assert terminal.screen[0].startswith("running  [#####")
        with announced("begun", lambda: "alone", lambda: "ended"):
            pass
    assert terminal.screen == [""]
    assert "begun" not in terminal.getvalue()
    assert "ended" not in terminal.getvalue()


def test_where_nobody_looks_long_work_is_a_line_at_its_begin_and_one_at_its_end_and_a_bar_is_none(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    with status_line() as line, announced("begun", lambda: "amid", lambda: "ended"):
        assert line is None
        assert capsys.readouterr() == ("", "begun\n")
    assert capsys.readouterr() == ("", "ended\n")
    monkeypatch.setattr(sys, "stderr", None)
    with announced("begun", lambda: "amid", lambda: "ended"):
        pass


def test_a_run_on_a_real_terminal_has_its_lines_to_themselves(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("TERM", "xterm")
    file = tmp_path / "mine.py"
    file.write_text("def turn(robot):\n    robot.sleep(0.2)\n    print('from the controller')\n")
    words = ["-m", "khep_twin", "run", f"{file}:turn", "--cycles", "2", "--runs", "2"]
    pid, descriptor = pty.fork()
    if pid == 0:
        os.execv(sys.executable, [sys.executable, *words])
    shown = bytearray()
    try:
        while part := os.read(descriptor, 4096):
            shown += part
    except OSError:  # the terminal has gone with the program
        pass
    os.close(descriptor)
    assert os.waitpid(pid, 0)[1] == 0
    terminal = Terminal()
    terminal.write(shown.decode().replace("\r\n", "\n"))
    assert "running  [" in shown.decode()
    own = "from the controller"
    assert [re.sub(r"^run +(\d).*", r"run \1", line) for line in terminal.screen] == [
        *(own, own, "run 1", own, own, "run 2", "")
    ]
