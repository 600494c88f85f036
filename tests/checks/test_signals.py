"""Processes that are asked to end by a signal; the check signals ends 1,000 commands at random moments."""

import os
import signal
import subprocess
import sys
import textwrap
from collections.abc import Sequence
from pathlib import Path

import pytest
from forked import Forked

from checks.signals import KINDS, end_command
from khep_twin.errors import StoppedError
from khep_twin.host import Khepera
from khep_twin.log.reader import read_log

PROGRAM = (sys.executable, "-m", "khep_twin")

LONG = 60.0
"""How long anything may take on a busy machine [s]."""

HANGING = {
    "loops": "while True: pass",
    "sleeps": "time.sleep(1000)",
    "moves on": """
        while True:
            try:
                while True:
                    robot.set_speed(5, 5)
            except BaseException:
                pass
    """,
    "asks on": """
        while True:
            try:
                while True:
                    robot.proximity()
            except BaseException:
                pass
    """,
    # A mutex that is locked twice: a wait in C that no signal ends.
    "waits in C": """
        mutex = ctypes.create_string_buffer(64)
        libc.pthread_mutex_lock(mutex)
        libc.pthread_mutex_lock(mutex)
    """,
}


def started(
    words: Sequence[str], folder: Path, hang_up: signal.Handlers = signal.SIG_DFL, **variables: str
) -> "subprocess.Popen[str]":
    """A process that hears all signals, also those that whoever runs the tests has switched off."""

    def on_bytes() -> None:
        signal.signal(signal.SIGINT, signal.SIG_DFL)
        signal.signal(signal.SIGHUP, hang_up)

    executed = {} if hang_up == signal.SIG_DFL and "PYTHONPATH" not in variables else {"preexec_fn": on_bytes}
    return (subprocess.Popen if executed else Forked)(
        words,
        cwd=folder,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env=os.environ | variables,
        **executed,
    )


def ended(process: "subprocess.Popen[str]", *numbers: signal.Signals) -> tuple[int, str]:
    """Waits for its first line and sends signals, each after what was said about the one before."""
    assert process.stdout is not None
    assert process.stderr is not None
    errors = ""
    with process:
        assert process.stdout.readline() == "here\n"
        for number in numbers[:-1]:
            process.send_signal(number)
            errors += process.stderr.readline()
        process.send_signal(numbers[-1])
        errors += process.communicate(timeout=LONG)[1]
    return process.returncode, errors


def script(text: str) -> list[str]:
    """A command that does as its text says, with signals handled."""
    head = """
        import os, signal, sys, time
        from khep_twin.process.signals import block_signals, handle_signals, first_signal
        from khep_twin.process.signals import register_cleanup, stopping
        def here():
            print("here", flush=True)
    """
    return [sys.executable, "-c", textwrap.dedent(head) + textwrap.dedent(text)]


@pytest.mark.share(4)
@pytest.mark.parametrize(
    ("how", "number"),
    [
        ("loops", signal.SIGINT),
        ("sleeps", signal.SIGTERM),
        ("moves on", signal.SIGHUP),
        ("asks on", signal.SIGINT),
        ("waits in C", signal.SIGTERM),
    ],
)
def test_a_second_signal_ends_a_run_whose_controller_never_returns(
    how: str, number: signal.Signals, tmp_path: Path
) -> None:
    text = (
        "import ctypes, time\nlibc = ctypes.CDLL(None)\ndef controller(robot):\n    robot.set_speed(5, 5)\n"
    )
    text += "    print('here', flush=True)\n" + textwrap.indent(textwrap.dedent(HANGING[how]), "    ")
    (tmp_path / "mine.py").write_text(text)
    process = started([*PROGRAM, "run", "mine.py", "--log", "run.mcap"], tmp_path)
    code, errors = ended(process, number, number)
    assert code == 128 + number
    first = f"khep-twin: {number.name}: stopping the motors, waiting for the end of this cycle; ends in 3 s"
    assert errors.startswith(first)
    assert "Traceback" not in errors
    assert sorted(path.name for path in tmp_path.iterdir()) == ["mine.py", "run.mcap"]
    lines = [line.text for line in read_log(tmp_path / "run.mcap").robots["khepera0"].serial]
    assert [line for line in lines if line.startswith("D")][-1] == "D,0,0"


@pytest.mark.parametrize("cause", ["error", "None"])
def test_an_interruption_that_a_library_makes_an_error_of_is_still_one(cause: str, tmp_path: Path) -> None:
    text = f"""
        try:
            with handle_signals():
                try:
                    here()
                    time.sleep(1000)
                except BaseException as error:
                    raised = {cause}
                raise ValueError("an error of the library's own") from raised
        except KeyboardInterrupt:
            print("ended by", first_signal(), file=sys.stderr)
    """
    code, errors = ended(started(script(text), tmp_path), signal.SIGTERM)
    # A process that is slow to end, on a busy machine, first says so.
    assert (code, errors.splitlines()[-1]) == (0, "ended by 15")


def test_what_does_not_end_is_ended_without_a_second_signal(tmp_path: Path) -> None:
    text = """
        clear = lambda: open("cleared", "w").close()
        with handle_signals(), stopping("waiting for nothing"):
            register_cleanup(clear)
            here()
            while True:
                try:
                    time.sleep(1000)
                except KeyboardInterrupt:
                    print("interrupted", file=sys.stderr)
    """
    code, errors = ended(started(script(text), tmp_path), signal.SIGTERM)
    assert code == 143
    assert errors == (
        "khep-twin: SIGTERM: waiting for nothing; ends in 3 s at most, or at another signal\ninterrupted\n"
    )
    assert (tmp_path / "cleared").exists()


@pytest.mark.long
def test_what_comes_to_its_end_by_itself_is_not_interrupted(tmp_path: Path) -> None:
    text = """
        with handle_signals():
            with stopping() as stop:
                here()
                while not stop():
                    time.sleep(0.01)
            time.sleep(4)
            print("whole", first_signal(), file=sys.stderr)
    """
    assert ended(started(script(text), tmp_path), signal.SIGHUP) == (0, "whole 1\n")


def test_a_controller_that_hangs_as_it_is_loaded_is_ended(tmp_path: Path) -> None:
    (tmp_path / "mine.py").write_text("import time\nprint('here', flush=True)\ntime.sleep(1000)\n")
    process = started([*PROGRAM, "run", "mine.py"], tmp_path)
    code, errors = ended(process, signal.SIGTERM, signal.SIGTERM)
    assert code == 143
    assert errors == "khep-twin: SIGTERM: coming to an end; ends in 3 s at most, or at another signal\n"


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_a_signal_before_the_commands_are_there_ends_it_without_a_trace(
    number: signal.Signals, tmp_path: Path
) -> None:
    slow = tmp_path / "slow"
    slow.mkdir()
    (slow / "typer.py").write_text("import time\nprint('here', flush=True)\ntime.sleep(1000)\n")
    path = os.pathsep.join([str(slow), os.environ.get("PYTHONPATH", ""), str(Path(__file__).parents[2])])
    assert ended(started(PROGRAM, tmp_path, PYTHONPATH=path), number) == (-number, "")


def test_a_module_is_imported_whole_before_it_is_interrupted(tmp_path: Path) -> None:
    (tmp_path / "slow.py").write_text(
        "import time\nprint('here', flush=True)\ntime.sleep(1)\nopen('whole', 'w').close()\n"
    )
    text = """
        sys.path.insert(0, "")
        try:
            with handle_signals():
                import slow
                time.sleep(1000)
        except KeyboardInterrupt:
            sys.exit(128 + first_signal())
    """
    code, errors = ended(started(script(text), tmp_path), signal.SIGHUP)
    assert code == 129, errors
    assert (tmp_path / "whole").exists()


def test_what_is_not_to_be_disturbed_is_done_before_it_is_interrupted(tmp_path: Path) -> None:
    text = """
        try:
            with handle_signals(), block_signals():
                with block_signals():
                    here()
                    while not first_signal():
                        time.sleep(0.01)
                open("done", "w").close()
        except KeyboardInterrupt:
            sys.exit(3)
    """
    assert ended(started(script(text), tmp_path), signal.SIGTERM) == (3, "")
    assert (tmp_path / "done").exists()


def test_a_hang_up_that_nohup_ignores_stays_ignored(tmp_path: Path) -> None:
    text = """
        with handle_signals(), stopping() as stop:
            os.kill(os.getpid(), signal.SIGHUP)
            here()
            while not stop():
                time.sleep(0.01)
        print(first_signal(), file=sys.stderr)
    """
    process = started(script(text), tmp_path, hang_up=signal.SIG_IGN)
    assert ended(process, signal.SIGTERM) == (0, "15\n")


def test_a_signal_to_a_fork_is_the_forks_alone(tmp_path: Path) -> None:
    text = """
        import warnings
        warnings.simplefilter("ignore", DeprecationWarning)  # of a fork beside another thread, from 3.12 on
        with handle_signals(), stopping() as stop:
            if not (child := os.fork()):
                time.sleep(1000)
            os.kill(child, signal.SIGTERM)
            print(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]), stop(), file=sys.stderr)
            here()
            while not stop():
                time.sleep(0.01)
        print(first_signal(), file=sys.stderr)
    """
    assert ended(started(script(text), tmp_path), signal.SIGINT) == (0, "-15 False\n2\n")


def test_a_robot_that_is_held_stands_and_is_not_moved_any_more() -> None:
    with Khepera("khep://default") as robot:
        robot.set_speed(5, 5)
        robot.hold()
        assert robot.port.twin.robot.registers is not None
        for move in (
            lambda: robot.set_speed(1, 0),
            lambda: robot.set_target(9, 9),
            lambda: robot.ask("P,1,1"),
        ):
            with pytest.raises(StoppedError, match="is not sent, as the run is to end"):
                move()
        robot.sleep(1)
        assert tuple(robot.speed()) == (0, 0)
        robot.set_speed(0, 0)


@pytest.mark.share(12)
@pytest.mark.parametrize("name", [name for name in KINDS if "hangs" not in name])
def test_a_command_that_is_ended_at_a_random_moment_leaves_nothing_behind(name: str) -> None:
    problems = end_command(name, 4, has_started=True)
    # How long it takes on a busy machine is for `python -m checks signals` to say.
    assert not [fault for fault in problems.faults if not fault.startswith("took")]
