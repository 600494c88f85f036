"""The command line: `khep-twin COMMAND`. Thin: each command calls into the package and prints.

What a command needs is imported inside it, so that `khep-twin --help` comes at once.
"""

import errno
import os
import sys
import warnings
from collections.abc import Callable
from contextlib import nullcontext
from typing import Annotated, Any

import typer
from typer.exceptions import TyperException

from khep_twin import __version__
from khep_twin.cli.branch import branch
from khep_twin.cli.calibrate import calibrate
from khep_twin.cli.challenge import challenge_app
from khep_twin.cli.compile import compile_all
from khep_twin.cli.completion import complete_in_bash, explained
from khep_twin.cli.conform import conform
from khep_twin.cli.design import design
from khep_twin.cli.drive import drive
from khep_twin.cli.exec import execute
from khep_twin.cli.fit import fit
from khep_twin.cli.log import recover, repeat
from khep_twin.cli.options import Commands, complain
from khep_twin.cli.playpen import playpen_app
from khep_twin.cli.ports import ports
from khep_twin.cli.report import export, report
from khep_twin.cli.rollout import rollout
from khep_twin.cli.run import run
from khep_twin.cli.sense import sense
from khep_twin.cli.series import new, series
from khep_twin.cli.serve import serve
from khep_twin.cli.shadow import shadow
from khep_twin.cli.streams import exit_code
from khep_twin.cli.sweep import sweep
from khep_twin.cli.view import view
from khep_twin.errors import EXTRAS, KhepTwinError, MissingExtraError
from khep_twin.signals import answered, asked_by, leave
from khep_twin.status_line import BESIDE, beside_status_line

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
_PORTS = (
    serve,
    shadow,
    ports,
    drive,
)
_LOGS = (view, report, export, recover, repeat, branch)
_MEASUREMENTS = (sense, fit, calibrate)
for command in _RUNS + _PORTS + _LOGS + _MEASUREMENTS:
    app.command()(command)
app.command("exec")(execute)
app.command("compile")(compile_all)
app.command()(conform)


def main() -> None:
    """Run the command line; a usage error ends in one line, not in a traceback."""
    if os.environ.get("_KHEP_TWIN_COMPLETE") == "complete_bash":
        complete_in_bash(lambda: app(prog_name="khep-twin"))
    with beside_status_line() if os.environ.pop(BESIDE, None) else nullcontext():
        code = _run()
    # Typer has one exit code for any interruption, shells have one for each signal.
    leave(exit_code(128 + asked_by() if code == 130 and asked_by() else code))


def _told(show: Callable[..., None]) -> Callable[..., None]:
    """Return a function that prints a warning of khep_twin as a line, and others as before."""

    def tell(message: Warning | str, category: type[Warning], *place: Any) -> None:
        if category is UserWarning:
            complain(str(message))
        else:
            show(message, category, *place)

    return tell


def _run() -> int:
    try:
        with answered(), warnings.catch_warnings():
            warnings.showwarning = _told(warnings.showwarning)
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
        elif _is_nowhere():
            text = "the current directory is not there any more; expected one that is"
        else:
            raise
    except TyperException as error:
        text, code = explained(error, error.format_message()), error.exit_code
        if "\n" in text:  # the help, where nothing was typed
            print(text, file=sys.stderr)
            return code
    for line in text.splitlines():
        print(f"khep-twin: {line}", file=sys.stderr)
    return code


def _is_nowhere() -> bool:
    try:
        os.getcwd()
    except FileNotFoundError:
        return True
    return False


def _show_version(wanted: bool) -> None:
    if wanted:
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
