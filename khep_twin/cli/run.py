"""`khep-twin run`: a controller on a robot or a twin, once or in a series."""

from collections.abc import Callable, Sequence
from contextlib import ExitStack, closing
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from khep_twin.cli.completion import controllers, ports
from khep_twin.cli.option_groups import (
    LengthOptions,
    LiveViewOptions,
    LogOptions,
    RobotOptions,
    SceneOptions,
    grouped,
    option_names,
)
from khep_twin.cli.options import (
    Faults,
    Viewer,
    asked,
    check_apart,
    check_body,
    check_picture,
    complain,
    given,
    refuse,
    tell_written,
    usage,
)
from khep_twin.cli.progress import progress as progress_bar
from khep_twin.cli.run_logs import RunLogs
from khep_twin.cli.streams import has_no_reader
from khep_twin.errors import ControllerError, StoppedError
from khep_twin.files.atomic import resolved
from khep_twin.invocation import command
from khep_twin.signals import answered, stopping

if TYPE_CHECKING:
    from khep_twin.lab.experiment.controllers import AnyController
    from khep_twin.lab.experiment.series import RobotSource
    from khep_twin.lab.experiment.series_files import SeriesFolder
    from khep_twin.lab.experiment.series_run import Plan
    from khep_twin.playpen import Playpen
    from khep_twin.ports.twin import Twin, TwinOptions

_OF_A_TWIN = option_names(RobotOptions, SceneOptions, LiveViewOptions) | {
    *("robot", "fault", "log", "ignore_log_errors", "picture", "start", "viewer")
}
"""Options of a twin in this process, by the names of their parameters."""


@dataclass(frozen=True, slots=True)
class SeriesOptions:
    """Options of a series of runs."""

    runs: Annotated[int, typer.Option(min=1, max=100_000, help="Number of runs, each of that length.")] = 1
    pause: Annotated[float, typer.Option(min=0, help="Pause between two runs [s].")] = 0.0
    confirm: Annotated[
        bool, typer.Option("--confirm", help="Wait for Enter before each run, to put the robot right.")
    ] = False
    start: Annotated[
        list[str] | None,
        typer.Option(
            help="Begin each run anew, on a new twin there: X,Y,HEADING in mm and degrees, "
            "grid:COLUMNSxROWS[@HEADING], random or playpen; as often as wanted, taken in turn."
        ),
    ] = None
    save: Annotated[Path | None, typer.Option(help="Folder for each run's metrics and variables.")] = None
    resume: Annotated[bool, typer.Option("--resume", help="Resume the series that --save has begun.")] = False
    on_run_end: Annotated[
        str | None, typer.Option(metavar="FILE.py[:NAME]", help="Call this function with each run that ends.")
    ] = None

    def check(self, log: Path | None) -> None:
        """Refuse a folder that could not be used."""
        if self.resume and self.save is None:
            raise usage("--resume goes on with a series that was saved; expected --save FOLDER, too")
        if log is not None and self.save is not None and resolved(log) == resolved(self.save):
            raise usage(f"--save {self.save}: this is the log; expected a separate folder")


@dataclass(frozen=True, slots=True)
class PortOptions:
    """Options of the line to a robot."""

    port: Annotated[
        str | None,
        typer.Option(
            help="Port of a robot or a served twin; without, a twin in this process.", autocompletion=ports
        ),
    ] = None
    baudrate: Annotated[
        int, typer.Option(min=0, help="Speed of the line to --port; 0 tries all that the robots have.")
    ] = 9600

    def check(self, context: typer.Context) -> None:
        """Refuse options of a twin for a robot behind a port, and the other way round."""
        if self.port is not None:
            refuse(context, _OF_A_TWIN, "a twin in this process, not for one behind --port")
        elif "baudrate" in given(context):
            raise usage("--baudrate is that of a line to a robot; expected --port, too")


@grouped
def run(
    context: typer.Context,
    *,
    controller: Annotated[
        str,
        typer.Argument(
            help="A built-in controller (braitenberg), FILE.py[:NAME], or a network's FILE.npz.",
            autocompletion=controllers,
        ),
    ] = "braitenberg",
    scene: SceneOptions,
    line: PortOptions,
    length: LengthOptions,
    series: SeriesOptions,
    robot: Annotated[int, typer.Option(help="Number of the robot in the playpen, counted from 0.")] = 0,
    twin: RobotOptions,
    fault: Faults = None,
    logging: LogOptions,
    picture: Annotated[
        Path | None,
        typer.Option(help="Draw playpen and driven path in this PNG, SVG or PDF file; needs --log."),
    ] = None,
    live_view: LiveViewOptions,
    viewer: Viewer = False,
) -> None:
    """Run a controller on a twin or a robot, once or in a series."""
    from khep_twin.host import Khepera
    from khep_twin.host.opening import PORT_IDS
    from khep_twin.lab.experiment.controller_files import find_controller, find_on_run_end
    from khep_twin.lab.experiment.controller_source import source_of
    from khep_twin.lab.experiment.controllers import LoopingController
    from khep_twin.lab.experiment.series import OneRobot
    from khep_twin.lab.experiment.series_files import SeriesFolder
    from khep_twin.toolbox.form import as_toolbox_form

    typed, port = given(context), line.port
    line.check(context)
    _check(scene.playpen, logging.log, picture)
    series.check(logging.log)
    options = replace(twin.options(robot), faults=tuple(fault or ()))
    found = find_controller(controller, as_toolbox_form)
    user_function = None if series.on_run_end is None else find_on_run_end(series.on_run_end, found)
    plan, own = _plan(length, series, in_cycles=isinstance(found, LoopingController)), None
    if isinstance(found, LoopingController):
        options = replace(options, unpaced=found.unpaced)
        found.port_id = int(port) if port in {*map(str, PORT_IDS)} else None
        own = None if "playpen" in typed else found.playpen
    source = source_of(found)
    logs = RunLogs(logging, picture, source)
    logs.check_new(plan.runs if series.start else None, logging.force, series.resume)
    with ExitStack() as stack:
        # The robot is released, and its log completed, before what remains is cleared up.
        stack.enter_context(answered())
        if port is not None:
            khepera = Khepera(port, baudrate=line.baudrate or "auto")
            robot_source: RobotSource = OneRobot(stack.enter_context(khepera))
            settings: dict[str, Any] = {"port": port}
        else:
            place = scene.load(own)
            watch = live_view.watching(stack, place.name, viewer=viewer, real_time=True)

            def begin(twin: "Twin", number: int | None) -> None:
                logs.record(twin, number)
                watch(twin)

            robot_source, settings = _twins(stack, place, options, series.start or [], plan.runs, begin)
        settings |= {"cycles": plan.cycles, "seconds": plan.seconds, "pause": plan.pause, **source.identity}
        folder = None if series.save is None else SeriesFolder(series.save, settings, resume=series.resume)
        stopped = _run_series(found, robot_source, plan, folder, logs, series.confirm, user_function)
    logs.finish()
    _tell_end(folder, plan, stopped=stopped)


def _plan(length: LengthOptions, series: SeriesOptions, *, in_cycles: bool) -> "Plan":
    """Return the plan of the runs, by default of 60 s, or of 500 cycles as the toolbox's windows."""
    from khep_twin.lab.experiment.series_run import Plan

    seconds, cycles = length.seconds, length.cycles
    if seconds is None and cycles is None:
        seconds, cycles = (None, 500) if in_cycles else (60.0, None)
    return Plan(series.runs, cycles, seconds, series.pause)


def _tell_end(folder: "SeriesFolder | None", plan: "Plan", *, stopped: bool) -> None:
    if folder is not None:
        tell_written("series", [folder.path], command("series", folder.path))
    if stopped:
        rest = f"; {len(folder.rows)} of {plan.runs} runs are kept, go on with --resume" if folder else ""
        complain(f"stopped before its end{rest}")
        raise typer.Exit(130)


def _check(playpen: str, log: Path | None, picture: Path | None) -> None:
    """Refuse a picture without a log, and files that could not be written at the end."""
    if picture is not None and log is None:
        raise usage("--picture draws the path from the log; expected --log FILE.mcap, too")
    check_picture(picture, log)
    check_apart([playpen], picture)


def _run_series(
    controller: "AnyController",
    robot_source: "RobotSource",
    plan: "Plan",
    folder: "SeriesFolder | None",
    logs: RunLogs,
    confirm: bool,
    user_function: Callable[..., Any] | None,
) -> bool:
    """Run the series, and print and keep each run; return whether it was stopped before its end."""
    from khep_twin.lab.experiment.controller_files import call_on_run_end
    from khep_twin.lab.experiment.series import run_series

    first, last = 1 if folder is None else robot_source.first(len(folder.rows), controller), 0
    awaited = "stopping the motors, waiting for the end of this cycle"
    with stopping(awaited, robot_source.hold) as interrupted, progress_bar() as show:

        def stop() -> bool:
            # A controller that catches every error catches the log's, too.
            return interrupted() or logs.failed()

        before = partial(_confirm, stop=stop) if confirm else None
        with closing(
            run_series(controller, robot_source, plan, first=first, before=before, progress=show, stop=stop)
        ) as series:
            try:
                for each in series:
                    last = each.number
                    is_new = folder is None or folder.keep(each)
                    typer.echo(each.text(plan.runs) + ("" if is_new else "  as before"))
                    if user_function is not None and is_new:
                        call_on_run_end(user_function, each)
                    if has_no_reader():
                        break
                return interrupted() and last < plan.runs
            except (KeyboardInterrupt, StoppedError):
                return True  # amid a cycle


def _twins(
    stack: ExitStack,
    scene: "Playpen",
    options: "TwinOptions",
    wanted_starts: Sequence[str],
    runs: int,
    begin: "Callable[[Twin, int | None], None]",
) -> "tuple[RobotSource, dict[str, Any]]":
    """Return twins in this process, and their facts: one for all runs, or with starts new ones."""
    from khep_twin.host import Khepera
    from khep_twin.lab.experiment.series import FreshTwins, OneRobot
    from khep_twin.lab.experiment.start_poses import starts
    from khep_twin.log.run_description import versions
    from khep_twin.playpen import dump
    from khep_twin.ports.protocol_khep import Serial
    from khep_twin.ports.twin import equipped, open_twin

    scene, on_the_line = equipped(scene, options)
    check_body(options.rom, (scene.robots[index] for index in on_the_line))
    of_each = {key: value for key, value in asdict(options).items() if key != "log"}
    settings: dict[str, Any] = {**of_each, "playpen": dump(scene), "starts": wanted_starts, **versions()}
    if wanted_starts:
        places = starts(wanted_starts, scene, options.robot or 0, runs, options.seed)
        return FreshTwins(scene, options, places, begin), settings
    khepera = Khepera(Serial.of(open_twin(scene, options), timeout=1.0))
    return OneRobot(stack.enter_context(khepera), lambda twin: begin(twin, None)), settings


def _confirm(number: int, stop: Callable[[], bool]) -> None:
    """Wait for the user to press Enter, or for the end of the series."""
    entered = asked(f"run {number}: put the robot right, then press Enter ", stop, err=True)
    if entered is not None and not entered.endswith(b"\n"):
        raise ControllerError(f"--confirm: the input ended before run {number}; expected a terminal")
