"""`khep-twin run`: a controller on a robot or a twin, once or in a series."""

import math
import os
import select
import sys
from collections.abc import Callable, Sequence
from contextlib import ExitStack, chdir, closing
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from khep_twin.cli.completion import controllers, playpens, ports
from khep_twin.cli.fast import check_fast, run_fast
from khep_twin.cli.options import (
    OF_A_TWIN,
    Battery,
    CarryOn,
    Faults,
    Force,
    Log,
    Mode,
    Model,
    Noise,
    RobotIndex,
    RomVersion,
    Seed,
    Spread,
    Switch,
    Viewer,
    check_apart,
    check_body,
    check_carry_on,
    given,
    running_mode,
    usage,
)
from khep_twin.cli.progress import progress as progress_bar
from khep_twin.cli.run_logs import RunLogs, check_picture
from khep_twin.cli.streams import unread
from khep_twin.errors import ControllerError, StoppedError
from khep_twin.invocation import command
from khep_twin.signals import answered, stopping

if TYPE_CHECKING:
    from khep_twin.lab.experiment.series import RobotSource, SeriesRun
    from khep_twin.playpen import Playpen
    from khep_twin.ports.twin import Twin, TwinOptions

_OF_A_TWIN = OF_A_TWIN | {"picture", "start", "lighting", "without_lamp"}


def run(
    context: typer.Context,
    controller: Annotated[
        str,
        typer.Argument(
            help="A built-in controller (braitenberg), or FILE.py[:NAME].", autocompletion=controllers
        ),
    ] = "braitenberg",
    playpen: Annotated[
        str, typer.Option(help="Playpen of the twin: a shipped name, or a path.", autocompletion=playpens)
    ] = "default",
    port: Annotated[
        str | None,
        typer.Option(
            help="Port of a robot or a served twin; without, a twin in this process.", autocompletion=ports
        ),
    ] = None,
    seconds: Annotated[float | None, typer.Option(help="End after this time [s]; 60 by default.")] = None,
    cycles: Annotated[int | None, typer.Option(help="End after so many cycles.")] = None,
    runs: Annotated[int, typer.Option(min=1, max=100_000, help="Number of runs, each of that length.")] = 1,
    pause: Annotated[float, typer.Option(min=0, help="Pause between two runs [s].")] = 0.0,
    confirm: Annotated[
        bool, typer.Option("--confirm", help="Wait for Enter before each run, to put the robot right.")
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
        list[str] | None, typer.Option(metavar="X,Y", help="Remove the lamp nearest to this position [mm].")
    ] = None,
    save: Annotated[
        Path | None, typer.Option(help="Keep each run's metrics and variables in this folder.")
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
    model: Model = None,
    battery_used_min: Battery = None,
    fault: Faults = None,
    log: Log = None,
    carry_on: CarryOn = False,
    viewer: Viewer = False,
    force: Force = False,
    fast: Annotated[
        bool,
        typer.Option(
            "--fast",
            help="Run without a serial line, compiled if numba is installed: CONTROLLER is braitenberg or a "
            "function of proximity and ambient light that returns both speeds.",
        ),
    ] = False,
    period: Annotated[float, typer.Option(help="With --fast: the controller's period [ms].")] = 20.0,
    step: Annotated[
        float | None,
        typer.Option(
            help="With --fast: step of the physics [ms]: 2.5, or coarser, 5 or 10; without, 2.5, or 10 with "
            "--planar."
        ),
    ] = None,
    planar: Annotated[
        bool,
        typer.Option("--planar", help="With --fast: simulate in a plane instead of MuJoCo, for screening."),
    ] = False,
    picture: Annotated[
        Path | None,
        typer.Option(
            help="Draw playpen and driven path in this PNG, SVG or PDF file; needs --log or --fast."
        ),
    ] = None,
) -> None:
    """Run a controller on a twin or a robot, once or in a series."""
    from khep_twin.host import Khepera
    from khep_twin.host.opening import PORT_IDS
    from khep_twin.lab.experiment.controller_source import source_of
    from khep_twin.lab.experiment.controllers import LoopingController
    from khep_twin.lab.experiment.experiment import call_after, find_after, find_controller
    from khep_twin.lab.experiment.series import OneRobot, Plan, run_series
    from khep_twin.lab.experiment.series_files import SeriesFolder
    from khep_twin.ports.twin import TwinOptions
    from khep_twin.toolbox.form import as_toolbox_form

    check_fast(given(context), fast)
    if port is not None and (ignored := given(context) & _OF_A_TWIN):
        option = min(ignored).replace("_", "-")
        raise usage(f"--{option} is for a twin in this process, not for one behind --port")
    check_carry_on(carry_on, log)
    check_picture(picture, log, fast)
    check_apart([playpen], picture)
    if (seconds is not None and not 0 < seconds < math.inf) or (cycles is not None and cycles < 1):
        raise usage("--seconds and --cycles are above 0 and finite")
    _check_save(save, resume, log)
    options = TwinOptions(
        seed,
        robot,
        noise is Switch.ON,
        spread is Switch.ON,
        rom,
        running_mode(mode),
        battery_used_min,
        faults=tuple(fault or ()),
        model=model,
    )
    if fast:
        scene = _scene(playpen, lighting, without_lamp or [])
        whole = 60.0 if seconds is None else seconds
        run_fast(
            controller,
            scene,
            options,
            seconds=whole,
            cycles=cycles,
            period=period,
            step=step,
            planar=planar,
            picture=picture,
        )
        return
    # Typed paths are relative to here, wherever a controller goes; during the runs it is where it went.
    with chdir("."):
        found = find_controller(controller, as_toolbox_form)
        gone_to = Path.cwd()
    user_function = None if after is None else find_after(after, found)
    if isinstance(found, LoopingController):
        # Its own loops count cycles; the toolbox's windows begin at 500.
        cycles = 500 if cycles is None and seconds is None else cycles
        options = replace(options, unpaced=found.unpaced)
        found.port_id = int(port) if port in {*map(str, PORT_IDS)} else None
    plan = Plan(runs, cycles, 60.0 if seconds is None and cycles is None else seconds, pause)
    source = source_of(found)
    logs = RunLogs(log, picture, carry_on, source)
    # A run that was interrupted has left its log whole, and is run again.
    logs.check_new(runs if start else None, force or resume)
    done: list[SeriesRun] = []
    with ExitStack() as stack:
        # The robot is released, and its log completed, before what remains is cleared up.
        stack.enter_context(answered())
        if port is not None:
            bench: RobotSource = OneRobot(stack.enter_context(Khepera(port)))
            settings: dict[str, Any] = {"port": port}
        else:
            own = found.playpen if isinstance(found, LoopingController) else None
            chosen = playpen if own is None or "playpen" in given(context) else own
            scene = _scene(chosen, lighting, without_lamp or [])
            begin = _beginning(stack, logs, viewer)
            bench, settings = _twins(stack, scene, options, start or [], runs, begin)
        settings |= {"cycles": cycles, "seconds": plan.seconds, "pause": pause, **source.identity}
        folder = None if save is None else SeriesFolder(save, settings, resume=resume)
        awaited = "stopping the motors, waiting for the end of this cycle"
        asked = stack.enter_context(stopping(awaited, bench.hold))

        def stop() -> bool:
            # A controller that catches every error catches the log's, too.
            return asked() or logs.failed()

        series = run_series(
            found,
            bench,
            plan,
            first=1 if folder is None else bench.first(len(folder.rows), found),
            before=(lambda number: _confirm(number, stop)) if confirm else None,
            progress=stack.enter_context(progress_bar()),
            stop=stop,
        )
        stack.enter_context(chdir(gone_to))
        try:
            for each in stack.enter_context(closing(series)):
                done.append(each)
                is_new = folder is None or folder.keep(each)
                typer.echo(each.line(runs) + ("" if is_new else "  as before"))
                if user_function is not None and is_new:
                    call_after(user_function, each)
                if unread():
                    break
            stopped = asked() and (not done or done[-1].number < runs)
        except (KeyboardInterrupt, StoppedError):
            stopped = True  # amid a cycle
    logs.finish()
    if folder is not None:
        typer.echo(f"series   {folder.path}      look at it: {command('series', folder.path)}")
    if stopped:
        rest = f"; {len(folder.rows)} of {runs} runs are kept, go on with --resume" if folder else ""
        typer.echo(f"khep-twin: stopped before its end{rest}", err=True)
        raise typer.Exit(130)


def _twins(
    stack: ExitStack,
    scene: "Playpen",
    options: "TwinOptions",
    wishes: Sequence[str],
    runs: int,
    begin: "Callable[[Twin, int | None], None]",
) -> "tuple[RobotSource, dict[str, Any]]":
    """Return twins in this process, and their facts: one for all runs, or with starts new ones."""
    from khep_twin.host import Khepera
    from khep_twin.lab.experiment.series import FreshTwins, OneRobot
    from khep_twin.lab.experiment.start_poses import starts
    from khep_twin.log.recorder import versions
    from khep_twin.playpen import dump
    from khep_twin.ports.protocol_khep import Serial
    from khep_twin.ports.twin import equipped, open_twin

    scene, on_the_line = equipped(scene, options)
    check_body(options.rom, (scene.robots[index] for index in on_the_line))
    of_each = {key: value for key, value in asdict(options).items() if key != "log"}
    settings: dict[str, Any] = {**of_each, "playpen": dump(scene), "starts": wishes, **versions()}
    if wishes:
        places = starts(wishes, scene, options.robot or 0, runs, options.seed)
        return FreshTwins(scene, options, places, begin), settings
    khepera = Khepera(Serial.of(open_twin(scene, options), timeout=1.0))
    return OneRobot(stack.enter_context(khepera), lambda twin: begin(twin, None)), settings


def _beginning(stack: ExitStack, logs: RunLogs, viewer: bool) -> "Callable[[Twin, int | None], None]":
    """Return what is done with each twin before it runs: log it, and show it where that is wanted."""
    if not viewer:
        return logs.record
    from khep_twin.mujoco_viewer import MujocoViewer

    window = stack.enter_context(closing(MujocoViewer(real_time=True)))

    def begin(twin: "Twin", number: int | None) -> None:
        logs.record(twin, number)
        window.watch(twin.world)

    return begin


def _scene(playpen: "str | Playpen", lighting: str | None, without_lamp: Sequence[str]) -> "Playpen":
    """Return the playpen with the lamps that are wanted."""
    from khep_twin.lab.experiment.start_poses import lit, numbers, without_nearest_lamp
    from khep_twin.playpen import load

    scene = lit(load(playpen) if isinstance(playpen, str) else playpen, lighting)
    for wish in without_lamp:
        place = numbers(wish, 2)
        if place is None:
            raise usage(f"--without-lamp {wish}: expected X,Y in mm, such as 50,450")
        scene = without_nearest_lamp(scene, *place)
    return scene


def _check_save(save: Path | None, resume: bool, log: Path | None) -> None:
    """Refuse a folder that could not be used."""
    if resume and save is None:
        raise usage("--resume goes on with a series that was saved; expected --save FOLDER, too")
    if log is not None and save is not None and log.resolve() == save.resolve():
        raise usage(f"--save {save}: this is the log; expected a folder of its own")


def _confirm(number: int, stop: Callable[[], bool]) -> None:
    """Wait for the user to press Enter, or for the end of the series."""
    typer.echo(f"run {number}: put the robot right, then press Enter ", nl=False, err=True)
    entered = b""
    while not entered.endswith(b"\n"):
        if stop():
            typer.echo(err=True)
            return
        if select.select([sys.stdin], [], [], 0.1)[0]:
            # Byte by byte, as what is buffered would be waited for again.
            entered = os.read(sys.stdin.fileno(), 1)
            if not entered:
                raise ControllerError(f"--confirm: the input ended before run {number}; expected a terminal")
    # A terminal has shown the Enter itself.
    typer.echo("\r" if sys.stdin.isatty() else "\n", nl=False, err=True)
