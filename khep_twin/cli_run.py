"""`khep-twin run`: a controller on a robot or a twin, once or in a series."""

import math
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import asdict
from hashlib import sha256
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from khep_twin.cli_options import (
    OF_A_TWIN,
    Battery,
    CarryOn,
    Faults,
    Log,
    Mode,
    Noise,
    RobotIndex,
    RomVersion,
    Seed,
    Spread,
    Switch,
    check_carry_on,
    check_log,
    complain,
    given,
    program,
    running_mode,
    tell_kept,
    usage,
)
from khep_twin.cli_progress import progress as progress_bar

if TYPE_CHECKING:
    from khep_twin.lab.controllers import AnyController
    from khep_twin.lab.series import Bench, Run
    from khep_twin.log.recorder import Recorder
    from khep_twin.playpen import Playpen
    from khep_twin.ports.twin import Twin

_OF_A_TWIN = OF_A_TWIN | {"picture", "start", "lighting", "without_lamp"}


def run(
    context: typer.Context,
    controller: Annotated[
        str, typer.Argument(help="A built-in controller (braitenberg), or FILE.py[:NAME].")
    ] = "braitenberg",
    playpen: Annotated[str, typer.Option(help="Playpen of the twin: a shipped name, or a path.")] = "default",
    port: Annotated[
        str | None, typer.Option(help="Port of a robot or a served twin; without, a twin in this process.")
    ] = None,
    seconds: Annotated[float | None, typer.Option(help="End after this time [s]; 60 by default.")] = None,
    cycles: Annotated[int | None, typer.Option(help="End after so many cycles.")] = None,
    runs: Annotated[int, typer.Option(min=1, max=100_000, help="So many runs, each of that length.")] = 1,
    pause: Annotated[float, typer.Option(min=0, help="Between two runs [s].")] = 0.0,
    confirm: Annotated[
        bool, typer.Option("--confirm", help="Before each run wait for Enter, to put the robot right.")
    ] = False,
    start: Annotated[
        list[str] | None,
        typer.Option(
            help="Begin each run anew, on a new twin there: X,Y,HEADING in mm and degrees, "
            "grid:COLUMNSxROWS[@HEADING], random or playpen; as often as wanted, taken in turn."
        ),
    ] = None,
    lighting: Annotated[
        str | None, typer.Option(help="Lamps: all, random, sequenced or off; without, as in the playpen.")
    ] = None,
    without_lamp: Annotated[
        list[str] | None, typer.Option(metavar="X,Y", help="Take away the lamp nearest to there [mm].")
    ] = None,
    save: Annotated[
        Path | None, typer.Option(help="Keep each run's numbers and variables in this folder.")
    ] = None,
    resume: Annotated[
        bool, typer.Option("--resume", help="Go on with the series that --save has begun.")
    ] = False,
    after: Annotated[
        str | None, typer.Option(metavar="FILE.py[:NAME]", help="Call this function with each run that ends.")
    ] = None,
    seed: Seed = 0,
    noise: Noise = Switch.ON,
    spread: Spread = Switch.OFF,
    robot: RobotIndex = 0,
    mode: Mode = None,
    rom: RomVersion = None,
    battery_used_min: Battery = None,
    fault: Faults = None,
    log: Log = None,
    carry_on: CarryOn = False,
    picture: Annotated[
        Path | None,
        typer.Option(help="Draw playpen and driven path in this PNG, SVG or PDF file; needs --log."),
    ] = None,
) -> None:
    """Runs a controller on a twin or a robot, once or in a series."""
    from khep_twin.host import Khepera
    from khep_twin.lab.experiment import call, find_controller, find_function
    from khep_twin.lab.series import NewTwins, OneRobot, Plan, numbered, run_series
    from khep_twin.lab.series_files import SeriesFolder
    from khep_twin.lab.setting import starts
    from khep_twin.log.recorder import versions
    from khep_twin.playpen import dump
    from khep_twin.ports.protocol_khep import Serial
    from khep_twin.ports.serve import stopping
    from khep_twin.ports.twin import TwinOptions, open_twin

    if port is not None and (ignored := given(context) & _OF_A_TWIN):
        option = min(ignored).replace("_", "-")
        raise usage(f"--{option} is for a twin in this process, not for one behind --port")
    check_carry_on(carry_on, log)
    if picture is not None:
        _check_picture(picture, log)
    if (seconds is not None and not 0 < seconds < math.inf) or (cycles is not None and cycles < 1):
        raise usage("--seconds and --cycles are above 0 and finite")
    if resume and save is None:
        raise usage("--resume goes on with a series that was saved; right is to give --save FOLDER too")
    if log is not None and save is not None and log.resolve() == save.resolve():
        raise usage(f"--save {save}: this is the log; right is a folder of its own")
    found = find_controller(controller)
    user_function = None if after is None else find_function(after, "a run")
    plan = Plan(runs, cycles, 60.0 if seconds is None and cycles is None else seconds, pause)
    recorders: list[Recorder] = []

    def record(twin: "Twin", number: int) -> None:
        if log is not None:
            _record(twin, numbered(log, number) if start else log, found, carry_on, recorders)

    with ExitStack() as stack:
        bench: Bench
        if port is not None:
            khepera = stack.enter_context(Khepera(port))
            bench, settings = OneRobot(khepera), {"port": port}
        else:
            options = TwinOptions(
                seed,
                robot,
                noise is Switch.ON,
                spread is Switch.ON,
                rom,
                running_mode(mode),
                battery_used_min,
                faults=tuple(fault or ()),
            )
            scene = _scene(playpen, lighting, without_lamp or [])
            settings = {"playpen": dump(scene), "options": asdict(options), "starts": start, **versions()}
            if start:
                bench = NewTwins(scene, options, starts(start, scene, robot, runs, seed), record)
            else:
                twin = open_twin(scene, options)
                record(twin, 1)
                bench = OneRobot(stack.enter_context(Khepera(Serial.of(twin, timeout=1.0))))
        settings |= {"cycles": cycles, "seconds": plan.seconds, "pause": pause, **_identity(found)}
        folder = None if save is None else SeriesFolder(save, settings, resume=resume)
        first = 1 if folder is None or _repeats(bench) else len(folder.rows) + 1
        stop = stack.enter_context(stopping())
        progress = stack.enter_context(progress_bar())

        def ends() -> bool:
            # A controller that catches every error catches the log's, too.
            return stop() or (not carry_on and any(each.failure is not None for each in recorders))

        before = _confirm if confirm else None
        done: list[Run] = []
        for each in run_series(found, bench, plan, first=first, before=before, progress=progress, stop=ends):
            done.append(each)
            if folder is not None:
                folder.keep(each)
            if runs > 1:
                typer.echo(_line(each))
            if user_function is not None:
                call(user_function, each)
        stopped = stop()
    if runs == 1:
        _tell_single(done)
    for recorder in recorders:
        check_log(recorder, carry_on)
    _tell_logs([recorder.path for recorder in recorders], picture)
    if folder is not None:
        typer.echo(f"series   {folder.path}      look at it: {program()} series {folder.path}")
    if stopped:
        rest = f"; {len(folder.rows)} of {runs} runs are kept, go on with --resume" if folder else ""
        typer.echo(f"khep-twin: stopped before its end{rest}", err=True)
        raise typer.Exit(130)


def _scene(playpen: str, lighting: str | None, without_lamp: Sequence[str]) -> "Playpen":
    """The playpen with the lamps that are wanted."""
    from khep_twin.lab.setting import lit, numbers, without_nearest_lamp
    from khep_twin.playpen import load

    scene = lit(load(playpen), lighting)
    for wish in without_lamp:
        place = numbers(wish, 2)
        if place is None:
            raise usage(f"--without-lamp {wish}: right is X,Y in mm, such as 50,450")
        scene = without_nearest_lamp(scene, *place)
    return scene


def _record(
    twin: "Twin", path: Path, controller: "AnyController", carry_on: bool, recorders: "list[Recorder]"
) -> None:
    """Starts the log of a twin."""
    from khep_twin.lab.controller_source import source_of

    source = source_of(controller)
    told = complain if carry_on else None
    twin.record(path, facts=source.facts, attachments=source.attachments, carry_on=told)
    tell_kept(twin.recorder)
    if twin.recorder is not None:
        recorders.append(twin.recorder)


def _identity(controller: "AnyController") -> dict[str, str]:
    """What tells a controller from another one: its name and its source."""
    from khep_twin.lab.controller_source import source_of

    source = source_of(controller)
    text = "".join(f"{name}\0{text}" for name, text in sorted(source.attachments.items()))
    return {**source.facts, "controller_sha256": sha256(text.encode("utf-8")).hexdigest()}


def _repeats(bench: "Bench") -> bool:
    """Whether a series on this bench has to begin at its first run to come to where it was."""
    from khep_twin.lab.series import OneRobot

    return isinstance(bench, OneRobot) and bench.repeats


def _confirm(number: int) -> None:
    """Waits for a person."""
    typer.prompt(f"run {number}: put the robot right, then press Enter", "", show_default=False, err=True)


def _line(run: "Run") -> str:
    """A run in a line."""
    shown = [f"{name} {run.numbers[name]:.3g}" for name in ("fitness", "distance_m") if name in run.numbers]
    return f"run {run.number:3d}  {run.cycles} cycles in {run.duration:.1f} s" + "".join(
        f"  {each}" for each in shown
    )


def _tell_single(done: "Sequence[Run]") -> None:
    if done:
        typer.echo(f"{done[0].cycles} cycles in {done[0].duration:.1f} s")


def _tell_logs(logs: Sequence[Path], picture: Path | None) -> None:
    """Says where the logs are, and draws them."""
    if not logs:
        return
    if picture is not None:
        _draw_logs(logs, picture)
        typer.echo(f"picture  {picture}")
    more = f" to {logs[-1].name}" if len(logs) > 1 else ""
    typer.echo(f"log      {logs[0]}{more}      look at it: {program()} view {logs[0]}")


def _draw_logs(logs: Sequence[Path], picture: Path) -> None:
    """The playpen and the driven paths of logs."""
    from khep_twin import drawing
    from khep_twin import playpen as playpens
    from khep_twin.log.reader import read

    runs = [read(log) for log in logs]
    tracks = [
        drawing.Track(name if len(logs) == 1 else log.stem, track.times_ns / 1e9, track.pose[:, :2] * 1000)
        for log, run in zip(logs, runs, strict=True)
        for name, track in run.robots.items()
    ]
    found = playpens.parse(runs[0].attachments["playpen.toml"], f"{logs[0]}: playpen.toml")
    drawing.save(drawing.draw(found, tracks), picture)


def _check_picture(picture: Path, log: Path | None) -> None:
    """Refuses a picture that could not be drawn at the end of the run."""
    if log is None:
        raise usage("--picture draws the path from the log; right is to give --log FILE.mcap too")
    if picture.suffix.lower() not in (".png", ".svg", ".pdf"):
        raise usage(f"--picture {picture}: right is a name that ends in .png, .svg or .pdf")
    if picture.resolve() == log.resolve():
        raise usage(f"--picture {picture}: this is the log; right is a file of its own")
    if not picture.parent.is_dir():
        raise usage(f"--picture {picture}: there is no directory {picture.parent}")
