"""`khep-twin calibrate`: a guided calibration session."""

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from khep_twin.cli.completion import calibrations, ports
from khep_twin.cli.fit import BearingDeg, RulerMm, check_outputs, fit_and_write
from khep_twin.cli.option_groups import with_help
from khep_twin.cli.options import Force, ask_line, notify
from khep_twin.errors import FitError
from khep_twin.process.invocation import command
from khep_twin.process.signals import stopping
from khep_twin.robots.registry import default_model

if TYPE_CHECKING:
    from khep_twin.lab.fit.placement import Ruler
    from khep_twin.lab.fit.session import CalibrationSession
    from khep_twin.lab.fit.session_steps import Step


@with_help
def calibrate(
    port: Annotated[str, typer.Argument(autocompletion=ports)],
    output: Annotated[Path, typer.Option("--output", "-o")],
    picture: Path | None = None,
    folder: Path | None = None,
    start: Annotated[str, typer.Option(autocompletion=calibrations)] = "khepera1",
    walls: Annotated[str | None, typer.Option(metavar="MM,MM,...")] = None,
    cylinder: Annotated[float | None, typer.Option(metavar="MM")] = None,
    lamp: Annotated[float | None, typer.Option(metavar="W")] = None,
    lamp_height: Annotated[float, typer.Option(metavar="MM")] = 15.0,
    ruler_mm: RulerMm = 0.5,
    bearing_deg: BearingDeg = 1.5,
    yes: bool = False,
    force: Force = False,
) -> None:
    """Calibrate a robot in a guided session.

    It instructs you where to place objects, drives, measures, fits, and draws a picture.

    Args:
        port: Port of a robot or a twin, e.g. /dev/ttyUSB0. On khep://bench.toml, an empty playpen, the
            twin is placed and measured automatically.
        output: Calibration file to write.
        picture: Draw the fit over the data in this PNG, SVG or PDF file.
        folder: Folder of the recordings, from which an interrupted session resumes; by default mine-session
            for mine.toml.
        start: Calibration of all values that are not fitted.
        walls: Distances of the white wall from the robot's edge.
        cylinder: Radius of a white cylinder to measure as well.
        lamp: Power of a lamp, to fit the light receivers.
        lamp_height: Height of the lamp's filament above the floor.
        yes: Do not wait for Enter; ask only for lengths and turns.
    """
    from khep_twin.lab.fit.fit_inputs import FitTests, fit_inputs
    from khep_twin.lab.fit.placement import Ruler
    from khep_twin.lab.fit.session import CalibrationSession
    from khep_twin.lab.fit.session_steps import WALLS_MM, steps
    from khep_twin.sensing import calibration

    ruler, initial = Ruler(ruler_mm, bearing_deg), calibration.read_for(start, default_model())
    check_outputs([], start, output, picture, force)
    plan = steps(WALLS_MM if walls is None else _parse_distances(walls), cylinder, lamp, lamp_height)
    session = CalibrationSession(folder or output.with_name(f"{output.stem}-session"))
    if not all(session.find_word(step) for step in plan) and not _run_session(
        session, plan, port, ruler, yes
    ):
        notify(f"stopped before its end; the same command resumes from {session.folder}")
        raise typer.Exit(130)
    if not session.words:
        raise FitError("every step was skipped; expected at least one")
    tests = session.words_with_folder
    typer.echo(f"again with    {command('fit', *tests, '-o', output)}")
    fit_and_write(fit_inputs(tests), FitTests(), initial, ruler, output, picture, len(session.words), force)


def _parse_distances(text: str) -> list[float]:
    try:
        return [float(distance) for distance in text.split(",")]
    except ValueError:
        raise FitError(f"--walls {text[:80]}: expected distances in mm, such as 6,12,17,21,25,29") from None


def _run_session(
    session: "CalibrationSession", plan: "list[Step]", port: str, ruler: "Ruler", yes: bool
) -> bool:
    """Run the steps of a session; return False if it was stopped."""
    from khep_twin.host import Khepera
    from khep_twin.lab.fit.session_people import PersonAtTerminal, SimulatedPerson
    from khep_twin.ports.protocol_khep import Serial

    with stopping() as stop, Khepera(port) as robot:
        # The stubs of pyserial declare one kind of port.
        serial_port: object = robot.port
        if isinstance(serial_port, Serial):
            person = SimulatedPerson(serial_port.twin, ruler, typer.echo)
        else:
            person = PersonAtTerminal(typer.echo, partial(_ask, stop=stop), wait=not yes)
        try:
            return session.run(plan, robot, person, typer.echo, stop)
        except _StoppedError:
            return False


class _StoppedError(Exception):
    """Ctrl-C at a question."""


def _ask(question: str, stop: Callable[[], bool]) -> str:
    """Ask at the terminal; return the answer without its line end."""
    entered = ask_line(f"{question}: ", stop)
    if entered is None:
        raise _StoppedError
    if not entered.endswith(b"\n"):
        raise FitError(f"the input ended at the question {question!r}; expected an answer")
    return entered.decode("utf-8", "replace").rstrip("\r\n")
