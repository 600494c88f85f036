"""The command line's part for logs: `khep-twin recover`."""

from pathlib import Path
from typing import Annotated

import typer


def recover(
    log: Annotated[Path, typer.Argument(help="An interrupted log, NAME.mcap.part, or a damaged one.")],
) -> None:
    """Rescues an interrupted log; ends with 0 if all of it was saved, 3 if a part, 1 if nothing."""
    from khep_twin.log.recover import recover as rescue
    from khep_twin.log.recover import summary

    found = rescue(log)
    typer.echo(summary(log, found))
    typer.echo(f"log      {found.path}")
    if not found.whole:
        raise typer.Exit(3)
