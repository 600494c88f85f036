"""The command line: `khep-twin COMMAND`. Thin: each command calls into the package and prints.

What a command needs is imported inside it, so that `khep-twin --help` comes at once.
"""

import os
import sys
import tempfile
from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from khep_twin import __version__
from khep_twin.errors import KhepTwinError

app = typer.Typer(
    name="khep-twin",
    help="A physics-based digital twin of the Khepera miniature robot.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
)
playpen_app = typer.Typer(help="Check, compile and draw playpens.", no_args_is_help=True, rich_markup_mode=None)
app.add_typer(playpen_app, name="playpen")


class Switch(StrEnum):
    """On or off, as in the options of khep://."""

    ON = "on"
    OFF = "off"


PlaypenName = Annotated[str, typer.Argument(help="Name of a shipped playpen, or path of a playpen file.")]
Seed = Annotated[int, typer.Option(help="Seed of every chance in the run.", min=0)]
Noise = Annotated[Switch, typer.Option(help="Noisy sensors, as on the robot.")]
RobotIndex = Annotated[int, typer.Option(help="Which of the playpen's robots, counted from 0.", min=0)]
Mode = Annotated[int | None, typer.Option(help="Running mode: 1, 2, 3 for 9600, 19200, 38400 baud.")]
RomVersion = Annotated[str | None, typer.Option(help="Version of the firmware, e.g. 5.02.")]


def main() -> None:
    """Runs the command line; a user's mistake ends in one line, not in a trace."""
    try:
        app(standalone_mode=True)
    except KhepTwinError as error:
        for line in str(error).splitlines():
            print(f"khep-twin: {line}", file=sys.stderr)
        sys.exit(1)


def _show_version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"khep-twin {__version__}")
        raise typer.Exit


@app.callback()
def common(
    version: Annotated[
        bool, typer.Option("--version", help="Show the version and end.", callback=_show_version, is_eager=True)
    ] = False,
) -> None:
    """A physics-based digital twin of the Khepera miniature robot."""


@app.command()
def run(
    controller: Annotated[
        str, typer.Argument(help="A built-in controller (braitenberg), or FILE.py[:FUNCTION].")
    ] = "braitenberg",
    playpen: Annotated[str, typer.Option(help="Playpen of the twin: a shipped name, or a path.")] = "default",
    port: Annotated[
        str | None, typer.Option(help="Port of a robot or a served twin; without, a twin in this process.")
    ] = None,
    seconds: Annotated[float | None, typer.Option(help="End after this time [s].", min=0.001)] = None,
    cycles: Annotated[int | None, typer.Option(help="End after so many cycles.", min=1)] = None,
    seed: Seed = 0,
    noise: Noise = Switch.ON,
    robot: RobotIndex = 0,
    mode: Mode = None,
    rom: RomVersion = None,
    log: Annotated[Path | None, typer.Option(help="Record the run in this MCAP file.")] = None,
    picture: Annotated[
        Path | None, typer.Option(help="Draw playpen and driven path in this PNG or SVG file; needs --log.")
    ] = None,
) -> None:
    """Runs a controller on a twin or a robot, 60 s if nothing else is said."""
    from khep_twin.host import Khepera
    from khep_twin.lab import experiment

    if port is not None and log is not None:
        raise _usage("--log records a twin in this process; for a served one use `khep-twin serve --log`")
    if picture is not None and log is None:
        raise _usage("--picture draws the path from the log; give --log FILE.mcap too")
    function = experiment.find_controller(controller)
    if seconds is None and cycles is None:
        seconds = 60.0
    if port is None:
        robot_port = _open_twin(playpen, seed, noise, robot, mode, rom, log)
        _announce(robot_port.twin)
    else:
        robot_port = port
    with Khepera(robot_port) as khepera, _progress() as progress:
        try:
            outcome = experiment.run(function, khepera, cycles=cycles, seconds=seconds, progress=progress)
        except KeyboardInterrupt:
            typer.echo("khep-twin: stopped; the log is complete up to here", err=True)
            raise typer.Exit(130) from None
    typer.echo(f"{outcome.cycles} cycles in {outcome.duration:.1f} s")
    if log is not None:
        typer.echo(f"log      {log}      look at it: khep-twin view {log}")
        if picture is not None:
            _draw_log(log, picture)
            typer.echo(f"picture  {picture}")


@app.command()
def serve(
    playpen: PlaypenName = "default",
    link: Annotated[Path | None, typer.Option(help="Make this link to the pseudo-terminal.")] = None,
    speed: Annotated[str, typer.Option(help="Simulated per real second: a number, or max.")] = "1",
    unpaced: Annotated[bool, typer.Option(help="Let bytes cross the line in no time.")] = False,
    seed: Seed = 0,
    noise: Noise = Switch.ON,
    robot: RobotIndex = 0,
    mode: Mode = None,
    rom: RomVersion = None,
    log: Annotated[Path | None, typer.Option(help="Record the run in this MCAP file.")] = None,
) -> None:
    """Serves a twin behind a pseudo-terminal, in real time, until it is stopped.

    The first line on standard output is the path that a host opens, and nothing else.
    """
    from khep_twin.ports.pty import PtyPort
    from khep_twin.ports.serve import serve as serve_twin
    from khep_twin.ports.serve import stopping
    from khep_twin.ports.twin import TwinOptions, open_twin

    factor = _speed(speed)
    options = TwinOptions(seed, robot, noise is Switch.ON, rom, mode, unpaced, None if log is None else str(log))
    twin = open_twin(playpen, options)
    with stopping() as stop:
        try:
            pty = PtyPort(link)
            try:
                _announce(twin)
                typer.echo(pty.path)
                pacer = serve_twin(twin, pty, factor, stop=stop)
            finally:
                pty.close()
        finally:
            twin.close()
    typer.echo(f"{twin.world.time_ns / 1e9:.1f} s served", err=True)
    if pacer.slips:
        typer.echo(f"fell behind {pacer.slips} times, {pacer.slipped_ns / 1e9:.2f} s in all", err=True)
    if pty.dropped:
        typer.echo(f"{pty.dropped} bytes dropped that no host took", err=True)


@app.command()
def view(
    log: Annotated[Path, typer.Argument(help="A log, FILE.mcap.")],
    save: Annotated[Path | None, typer.Option(help="Write a rerun recording instead of opening it.")] = None,
) -> None:
    """Shows a log in rerun: arena, robot, sensor curves and transcript."""
    from khep_twin.log.replay import view as view_log

    view_log(log, save)
    if save is not None:
        typer.echo(f"recording  {save}      look at it: rerun {save}")


@playpen_app.command()
def check(playpen: PlaypenName) -> None:
    """Checks a playpen; one line per problem."""
    from khep_twin import playpen as playpens

    found = playpens.load(playpen)
    counts = [(found.blocks, "blocks"), (found.cylinders, "cylinders"), (found.lamps, "lamps"), (found.robots, "robots")]
    typer.echo(f"{found.name}: " + ", ".join(f"{len(items)} {name}" for items, name in counts) + ": no problem")


@playpen_app.command("compile")
def compile_playpen(
    playpen: PlaypenName,
    output: Annotated[Path | None, typer.Option("--output", "-o", help="File to write; else standard output.")] = None,
) -> None:
    """Writes a playpen as MJCF, which opens in MuJoCo without khep_twin."""
    from khep_twin import playpen as playpens
    from khep_twin.playpen_to_mjcf import to_mjcf

    mjcf = to_mjcf(playpens.load(playpen))
    if output is None:
        typer.echo(mjcf, nl=False)
    else:
        _write(output, mjcf.encode())


@playpen_app.command()
def draw(
    playpen: PlaypenName,
    output: Annotated[Path, typer.Option("--output", "-o", help="File to write, PNG or SVG.")],
) -> None:
    """Draws a playpen to scale."""
    from khep_twin import drawing
    from khep_twin import playpen as playpens

    drawing.save(drawing.draw(playpens.load(playpen)), output)


def _open_twin(
    playpen: str, seed: int, noise: Switch, robot: int, mode: int | None, rom: str | None, log: Path | None
) -> "TwinPort":
    """A twin in this process, as a port of pyserial."""
    from khep_twin.ports.protocol_khep import Serial
    from khep_twin.ports.twin import TwinOptions

    log_name = None if log is None else str(log)
    options = TwinOptions(
        seed=seed, robot=robot, noise=noise is Switch.ON, rom=rom, mode=mode, log=log_name
    )
    return Serial.of(playpen, options, timeout=1.0)


def _usage(text: str) -> typer.Exit:
    """One line about wrong usage, and the exit that goes with it."""
    typer.echo(f"khep-twin: {text}", err=True)
    return typer.Exit(2)
