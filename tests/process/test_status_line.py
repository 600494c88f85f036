"""The bottom line of a terminal, and the output above it."""

import os
import pty
import re
import socket
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, redirect_stdout
from io import StringIO
from pathlib import Path
from types import SimpleNamespace

import pytest
import typer
from terminals import Terminal, at_a_terminal

from khep_twin.cli import app, shadow, shadow_process
from khep_twin.cli.endpoints import EndpointOptions, print_end
from khep_twin.cli.option_groups import LogOptions
from khep_twin.cli.options import notify
from khep_twin.cli.progress import progress
from khep_twin.process.status_line import STATUS_LINE_VARIABLE, announced, beside_status_line, status_line
from khep_twin.robots.registry import default_model


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


@pytest.mark.parametrize("kind", ["pipe", "socket"])
def test_no_line_is_shown_where_another_program_may_print_on_the_terminal(
    kind: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    reader, writer = os.pipe() if kind == "pipe" else (endpoint.detach() for endpoint in socket.socketpair())
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


def test_what_is_said_during_long_work_has_its_own_lines() -> None:
    with at_a_terminal() as terminal, announced("begun", lambda: "compiling", lambda: "ended"):
        end = time.monotonic() + 30
        while "compiling" not in terminal.getvalue() and time.monotonic() < end:
            time.sleep(0.01)
        notify("the robot has restarted")
        print("data")
    assert terminal.screen == ["khep-twin: the robot has restarted", "data", ""]


def test_lines_beside_another_process_with_a_status_line_are_whole_and_in_its_place() -> None:
    with at_a_terminal() as terminal:
        with beside_status_line():
            terminal.write("\r\033[K1.0 s  no alarm")
            print("in two", end="")
            terminal.write("\r\033[K1.1 s  no alarm")
            print(" parts\nand more")
            terminal.write("\r\033[K1.2 s  no alarm")
            notify("the end")
        assert sys.stdout is sys.stderr is terminal
    assert terminal.screen == ["in two parts", "and more", "khep-twin: the end", ""]


@pytest.mark.parametrize("output", ["terminal", "file"])
def test_a_relay_never_writes_onto_the_status_line_of_its_shadow(
    output: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("TERM", "xterm")

    @contextmanager
    def run_beside(words: Sequence[str], stop: object) -> Iterator[SimpleNamespace]:
        print("\r\033[K2.4 s  100, 200 mm +- 5, 0 degrees  no alarm", end="", file=sys.stderr)
        yield SimpleNamespace(make_listener=None, finish=lambda: 0)

    def relays(*_: object, **__: object) -> None:
        print_end(2_500_000_000, 0, LogOptions(), None)

    monkeypatch.setattr(shadow_process, "run_shadow", run_beside)
    monkeypatch.setattr(shadow, "relay_robot", relays)
    with at_a_terminal() as terminal, (tmp_path / "out.txt").open("w") as file:
        with redirect_stdout(terminal if output == "terminal" else file):
            shadow._relay_with_shadow("", 9600, [], EndpointOptions(), LogOptions(), default_model(), [])  # pyright: ignore[reportPrivateUsage]
    assert terminal.screen == ["2.5 s served", ""]


def test_a_viewer_of_a_shadow_never_writes_onto_its_status_line(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(STATUS_LINE_VARIABLE, "1")
    monkeypatch.setattr(sys, "argv", ["khep-twin", "view", "--live", "nowhere/shadow.mcap"])
    monkeypatch.setenv("RUST_LOG", "off")  # as the command sets it
    with at_a_terminal() as terminal:
        terminal.write("\r\033[K2.4 s  no alarm")
        with pytest.raises(SystemExit):
            app.main()
    assert terminal.screen[0].startswith("khep-twin: nowhere/shadow.mcap: no run writes this log")
    assert STATUS_LINE_VARIABLE not in os.environ


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
    screen = bytearray()
    try:
        while part := os.read(descriptor, 4096):
            screen += part
    except OSError:  # the terminal has gone with the program
        pass
    os.close(descriptor)
    assert os.waitpid(pid, 0)[1] == 0
    terminal = Terminal()
    terminal.write(screen.decode().replace("\r\n", "\n"))
    assert "running  [" in screen.decode()
    controller_text = "from the controller"
    assert [re.sub(r"^run +(\d).*", r"run \1", line) for line in terminal.screen] == [
        *(controller_text, controller_text, "run 1", controller_text, controller_text, "run 2", "")
    ]
