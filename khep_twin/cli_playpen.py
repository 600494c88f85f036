"""The command line's part for playpens: `khep-twin playpen COMMAND`."""

from pathlib import Path
from typing import Annotated

import typer

from khep_twin.files import write_whole

playpen_app = typer.Typer(
    help="Check, compile and draw playpens.", no_args_is_help=True, rich_markup_mode=None
)

PlaypenName = Annotated[str, typer.Argument(help="Name of a shipped playpen, or path of a playpen file.")]
Output = Annotated[Path | None, typer.Option("--output", "-o", help="File to write.")]


@playpen_app.command()
def check(playpen: PlaypenName) -> None:
    """Checks a playpen; one line per problem."""
    from khep_twin import calibration
    from khep_twin import playpen as playpens

    found = playpens.load(playpen)
    for robot in found.robots:
        calibration.read(robot.calibration)
    typer.echo(
        f"{found.name}: {len(found.blocks)} blocks, {len(found.cylinders)} cylinders, "
        f"{len(found.lamps)} lamps, {len(found.robots)} robots: no problem"
    )


@playpen_app.command("compile")
def compile_playpen(playpen: PlaypenName, output: Output = None) -> None:
    """Writes a playpen as MJCF, which opens in MuJoCo without khep_twin; to standard output by default."""
    from khep_twin import playpen as playpens
    from khep_twin.playpen_to_mjcf import to_mjcf

    mjcf = to_mjcf(playpens.load(playpen))
    if output is None:
        typer.echo(mjcf, nl=False)
    else:
        write_whole(output, mjcf.encode("utf-8"))
        typer.echo(f"scene    {output}")


@playpen_app.command()
def draw(playpen: PlaypenName, output: Output = None) -> None:
    """Draws a playpen to scale, as PNG or SVG; to NAME.png by default."""
    from khep_twin import drawing
    from khep_twin import playpen as playpens

    found = playpens.load(playpen)
    target = output or Path(f"{found.name}.png")
    drawing.save(drawing.draw(found), target)
    typer.echo(f"picture  {target}")
