"""The command line's part for fits: `khep-twin fit`."""

from pathlib import Path
from typing import Annotated

import typer

from khep_twin.cli.completion import calibrations
from khep_twin.cli.options import Force, check_apart, check_new, check_writable
from khep_twin.errors import FitError
from khep_twin.files.atomic import is_same, write_whole


def fit(
    tests: Annotated[
        list[str],
        typer.Argument(
            metavar="FILE=MEASURED...",
            help="Recorded tests, each with the measured value: straight.mcap=998mm, "
            "spin.mcap=5turns (counter-clockwise), steps.mcap=duty (steps of command P), and tests of "
            "`khep-twin sense` that began with an object straight ahead: run.csv=wall@22mm, "
            "run.csv=cylinder:27mm@15mm (its radius), run.csv=lamp:2W@150mm or, so high, lamp:2W:60mm@150mm.",
        ),
    ],
    check: Annotated[
        list[str] | None,
        typer.Option(help="Test like these that is not fitted; print how well the fit meets it."),
    ] = None,
    start: Annotated[
        str, typer.Option(help="Calibration that the rest is taken from.", autocompletion=calibrations)
    ] = "khepera1",
    output: Annotated[Path | None, typer.Option("--output", "-o", help="Calibration file to write.")] = None,
    picture: Annotated[
        Path | None, typer.Option(help="Draw the fit over the data in this PNG, SVG or PDF file.")
    ] = None,
    force: Force = False,
) -> None:
    """Fit one robot's wheels, motors and sensors to recorded tests and ruler measurements."""
    from khep_twin.files.toml_files import dump
    from khep_twin.lab.fit.fit_inputs import fit_inputs
    from khep_twin.lab.fit.robot_fit import fit_robot, met, named
    from khep_twin.sensing import calibration

    check_writable(output, picture)
    if output is not None and picture is not None and is_same(output, picture):
        raise FitError(f"{picture}: this is the calibration; expected a file of its own for the picture")
    recorded = [Path(word.rpartition("=")[0]) for word in (*tests, *(check or ()))]
    for path in filter(None, (output, picture)):
        if any(is_same(path, each) for each in recorded):
            raise FitError(f"{path}: this is a recorded test; expected a file of its own")
    if picture is not None and picture.suffix.lower() not in (".png", ".svg", ".pdf"):
        raise FitError(f"{picture}: expected a name that ends in .png, .svg or .pdf")
    check_apart([start], output, picture)
    check_new(force, output)
    data, unused = fit_inputs(tests), fit_inputs(check or [])
    if picture is not None and not (data.objects or data.lamps or data.motors):
        wanted = "expected a sensor test or steps of duty, too"
        raise FitError(f"{picture}: measured drives give no picture; {wanted}")
    found = fit_robot(data, calibration.read(start)[0])
    for line in found.lines:
        typer.echo(line)
    for line in met(data, found.calibration):
        typer.echo(f"{line} left")
    for line in met(unused, found.calibration):
        typer.echo(f"{line} off, not used for the fit")
    if output is not None:
        after = named(found.calibration, output.stem, len(tests))
        write_whole(output, dump(after).encode("utf-8"))
        typer.echo(f"calibration   {output}")
    if picture is not None:
        from khep_twin.drawing import map as drawing
        from khep_twin.lab.fit.fit_figure import draw_fit

        if (figure := draw_fit(data, found.calibration)) is not None:
            drawing.save(figure, picture)
            typer.echo(f"picture       {picture}")
