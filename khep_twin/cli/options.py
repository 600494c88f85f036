"""Options and messages that several commands share."""

from collections.abc import Iterable
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from typer.core import TyperGroup

from khep_twin.errors import KhepTwinError, choices
from khep_twin.files.atomic import is_same
from khep_twin.invocation import command

if TYPE_CHECKING:
    from khep_twin.log.line_recorder import LineRecorder
    from khep_twin.log.recorder import Recorder
    from khep_twin.playpen.parts import Robot


class Switch(StrEnum):
    """Switch, on or off, as in the options of khep://."""

    ON = "on"
    OFF = "off"


class Commands(TyperGroup):
    """Commands by name; the error about an unknown one lists the choices."""

    def resolve_command(self, ctx: Any, args: list[str]) -> Any:
        """Find a command by the first of the arguments."""
        if args[0] not in self.commands:
            raise usage(f"{args[0]}: no such command; {choices(args[0], self.commands)}")
        return super().resolve_command(ctx, args)


Seed = Annotated[int, typer.Option(help="Seed of every random stream of the run.")]
Noise = Annotated[Switch, typer.Option(help="Add noise to the sensors, as on the robot.")]
Spread = Annotated[Switch, typer.Option(help="Draw sensors of another robot of the same make, by the seed.")]
RobotIndex = Annotated[int, typer.Option(help="Number of the robot in the playpen, counted from 0.")]
Mode = Annotated[
    str | None,
    typer.Option(
        help="Running mode: 1, 2, 3 for 9600, 19200, 38400 baud, with rom khepera2 also 8, 9 for "
        "57600, 115200; 0 demo; 7 self-test."
    ),
]
RomVersion = Annotated[str | None, typer.Option(help="Version of the firmware: 5.02, 4.06 or khepera2.")]
Model = Annotated[
    str | None,
    typer.Option(
        help="Model of the robot, khepera1 or khepera2: body, sensors and, without --rom, firmware."
    ),
]
Battery = Annotated[
    float | None,
    typer.Option(
        min=0, max=1000, help="Run on cells that were used so many minutes; without, on the charger."
    ),
]
Faults = Annotated[
    list[str] | None,
    typer.Option(
        "--fault",
        help="Inject this fault, as often as wanted: drop:P, garble:P, late:P:MS, stuck:SENSOR, dead:SIDE or "
        "brown-out, with @SECONDS to begin later.",
    ),
]
Log = Annotated[Path | None, typer.Option(help="Record the run in this MCAP file.")]
CarryOn = Annotated[
    bool,
    typer.Option(
        "--carry-on",
        help="Go on without the log if it cannot be written any more, as on a full disk; exit with 3 then.",
    ),
]
Force = Annotated[
    bool, typer.Option("--force", help="Replace files that are there already; otherwise they are kept.")
]

Viewer = Annotated[
    bool, typer.Option("--viewer", help="Show the run in MuJoCo's own viewer, in a window on this screen.")
]

OF_A_TWIN = {
    "playpen",
    "seed",
    "noise",
    "spread",
    "robot",
    "mode",
    "model",
    "rom",
    "battery_used_min",
    "fault",
    "log",
    "carry_on",
    "viewer",
}
"""Options of a twin, by the names of their parameters."""


def given(context: typer.Context) -> set[str]:
    """Return the names of the options that the user has typed."""
    sources = {name: context.get_parameter_source(name) for name in context.params}
    return {name for name, source in sources.items() if source is not None and source.name == "COMMANDLINE"}


def check_new(force: bool, *paths: Path | None) -> None:
    """Refuse to replace files, unless that is wanted or they are empty.

    Pictures, pages and recordings for rerun are drawn again from data that stays, so commands leave them out.
    """
    for path in paths:
        if path is not None and not force and path.is_file() and path.stat().st_size:
            raise usage(f"{path}: is there already; expected another name, or --force to replace it")


def check_apart(read: Iterable[str | Path], *written: Path | None) -> None:
    """Refuse to replace what is read by what is written."""
    for path in filter(None, written):
        if any(is_same(path, Path(each)) for each in read):
            raise KhepTwinError(f"{path}: this is what is read; expected a file of its own")


def check_carry_on(carry_on: bool, log: Path | None) -> None:
    """Refuse --carry-on where there is no log."""
    if carry_on and log is None:
        raise usage("--carry-on is about a log that fails; expected --log FILE.mcap, too")


def check_log(recorder: "Recorder | LineRecorder | None", carry_on: bool) -> None:
    """End a run whose log has failed with the exit code for that."""
    if recorder is None or recorder.failure is None:
        return
    if carry_on:
        raise typer.Exit(3)
    raise recorder.failure


def running_mode(digit: str | None) -> int | None:
    """Return a running mode from its jumpers, one hexadecimal digit."""
    if digit is not None and (len(digit) != 1 or digit.upper() not in "0123456789ABCDEF"):
        raise usage(f"--mode {digit}: expected one digit, 0 to F")
    return None if digit is None else int(digit, 16)


def check_body(rom: str | None, robots: Iterable["Robot"]) -> None:
    """Print a note that the firmware of a Khepera II does not make one of a Khepera 1."""
    if rom == "khepera2" and any(robot.model == "khepera1" for robot in robots):
        complain(
            "--rom khepera2 changes the firmware only: body and sensors stay a Khepera 1's; "
            "--model khepera2 changes all three"
        )


def tell_kept(recorder: "Recorder | LineRecorder | None") -> None:
    """Print where an unfinished log of an earlier run that was found is now."""
    if recorder is not None and recorder.kept is not None:
        remedy = command("recover", recorder.kept)
        complain(f"an unfinished log of an earlier run is kept as {recorder.kept}; rescue it: {remedy}")


def complain(text: str) -> None:
    """Print one line on standard error."""
    typer.echo(f"khep-twin: {text}", err=True)


def usage(text: str) -> typer.Exit:
    """Print one line about wrong usage, and return the exit that goes with it."""
    typer.echo(f"khep-twin: {text}", err=True)
    return typer.Exit(2)
