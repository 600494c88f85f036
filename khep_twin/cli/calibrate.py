"""`khep-twin calibrate`: a guided calibration session."""

from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from khep_twin.cli.completion import calibrations, models, ports
from khep_twin.cli.fit import BearingDeg, RulerMm, check_outputs, fit_and_write
from khep_twin.cli.option_groups import with_help
from khep_twin.cli.options import Force, ask_line, notify
from khep_twin.errors import FitError
from khep_twin.process.invocation import command
from khep_twin.process.signals import stopping
from khep_twin.robots.model import RobotModel
from khep_twin.robots.registry import DEFAULT, find_family

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
    model: Annotated[str, typer.Option(autocompletion=models)] = DEFAULT,
    start: Annotated[str | None, typer.Option(autocompletion=calibrations)] = None,
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
        model: Model of the robot, or its family.
        start: Calibration of all values that are not fitted; by default that of the model.
        walls: Distances of the white wall from the robot's edge.
        cylinder: Radius of a white cylinder to measure as well.
        lamp: Power of a lamp, to fit the light receivers.
        lamp_height: Height of the lamp's filament above the floor.
        yes: Do not wait for Enter; ask only for lengths and turns.
    """
    from khep_twin.lab.fit.fit_inputs import FitTests, fit_inputs
    from khep_twin.lab.fit.placement import Ruler
    from khep_twin.lab.fit.session import CalibrationSession
    from khep_twin.lab.fit.session_steps import steps
    from khep_twin.sensing import calibration

    ruler, robot_model = Ruler(ruler_mm, bearing_deg), find_family(model)
    start = start or robot_model.calibration
    initial = calibration.read_for(start, robot_model)
    check_outputs([], start, output, picture, force)
    distances = robot_model.fit_bench.walls_mm if walls is None else _parse_distances(walls)
    plan = steps(distances, cylinder, lamp, lamp_height, robot_model)
    session = CalibrationSession(folder or output.with_name(f"{output.stem}-session"))
    if not all(session.find_word(step) for step in plan) and not _run_session(
        session, plan, port, ruler, yes, robot_model
    ):
        notify(f"stopped before its end; the same command resumes from {session.folder}")
        raise typer.Exit(130)
    if not session.words:
        raise FitError("every step was skipped; expected at least one")
    tests = session.words_with_folder
    typer.echo(f"again with    {command('fit', *tests, '--model', model, '-o', output)}")
    data, n_tests = fit_inputs(tests, robot_model), len(session.words)
    fit_and_write(data, FitTests(), initial, ruler, output, picture, n_tests, force)


def _parse_distances(text: str) -> Sequence[float]:
    try:
        return [float(distance) for distance in text.split(",")]
    except ValueError:
        raise FitError(f"--walls {text[:80]}: expected distances in mm, such as 6,12,17,21,25,29") from None


def _run_session(
    session: "CalibrationSession", plan: "list[Step]", port: str, ruler: "Ruler", yes: bool, model: RobotModel
) -> bool:
    """Run the steps of a session; return False if it was stopped."""
    from khep_twin.host.host_robot import open_robot
    from khep_twin.lab.fit.session_people import PersonAtTerminal, SimulatedPerson
    from khep_twin.ports.protocol_khep import Serial

    with stopping() as stop, open_robot(model, port) as robot:
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
