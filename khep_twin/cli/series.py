"""`khep-twin series`: metrics and pictures of saved series; `khep-twin new`: controller templates."""

from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from khep_twin import drawing
from khep_twin.cli.completion import models
from khep_twin.cli.options import Force, check_new, check_picture, usage
from khep_twin.errors import ControllerError
from khep_twin.process.invocation import command


class Kind(StrEnum):
    """Kind of a template."""

    CONTROLLER = "controller"
    TOOLBOX = "toolbox"


def series(
    folders: Annotated[
        list[Path], typer.Argument(metavar="FOLDER", help="Folder of `run --save`; several to compare.")
    ],
    columns: Annotated[
        str | None,
        typer.Option(help="Show only these, such as fitness,distance_m; by default all numeric columns."),
    ] = None,
    picture: Annotated[Path | None, typer.Option(help="Draw them in this PNG, SVG or PDF file.")] = None,
    force: Force = False,
) -> None:
    """Print the metrics of series of runs, and their differences.

    Each metric is printed with its mean, confidence interval and spread.
    """
    from khep_twin.lab.experiment.series_files import read_series
    from khep_twin.lab.experiment.series_statistics import measured_columns, table

    check_picture(picture)
    check_new(force, picture)
    series_rows = [read_series(folder)[1] for folder in folders]
    for folder, rows in zip(folders, series_rows, strict=True):
        if not rows:
            raise ControllerError(f"{folder}: holds no run yet")
    column_names = None if columns is None else [name.strip() for name in columns.split(",")]
    names = measured_columns(series_rows, column_names)
    labels = [folder.name or str(folder) for folder in folders]
    if len({*labels}) < len(labels):
        labels = [str(folder) for folder in folders]
    typer.echo(table(labels, series_rows, names))
    if picture is not None:
        from khep_twin.lab.experiment.figures import default_columns, draw

        drawn_names = default_columns(names) if column_names is None else names
        drawing.save(draw(labels, series_rows, drawn_names), picture, force)
        typer.echo(f"picture  {picture}")


def new(
    kind: Annotated[Kind, typer.Argument(help="Kind: a controller, or one in the Khepera Toolbox's form.")],
    file: Annotated[Path, typer.Argument(metavar="FILE.py", help="File to write.")],
    model: Annotated[
        str | None, typer.Option(help="Model of the robot, or its family.", autocompletion=models)
    ] = None,
    force: Force = False,
) -> None:
    """Write a commented controller template."""
    from khep_twin.lab.experiment.controllers import write_template
    from khep_twin.playpen import Playpen
    from khep_twin.playpen.model import names
    from khep_twin.robots.registry import DEFAULT, find_family

    if kind is Kind.TOOLBOX and model is not None:
        raise usage(
            f"--model {model}: is for a controller; expected none for the toolbox's form, of a Khepera"
        )
    robot_model = find_family(model or DEFAULT)
    if file.suffix != ".py":
        raise usage(f"{file}: expected a name that ends in .py")
    check_new(force, file)
    write_template(robot_model if kind is Kind.CONTROLLER else None, file, force)
    length = ("--seconds", 20) if kind is Kind.CONTROLLER else ("--cycles", 500)
    # The first one that has the robot; the others are not read.
    playpens = map(Playpen.load, ("obstacles", *names()))
    matches = (entry for entry in playpens if entry.robots[0].robot_model.family == robot_model.family)
    playpen = next((entry.name for entry in matches), "PLAYPEN")
    typer.echo(f"{kind}  {file}      run it: {command('run', file, '--playpen', playpen, *length)}")
