"""The command line's part for fits: `khep-twin fit`."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from khep_twin.cli.completion import calibrations, logs, playpens
from khep_twin.cli.options import Force, check_apart, check_new, check_picture, check_writable, refuse, usage
from khep_twin.cli.progress import progress as progress_bar
from khep_twin.errors import FitError
from khep_twin.files.atomic import is_same, write_whole
from khep_twin.files.text import encodable

if TYPE_CHECKING:
    from khep_twin.lab.fit.fit_inputs import Measured
    from khep_twin.lab.fit.placement import Ruler
    from khep_twin.sensing.calibration import Calibration

RulerMm = Annotated[float, typer.Option(metavar="MM", help="Standard deviation of distances by your ruler.")]
BearingDeg = Annotated[
    float,
    typer.Option(metavar="DEG", help='Standard deviation of "straight ahead", and of counted turns.'),
]


_OF_TESTS = {"tests", "check", "start", "ruler_mm", "bearing_deg", "picture"}
"""Parameters of recorded tests, which mean nothing to what a shadow has learned."""

_NOTHING = "nothing to fit; expected tests such as straight.mcap=998mm, or --from LOG with a shadow's log"


def fit(
    context: typer.Context,
    tests: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="FILE=MEASURED...",
            help="Recorded tests, each with the measured value: straight.mcap=998mm, "
            "spin.mcap=5turns (counter-clockwise), steps.mcap=duty (steps of command P), and tests of "
            "`khep-twin sense` that began with an object straight ahead: run.csv=wall@22mm, "
            "run.csv=cylinder:27mm@15mm (its radius), run.csv=lamp:2W@150mm or, so high, lamp:2W:60mm@150mm.",
        ),
    ] = None,
    learned: Annotated[
        Path | None,
        typer.Option(
            "--from",
            metavar="LOG",
            help="Take what a shadow has learned instead: its log, or a relay's with --playpen.",
            autocompletion=logs,
        ),
    ] = None,
    playpen: Annotated[
        str | None,
        typer.Option(help="Playpen in which a shadow follows a relay's log.", autocompletion=playpens),
    ] = None,
    check: Annotated[
        list[str] | None,
        typer.Option(help="Test like these that is not fitted; print how well the fit meets it."),
    ] = None,
    start: Annotated[
        str, typer.Option(help="Calibration that the rest is taken from.", autocompletion=calibrations)
    ] = "khepera1",
    ruler_mm: RulerMm = 0.5,
    bearing_deg: BearingDeg = 1.5,
    output: Annotated[Path | None, typer.Option("--output", "-o", help="Calibration file to write.")] = None,
    picture: Annotated[
        Path | None, typer.Option(help="Draw the fit over the data in this PNG, SVG or PDF file.")
    ] = None,
    force: Force = False,
) -> None:
    """Fit one robot's wheels, motors and sensors.

    The data are recorded tests and ruler measurements.
    """
    from khep_twin.lab.fit.fit_inputs import fit_inputs
    from khep_twin.lab.fit.placement import Ruler
    from khep_twin.sensing import calibration

    if learned is not None:
        refuse(context, _OF_TESTS, "recorded tests, not for --from")
        _fit_learned(learned, playpen, output, force)
        return
    if not tests or playpen is not None:
        raise usage(_NOTHING)
    ruler = Ruler(ruler_mm, bearing_deg)
    recorded = [Path(word.rpartition("=")[0]) for word in (*tests, *(check or ()))]
    check_outputs(recorded, start, output, picture, force)
    data, unused = fit_inputs(tests), fit_inputs(check or [])
    if picture is not None and not (data.objects or data.lamps or data.motors):
        wanted = "expected a sensor test or steps of duty, too"
        raise FitError(f"{picture}: measured drives give no picture; {wanted}")
    fit_and_write(data, unused, calibration.read(start)[0], ruler, output, picture, len(tests), force)


def _fit_learned(path: Path, playpen: str | None, output: Path | None, force: bool) -> None:
    """Take a calibration from what a shadow has learned; follow a relay's line first."""
    from khep_twin.files.toml_files import dump
    from khep_twin.lab.fit.robot_fit import named
    from khep_twin.lab.fit.shadow_fit import fit_learned, follow_all, read_learned

    check_writable(output)
    check_apart([path, *([] if playpen is None else [playpen])], output)
    check_new(force, output)
    found = read_learned(path)
    if found is None:
        if playpen is None:
            raise usage(f"{path}: no shadow's log; expected one, or --playpen with a relay's log")
        with progress_bar() as show:
            found = follow_all(path, playpen, show)
    fit = fit_learned(*found)
    if not fit.values:
        raise FitError(f"{path}: determines nothing better than it was known; expected minutes near walls")
    for line in fit.lines:
        typer.echo(line)
    if output is not None:
        after = named(fit.calibration, output.stem, f"learned by a shadow in {encodable(path.name)}")
        write_whole(output, dump(after).encode("utf-8"), force)
        typer.echo(f"calibration   {output}")


def check_outputs(
    recorded: list[Path], start: str, output: Path | None, picture: Path | None, force: bool
) -> None:
    """Refuse a calibration and a picture that could not be written, or would replace what is read."""
    check_writable(output, picture)
    if output is not None and picture is not None and is_same(output, picture):
        raise FitError(f"{picture}: this is the calibration; expected a separate file for the picture")
    for path in filter(None, (output, picture)):
        if any(is_same(path, each) for each in recorded):
            raise FitError(f"{path}: this is a recorded test; expected a separate file")
    check_picture(picture)
    check_apart([start], output, picture)
    check_new(force, output, picture)


def fit_and_write(
    data: "Measured",
    unused: "Measured",
    start: "Calibration",
    ruler: "Ruler",
    output: Path | None,
    picture: Path | None,
    count: int,
    force: bool,
) -> None:
    """Fit a robot to tests, print the values and residuals, write the calibration and the picture."""
    from khep_twin.files.toml_files import dump
    from khep_twin.lab.fit.robot_fit import fit_robot, met, named

    found = fit_robot(data, start, ruler)
    for line in found.lines:
        typer.echo(line)
    for line in met(data, found, ruler):
        typer.echo(f"{line} left")
    for line in met(unused, found, ruler):
        typer.echo(f"{line} off, not used for the fit")
    if output is not None:
        after = named(found.calibration, output.stem, f"fitted to {count} tests")
        write_whole(output, dump(after).encode("utf-8"), force)
        typer.echo(f"calibration   {output}")
    if picture is not None:
        from khep_twin.drawing import map as drawing
        from khep_twin.lab.fit.fit_figure import draw_fit

        if (figure := draw_fit(data, found)) is not None:
            drawing.save(figure, picture, force)
            typer.echo(f"picture       {picture}")
