"""Options and messages that several commands share."""

import sys
from collections.abc import Callable, Iterable, Sequence, Set
from enum import StrEnum
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from typer.core import TyperGroup

from khep_twin.errors import EXTRAS, KhepTwinError, MissingExtraError, choices
from khep_twin.files.atomic import is_same, resolve, unusable
from khep_twin.files.drawings import is_replaceable
from khep_twin.process.invocation import command
from khep_twin.process.machine import read_byte

if TYPE_CHECKING:
    from khep_twin.log.log_file import FileRecorder
    from khep_twin.playpen.parts import RobotEntry


class Switch(StrEnum):
    """Value of a switch, as in the options of khep://."""

    ON = "on"
    OFF = "off"


class Commands(TyperGroup):
    """Commands by name; the error for an unknown command lists the choices."""

    def resolve_command(self, ctx: Any, args: list[str]) -> Any:
        """Return the command named by the first argument."""
        if args[0] not in self.commands:
            raise usage(f"{args[0]}: no such command; {choices(args[0], self.commands)}")
        return super().resolve_command(ctx, args)


def command_group(help: str) -> typer.Typer:
    """Return a group of commands."""
    return typer.Typer(help=help, cls=Commands, no_args_is_help=True, rich_markup_mode=None)


Faults = Annotated[
    list[str] | None,
    typer.Option(
        "--fault",
        help="Inject this fault; repeatable: drop:P, garble:P, late:P:MS, stuck:SENSOR, dead:SENSOR, "
        "dead:SIDE, weak:SIDE:PART, slip:SIDE:PART, blocked:SIDE or brown-out. @SECONDS starts it later, "
        "@FROM-TO also stops it.",
    ),
]
Force = Annotated[
    bool,
    typer.Option(
        "--force",
        help="Replace existing files; default: exit code 2, unless empty or unchanged drawings.",
    ),
]
Viewer = Annotated[
    bool, typer.Option("--viewer", help="Show the run in MuJoCo's viewer, in a window on this screen.")
]


def typed_options(context: typer.Context) -> set[str]:
    """Return the names of the options that the user has typed."""
    sources = {name: context.get_parameter_source(name) for name in context.params}
    return {name for name, source in sources.items() if source is not None and source.name == "COMMANDLINE"}


def refuse(context: typer.Context, options: Set[str], reason: str) -> None:
    """Refuse options, by their parameters' names, that do not apply to the requested action."""
    if ignored := typed_options(context) & options:
        raise usage(f"--{min(ignored).replace('_', '-')} is for {reason}")


def check_new(force: bool, *paths: Path | None) -> None:
    """Refuse (exit code 2) to replace files without `force`, except empty ones and unchanged drawings."""
    for path in paths:
        if path is not None and not force and path.is_file() and not is_replaceable(path):
            raise usage(f"{path}: is there already; expected another name, or --force to replace it")


def check_writable(*paths: Path | None) -> None:
    """Refuse output files that cannot be written."""
    for path in filter(None, paths):
        if reason := unusable(path):
            raise KhepTwinError(f"{path}: cannot be written: {reason}")


def check_inputs(inputs: Iterable[str | Path], *outputs: Path | None) -> None:
    """Refuse to overwrite input files with output."""
    for path in filter(None, outputs):
        if any(is_same(path, Path(input_path)) for input_path in inputs):
            raise KhepTwinError(f"{path}: this is an input file; expected a separate file")


def check_picture(picture: Path | None, log: Path | None = None) -> None:
    """Refuse a picture that could not be drawn at the end of the run."""
    if picture is None:
        return
    if find_spec("matplotlib") is None:
        raise MissingExtraError("matplotlib", EXTRAS["matplotlib"])
    if picture.suffix.lower() not in (".png", ".svg", ".pdf"):
        raise usage(f"--picture {picture}: expected a name that ends in .png, .svg or .pdf")
    if log is not None and resolve(picture) == resolve(log):
        raise usage(f"--picture {picture}: this is the log; expected a separate file")
    if not picture.parent.is_dir():
        raise usage(f"--picture {picture}: there is no directory {picture.parent}")


def running_mode(digit: str | None) -> int | None:
    """Return a running mode by its jumpers, one hexadecimal digit."""
    if digit is not None and (len(digit) != 1 or digit.upper() not in "0123456789ABCDEF"):
        raise usage(f"--mode {digit}: expected one digit, 0 to F")
    return None if digit is None else int(digit, 16)


def note_firmware_only(rom: str | None, robots: Iterable["RobotEntry"]) -> None:
    """Print a note if --rom khepera2 changes only the firmware of a Khepera 1, not its body."""
    if rom == "khepera2" and any(robot.model == "khepera1" for robot in robots):
        notify(
            "--rom khepera2 changes the firmware only: body and sensors stay a Khepera 1's; "
            "--model khepera2 changes all three"
        )


def print_kept_log(recorder: "FileRecorder | None") -> None:
    """Print the new name of an unfinished log of an earlier run, if there was one."""
    if recorder is not None and (path := recorder.previous_part) is not None:
        remedy = command("recover", path)
        notify(f"an unfinished log of an earlier run is kept as {path}; rescue it: {remedy}")


def print_files(
    name: str, paths: Sequence[Path], show_command: str | None = None, width: int = 7, err: bool = False
) -> None:
    """Print the written files, and the command that shows them.

    Args:
        name: Kind of file, the first column.
        paths: Files, of which the first and the last are named.
        show_command: Command; by default `khep-twin view` of the first file.
        width: Width of the first column, as in the lines above it.
        err: Print on standard error.
    """
    last_name = f" to {paths[-1].name}" if len(paths) > 1 else ""
    show_command = command("view", paths[0]) if show_command is None else show_command
    typer.echo(f"{name:{width}}  {paths[0]}{last_name}      look at it: {show_command}", err=err)


def ask_line(prompt: str, stop: Callable[[], bool], *, err: bool = False) -> bytes | None:
    """Ask on standard output, or on standard error with `err`, and end the line after the answer.

    Returns:
        A line of standard input, without a line end if the input ended; None if `stop` returned True first.
    """
    typer.echo(prompt, nl=False, err=err)
    entered = _read_line(stop)
    stream = sys.stderr if err else sys.stdout
    # A terminal echoes Enter itself.
    is_echoed = entered is not None and entered.endswith(b"\n") and sys.stdin.isatty() and stream.isatty()
    typer.echo("\r" if is_echoed else "\n", nl=False, err=err)
    return entered


def _read_line(stop: Callable[[], bool]) -> bytes | None:
    """Return a line of standard input as `ask_line` does."""
    entered = b""
    while not entered.endswith(b"\n"):
        if stop():
            return None
        # Single bytes, as a wait does not see buffered ones.
        byte = read_byte(sys.stdin.fileno(), 0.1)
        if byte == b"":
            break
        entered += byte or b""
    return entered


def notify(text: str) -> None:
    """Print one line on standard error."""
    typer.echo(f"khep-twin: {text}", err=True)


def usage(text: str) -> typer.Exit:
    """Print one line about wrong usage, and return the exit to raise, with code 2."""
    notify(text)
    return typer.Exit(2)
