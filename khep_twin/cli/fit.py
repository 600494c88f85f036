"""`khep-twin fit`: a calibration fitted to recorded tests, or learned by a shadow."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from khep_twin import drawing
from khep_twin.cli.completion import calibrations, logs, models, playpens
from khep_twin.cli.option_groups import with_help
from khep_twin.cli.options import Force, check_inputs, check_new, check_picture, check_writable, refuse, usage
from khep_twin.cli.progress import progress as progress_bar
from khep_twin.errors import FitError
from khep_twin.files.atomic import is_same, write_atomic
from khep_twin.files.text import escape_surrogates
from khep_twin.robots.registry import DEFAULT, find_family

if TYPE_CHECKING:
    from khep_twin.lab.fit.fit_inputs import FitTests
    from khep_twin.lab.fit.placement import Ruler
    from khep_twin.sensing.calibration import Calibration

RulerMm = Annotated[float, typer.Option(metavar="MM", help="Standard deviation of distances by your ruler.")]
BearingDeg = Annotated[
    float, typer.Option(metavar="DEG", help='Standard deviation of "straight ahead", and of counted turns.')
]


_TEST_OPTIONS = {"tests", "check", "model", "start", "ruler_mm", "bearing_deg", "picture"}
"""Parameters for recorded tests, which do not apply to a shadow's log."""

_NO_TESTS = "nothing to fit; expected tests such as straight.mcap=998mm, or --from LOG with a shadow's log"


@with_help
def fit(
    context: typer.Context,
    tests: Annotated[list[str] | None, typer.Argument(metavar="FILE=MEASURED...")] = None,
    shadow_log: Annotated[Path | None, typer.Option("--from", metavar="LOG", autocompletion=logs)] = None,
    playpen: Annotated[str | None, typer.Option(autocompletion=playpens)] = None,
    check: list[str] | None = None,
    model: Annotated[str, typer.Option(autocompletion=models)] = DEFAULT,
    start: Annotated[str | None, typer.Option(autocompletion=calibrations)] = None,
    ruler_mm: RulerMm = 0.5,
    bearing_deg: BearingDeg = 1.5,
    output: Annotated[Path | None, typer.Option("--output", "-o")] = None,
    picture: Path | None = None,
    force: Force = False,
) -> None:
    """Fit one robot's wheels, motors and sensors.

    The data are recorded tests and ruler measurements.

    Args:
        tests: Recorded tests, each with the measured value: straight.mcap=998mm, spin.mcap=5turns
            (counter-clockwise), steps.mcap=duty (steps of command P), and tests of `khep-twin sense` that
            start with an object straight ahead: run.csv=wall@22mm, run.csv=cylinder:27mm@15mm (radius),
            run.csv=lamp:2W@150mm or, with height, lamp:2W:60mm@150mm, or on a floor,
            run.csv=floor:white and run.csv=floor:black.
        shadow_log: Use the values learned by a shadow instead: its log, or a relay's log with --playpen.
        playpen: Playpen in which a shadow follows a relay's log.
        check: Print how well the fit predicts this test, which is not fitted; repeatable.
        model: Model of the robot, or its family.
        start: Calibration of all values that are not fitted; by default that of the model.
        output: Calibration file to write.
        picture: Draw the fit over the data in this PNG, SVG or PDF file.
    """
    from khep_twin.lab.fit.fit_inputs import fit_inputs
    from khep_twin.lab.fit.placement import Ruler
    from khep_twin.sensing import calibration

    if shadow_log is not None:
        refuse(context, _TEST_OPTIONS, "recorded tests, not for --from")
        _fit_from_shadow(shadow_log, playpen, output, force)
        return
    if not tests or playpen is not None:
        raise usage(_NO_TESTS)
    ruler, robot_model = Ruler(ruler_mm, bearing_deg), find_family(model)
    start = start or robot_model.calibration
    test_paths = [Path(word.rpartition("=")[0]) for word in (*tests, *(check or ()))]
    check_outputs(test_paths, start, output, picture, force)
    data, check_data = fit_inputs(tests, robot_model), fit_inputs(check or [], robot_model)
    if picture is not None and not (data.objects or data.lamps or data.motors):
        expected = "expected also a sensor test or steps of duty"
        raise FitError(f"{picture}: measured drives give no picture; {expected}")
    initial = calibration.read_for(start, robot_model)
    fit_and_write(data, check_data, initial, ruler, output, picture, len(tests), force)


def _fit_from_shadow(path: Path, playpen: str | None, output: Path | None, force: bool) -> None:
    """Write a calibration learned by a shadow; if `path` is a relay's log, a shadow follows it first."""
    from khep_twin.files.toml_files import dump
    from khep_twin.lab.fit.robot_fit import with_name
    from khep_twin.lab.fit.shadow_fit import fit_learned, learn_from_log, read_learned

    check_writable(output)
    check_inputs([path, *([] if playpen is None else [playpen])], output)
    check_new(force, output)
    learned_values = read_learned(path)
    if learned_values is None:
        if playpen is None:
            raise usage(f"{path}: no shadow's log; expected one, or --playpen with a relay's log")
        with progress_bar() as show:
            learned_values = learn_from_log(path, playpen, show)
    fit = fit_learned(*learned_values)
    if not fit.values:
        raise FitError(f"{path}: determines nothing better than it was known; expected minutes near walls")
    for line in fit.lines:
        typer.echo(line)
    if output is not None:
        calibration = with_name(
            fit.calibration, output.stem, f"learned by a shadow in {escape_surrogates(path.name)}"
        )
        write_atomic(output, dump(calibration).encode("utf-8"), force)
        typer.echo(f"calibration   {output}")


def check_outputs(
    test_paths: list[Path], start: str, output: Path | None, picture: Path | None, force: bool
) -> None:
    """Refuse outputs that could not be written, or would replace an input."""
    check_writable(output, picture)
    if output is not None and picture is not None and is_same(output, picture):
        raise FitError(f"{picture}: this is the calibration; expected a separate file for the picture")
    for path in filter(None, (output, picture)):
        if any(is_same(path, test_path) for test_path in test_paths):
            raise FitError(f"{path}: this is a recorded test; expected a separate file")
    check_picture(picture)
    check_inputs([start], output, picture)
    check_new(force, output, picture)


def fit_and_write(
    data: "FitTests",
    check_data: "FitTests",
    start: "Calibration",
    ruler: "Ruler",
    output: Path | None,
    picture: Path | None,
    n_tests: int,
    force: bool,
) -> None:
    """Fit a robot to tests; print values and residuals, write calibration and picture."""
    from khep_twin.files.toml_files import dump
    from khep_twin.lab.fit.robot_fit import describe_residuals, fit_robot, with_name

    robot_fit = fit_robot(data, start, ruler)
    for line in robot_fit.lines:
        typer.echo(line)
    for line in describe_residuals(data, robot_fit, ruler):
        typer.echo(f"{line} left")
    for line in describe_residuals(check_data, robot_fit, ruler):
        typer.echo(f"{line} off, not used for the fit")
    if output is not None:
        calibration = with_name(robot_fit.calibration, output.stem, f"fitted to {n_tests} tests")
        write_atomic(output, dump(calibration).encode("utf-8"), force)
        typer.echo(f"calibration   {output}")
    if picture is not None:
        from khep_twin.lab.fit.fit_figure import draw_fit

        if (figure := draw_fit(data, robot_fit)) is not None:
            drawing.save(figure, picture, force)
            typer.echo(f"picture       {picture}")
