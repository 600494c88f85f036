"""The command line's part for guided calibrations: `khep-twin calibrate`."""

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from khep_twin.cli.completion import calibrations, ports
from khep_twin.cli.fit import BearingDeg, RulerMm, check_outputs, fit_and_write
from khep_twin.cli.options import Force, asked, complain
from khep_twin.errors import FitError
from khep_twin.invocation import command
from khep_twin.signals import stopping

if TYPE_CHECKING:
    from khep_twin.lab.fit.placement import Ruler
    from khep_twin.lab.fit.session import CalibrationSession
    from khep_twin.lab.fit.session_steps import Step


def calibrate(
    port: Annotated[
        str,
        typer.Argument(
            help="Port of a robot or a twin, such as /dev/ttyUSB0. On khep://bench.toml, an empty playpen, "
            "the twin is placed and measured by itself.",
            autocompletion=ports,
        ),
    ],
    output: Annotated[Path, typer.Option("--output", "-o", help="Calibration file to write.")],
    picture: Annotated[
        Path | None, typer.Option(help="Draw the fit over the data in this PNG, SVG or PDF file.")
    ] = None,
    folder: Annotated[
        Path | None,
        typer.Option(
            help="Folder of the recordings, from which an interrupted session goes on; "
            "by default mine-session for mine.toml."
        ),
    ] = None,
    start: Annotated[
        str, typer.Option(help="Calibration that the rest is taken from.", autocompletion=calibrations)
    ] = "khepera1",
    walls: Annotated[
        str | None,
        typer.Option(metavar="MM,MM,...", help="Distances of the white wall from the robot's edge."),
    ] = None,
    cylinder: Annotated[
        float | None, typer.Option(metavar="MM", help="Radius of a white cylinder that is there, too.")
    ] = None,
    lamp: Annotated[
        float | None, typer.Option(metavar="W", help="Power of a lamp, to fit the light receivers with.")
    ] = None,
    lamp_height: Annotated[
        float, typer.Option(metavar="MM", help="Height of the lamp's filament above the floor.")
    ] = 15.0,
    ruler_mm: RulerMm = 0.5,
    bearing_deg: BearingDeg = 1.5,
    yes: Annotated[
        bool, typer.Option("--yes", help="Drive without waiting for Enter; only lengths and turns are asked.")
    ] = False,
    force: Force = False,
) -> None:
    """Calibrate a robot in a guided session.

    It tells what to put where, drives, measures, fits, and draws a picture.
    """
    from khep_twin.lab.fit.fit_inputs import Measured, fit_inputs
    from khep_twin.lab.fit.placement import Ruler
    from khep_twin.lab.fit.session import CalibrationSession
    from khep_twin.lab.fit.session_steps import WALLS_MM, steps
    from khep_twin.sensing import calibration

    ruler, before = Ruler(ruler_mm, bearing_deg), calibration.read(start)[0]
    check_outputs([], start, output, picture, force)
    todo = steps(WALLS_MM if walls is None else _distances(walls), cylinder, lamp, lamp_height)
    session = CalibrationSession(folder or output.with_name(f"{output.stem}-session"))
    if not all(session.done(step) for step in todo) and not _go_through(session, todo, port, ruler, yes):
        complain(f"stopped before its end; the same command goes on with what is in {session.folder}")
        raise typer.Exit(130)
    if not session.words:
        raise FitError("every step was skipped; expected one at least")
    typer.echo(f"again with    {command('fit', *session.paths, '-o', output)}")
    fit_and_write(
        fit_inputs(session.paths), Measured(), before, ruler, output, picture, len(session.words), force
    )


def _distances(text: str) -> list[float]:
    try:
        return [float(each) for each in text.split(",")]
    except ValueError:
        raise FitError(f"--walls {text[:80]}: expected distances in mm, such as 6,12,17,21,25,29") from None


def _go_through(
    session: "CalibrationSession", todo: "list[Step]", port: str, ruler: "Ruler", yes: bool
) -> bool:
    """Go through a session; return False if it was stopped."""
    from khep_twin.host import Khepera
    from khep_twin.lab.fit.session_people import PersonAtTerminal, SimulatedPerson
    from khep_twin.ports.protocol_khep import Serial

    with stopping() as stop, Khepera(port) as robot:
        # The stubs of pyserial declare one kind of port.
        line: object = robot.port
        if isinstance(line, Serial):
            person = SimulatedPerson(line.twin, ruler, typer.echo)
        else:
            person = PersonAtTerminal(typer.echo, partial(_ask, stop=stop), wait=not yes)
        try:
            return session.run(todo, robot, person, typer.echo, stop)
        except _StoppedError:
            return False


class _StoppedError(Exception):
    """Ctrl-C at a question."""


def _ask(question: str, stop: Callable[[], bool]) -> str:
    """Ask at the terminal; return the answer without its end."""
    entered = asked(f"{question}: ", stop)
    if entered is None:
        raise _StoppedError
    if not entered.endswith(b"\n"):
        raise FitError(f"the input ended at the question {question!r}; expected an answer")
    return entered.decode("utf-8", "replace").rstrip("\r\n")
