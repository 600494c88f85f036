"""`khep-twin series`: metrics and pictures of saved series of runs; and `khep-twin new`: a template."""

from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from khep_twin.cli.options import Force, check_new, check_picture, usage
from khep_twin.errors import ControllerError
from khep_twin.invocation import command


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
        typer.Option(help="Show only these, such as fitness,distance_m; without, all that are numbers."),
    ] = None,
    picture: Annotated[Path | None, typer.Option(help="Draw them in this PNG, SVG or PDF file.")] = None,
    force: Force = False,
) -> None:
    """Print the metrics of series of runs, and how they differ.

    Each metric has its mean, confidence and spread.
    """
    from khep_twin.lab.experiment.series_files import read_series
    from khep_twin.lab.experiment.series_statistics import measured, table

    check_picture(picture)
    check_new(force, picture)
    found = [read_series(folder)[1] for folder in folders]
    for folder, rows in zip(folders, found, strict=True):
        if not rows:
            raise ControllerError(f"{folder}: holds no run yet")
    wanted = None if columns is None else [name.strip() for name in columns.split(",")]
    names = measured(found, wanted)
    labels = [folder.name or str(folder) for folder in folders]
    if len({*labels}) < len(labels):
        labels = [str(folder) for folder in folders]
    typer.echo(table(labels, found, names))
    if picture is not None:
        from khep_twin.drawing.map import save
        from khep_twin.lab.experiment.figures import draw, shown

        save(draw(labels, found, shown(names) if wanted is None else names), picture, force)
        typer.echo(f"picture  {picture}")


def new(
    kind: Annotated[Kind, typer.Argument(help="Kind: a controller, or one in the Khepera Toolbox's form.")],
    file: Annotated[Path, typer.Argument(metavar="FILE.py", help="File to write.")],
    force: Force = False,
) -> None:
    """Write a commented template to begin with."""
    from khep_twin.lab.experiment.controllers import write_template

    if file.suffix != ".py":
        raise usage(f"{file}: expected a name that ends in .py")
    check_new(force, file)
    write_template(kind.value, file, force)
    length = ("--seconds", 20) if kind is Kind.CONTROLLER else ("--cycles", 500)
    typer.echo(f"{kind}  {file}      run it: {command('run', file, '--playpen', 'obstacles', *length)}")
