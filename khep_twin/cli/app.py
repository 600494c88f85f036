"""The command line: `khep-twin COMMAND`. Each command calls into the package and prints.

Each command imports its modules inside its function, so that `khep-twin --help` starts fast.
"""

import errno
import os
import sys
import warnings
from collections.abc import Callable
from contextlib import nullcontext
from functools import partial
from typing import Annotated, Any

import typer
from typer.exceptions import TyperException

from khep_twin import __version__
from khep_twin.cli.branch import branch
from khep_twin.cli.calibrate import calibrate
from khep_twin.cli.challenge import challenge_app
from khep_twin.cli.compile import compile_all
from khep_twin.cli.completion import complete_in_bash, explain_error
from khep_twin.cli.conform import conform
from khep_twin.cli.design import design
from khep_twin.cli.drive import drive
from khep_twin.cli.exec import execute
from khep_twin.cli.fit import fit
from khep_twin.cli.log import recover, repeat
from khep_twin.cli.options import Commands, notify
from khep_twin.cli.playpen import playpen_app
from khep_twin.cli.ports import ports
from khep_twin.cli.report import export, report
from khep_twin.cli.rollout import rollout
from khep_twin.cli.ros import ros
from khep_twin.cli.run import run
from khep_twin.cli.sense import sense
from khep_twin.cli.series import new, series
from khep_twin.cli.serve import serve
from khep_twin.cli.shadow import shadow
from khep_twin.cli.streams import exit_code
from khep_twin.cli.sweep import sweep
from khep_twin.cli.view import view
from khep_twin.errors import EXTRAS, KhepTwinError, MissingExtraError, user_error_text
from khep_twin.process.signals import first_signal, handle_signals, leave
from khep_twin.process.status_line import STATUS_LINE_VARIABLE, beside_status_line

app = typer.Typer(
    name="khep-twin",
    help="A physics-based digital twin of the Khepera miniature robot.",
    cls=Commands,
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
)
app.add_typer(playpen_app, name="playpen")
app.add_typer(challenge_app, name="challenge")
_RUNS = (run, rollout, series, sweep, new, design)
_PORTS = (serve, shadow, ports, drive, ros)
_LOGS = (view, report, export, recover, repeat, branch)
_MEASUREMENTS = (sense, fit, calibrate)
for command in _RUNS + _PORTS + _LOGS + _MEASUREMENTS:
    app.command()(command)
app.command("compile")(compile_all)
app.command()(conform)
app.command("exec")(execute)


def main() -> None:
    """Run the command line; an error prints one line instead of a traceback."""
    if os.environ.get("_KHEP_TWIN_COMPLETE") == "complete_bash":
        complete_in_bash(lambda: app(prog_name="khep-twin"))
    with beside_status_line() if os.environ.pop(STATUS_LINE_VARIABLE, None) else nullcontext():
        code = _run_app()
    # Typer has one exit code for all interruptions; shells expect one per signal.
    leave(exit_code(128 + first_signal() if code == 130 and first_signal() else code))


def _print_warning(
    show_others: Callable[..., None], message: Warning | str, category: type[Warning], *location: Any
) -> None:
    """Print a `UserWarning` as one line; pass others to `show_others`."""
    if category is UserWarning:
        notify(str(message))
    else:
        show_others(message, category, *location)


_WRITE_ERRORS = errno.EROFS, errno.EACCES, errno.ENOSPC


def _run_app() -> int:
    """Run the command; print its error, if any; return the exit code."""
    try:
        with handle_signals(), warnings.catch_warnings():
            warnings.showwarning = partial(_print_warning, warnings.showwarning)
            return app(prog_name="khep-twin", standalone_mode=False) or 0
    except KeyboardInterrupt:
        return 130
    except KhepTwinError as error:
        text, code = str(error), 1
    except ModuleNotFoundError as error:
        package = (error.name or "").partition(".")[0]
        if package not in EXTRAS:
            raise
        text, code = str(MissingExtraError(package, EXTRAS[package])), 1
    except OSError as error:
        code = 1
        if error.errno in (errno.EMFILE, errno.ENFILE):
            text = f"{error.strerror}; expected fewer that are open, or more that may be: ulimit -n"
        elif _is_cwd_missing():
            text = "the current directory no longer exists; expected an existing one"
        elif (reason := user_error_text(error)) is not None:
            text = reason
        elif error.errno in _WRITE_ERRORS and error.filename is not None:
            text = f"{error.filename}: {error.strerror}; expected a folder that can be written"
        else:
            raise
    except TyperException as error:
        text, code = explain_error(error, error.format_message()), error.exit_code
        if "\n" in text:  # the help, as no command was typed
            print(text, file=sys.stderr)
            return code
    for line in text.splitlines():
        print(f"khep-twin: {line}", file=sys.stderr)
    return code


def _is_cwd_missing() -> bool:
    try:
        os.getcwd()
    except FileNotFoundError:
        return True
    return False


def _show_version(value: bool) -> None:
    if value:
        typer.echo(f"khep-twin {__version__}")
        raise typer.Exit


@app.callback()
def common(
    version: Annotated[
        bool,
        typer.Option("--version", help="Show the version and exit.", callback=_show_version, is_eager=True),
    ] = False,
) -> None:
    """A physics-based digital twin of the Khepera miniature robot."""
