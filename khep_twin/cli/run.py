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
    option_names,
    with_help,
)
from khep_twin.cli.options import (
    Faults,
    Viewer,
    ask_line,
    check_inputs,
    check_picture,
    note_firmware_only,
    notify,
    print_files,
    refuse,
    typed_options,
    usage,
)
from khep_twin.cli.progress import progress as progress_bar
from khep_twin.cli.run_logs import RunLogs
from khep_twin.cli.streams import has_no_reader
from khep_twin.cli.view import check_html
from khep_twin.errors import ControllerError, StoppedError
from khep_twin.files.atomic import resolve
from khep_twin.process.invocation import command
from khep_twin.process.signals import handle_signals, stopping

if TYPE_CHECKING:
    from khep_twin.lab.experiment.controllers import AnyController
    from khep_twin.lab.experiment.series import RobotSource
    from khep_twin.lab.experiment.series_files import SeriesFolder
    from khep_twin.lab.experiment.series_run import Plan
    from khep_twin.playpen import Playpen
    from khep_twin.ports.twin import Twin, TwinOptions

_TWIN_OPTIONS = option_names(RobotOptions, SceneOptions, LiveViewOptions) | {
    *("robot", "fault", "log", "ignore_log_errors", "picture", "html", "start", "viewer")
}
"""Options of a twin in this process, by their parameters' names."""


@dataclass(frozen=True, slots=True)
class SeriesOptions:
    """Options of a series of runs."""

    runs: Annotated[int, typer.Option(min=1, max=100_000, help="Number of runs of this length.")] = 1
    pause: Annotated[float, typer.Option(min=0, help="Pause between two runs [s].")] = 0.0
    confirm: Annotated[
        bool, typer.Option("--confirm", help="Wait for Enter before each run, to place the robot.")
    ] = False
    start: Annotated[
        list[str] | None,
        typer.Option(
            help="Start each run on a new twin at this pose: X,Y,HEADING in mm and degrees, "
            "grid:COLUMNSxROWS[@HEADING], random or playpen; repeatable, used in turn."
        ),
    ] = None
    save: Annotated[Path | None, typer.Option(help="Folder for each run's metrics and variables.")] = None
    resume: Annotated[bool, typer.Option("--resume", help="Resume the series in the --save folder.")] = False
    on_run_end: Annotated[
        str | None, typer.Option(metavar="FILE.py[:NAME]", help="Call this function with each finished run.")
    ] = None

    def check(self, log: Path | None) -> None:
        """Refuse an unusable folder."""
        if self.resume and self.save is None:
            raise usage("--resume continues a saved series; expected --save FOLDER with it")
        if log is not None and self.save is not None and resolve(log) == resolve(self.save):
            raise usage(f"--save {self.save}: this is the log; expected a separate folder")


@dataclass(frozen=True, slots=True)
class PortOptions:
    """Options of the line to a robot.

    Attributes:
        port: Port of a robot or a served twin; by default a twin in this process.
        baudrate: Baud rate of the line to --port; by default, or for 0, all rates of the robots are tried.
    """

    port: Annotated[str | None, typer.Option(autocompletion=ports)] = None
    baudrate: Annotated[int, typer.Option(min=0)] = 0

    def check(self, context: typer.Context) -> None:
        """Refuse options of a twin for a robot behind a port, and vice versa."""
        if self.port is not None:
            refuse(context, _TWIN_OPTIONS, "a twin in this process, not for one behind --port")
        elif "baudrate" in typed_options(context):
            raise usage("--baudrate is that of a line to a robot; expected --port with it")


@with_help
def run(
    context: typer.Context,
    *,
    controller: Annotated[str, typer.Argument(autocompletion=controllers)] = "braitenberg",
    scene: SceneOptions,
    line: PortOptions,
    length: LengthOptions,
    series: SeriesOptions,
    robot: int = 0,
    twin: RobotOptions,
    fault: Faults = None,
    logging: LogOptions,
    picture: Path | None = None,
    html: Path | None = None,
    live_view: LiveViewOptions,
    viewer: Viewer = False,
) -> None:
    """Run a controller on a twin or a robot, once or in a series.

    Args:
        controller: A built-in controller (braitenberg), FILE.py[:NAME], or a network's FILE.npz.
        robot: Number of the robot in the playpen, counted from 0.
        picture: Draw playpen and path in this PNG, SVG or PDF file; needs --log.
        html: Write one HTML file that plays the run in any browser; needs --log.
    """
    from khep_twin.host.connection import connect
    from khep_twin.host.opening import PORT_IDS
    from khep_twin.lab.experiment.controller_files import find_controller, find_on_run_end
    from khep_twin.lab.experiment.controller_source import source_of
    from khep_twin.lab.experiment.controllers import LoopingController, as_controller
    from khep_twin.lab.experiment.series import OneRobot
    from khep_twin.lab.experiment.series_files import SeriesFolder
    from khep_twin.toolbox.form import as_toolbox_form

    typed_names, port = typed_options(context), line.port
    line.check(context)
    _check_outputs(scene.playpen, logging.log, picture, html)
    series.check(logging.log)
    options = replace(twin.options(robot), faults=tuple(fault or ()))
    program = find_controller(controller, as_toolbox_form)
    user_function = None if series.on_run_end is None else find_on_run_end(series.on_run_end, program)
    plan = _plan_runs(length, series, in_cycles=isinstance(program, LoopingController))
    controller_playpen = None
    if isinstance(program, LoopingController):
        options = replace(options, unpaced=program.unpaced)
        program.port_id = int(port) if port in {*map(str, PORT_IDS)} else None
        controller_playpen = None if "playpen" in typed_names else program.playpen
    source = source_of(program)
    logs = RunLogs(logging, picture, html, source)
    logs.check_new(plan.runs if series.start else None, logging.force, series.resume)
    with ExitStack() as stack:
        # Release the robot and complete its log before the remaining cleanup.
        stack.enter_context(handle_signals())
        if port is not None:
            controller_object = as_controller(program)
            connected_robot = stack.enter_context(
                connect(port, baudrate=line.baudrate, family=controller_object.family)
            )
            controller_object.require_model(connected_robot.model)
            robot_source: RobotSource = OneRobot(connected_robot)
            settings: dict[str, Any] = {"port": port}
        else:
            playpen = scene.load(controller_playpen)
            watch = live_view.open_viewers(stack, playpen.name, viewer=viewer, real_time=True)

            def on_start(twin: "Twin", number: int | None) -> None:
                logs.record(twin, number)
                watch(twin)

            robot_source, settings = _open_twins(
                stack, program, playpen, options, series.start or [], plan.runs, on_start
            )
        settings |= {"cycles": plan.cycles, "seconds": plan.seconds, "pause": plan.pause, **source.identity}
        folder = None if series.save is None else SeriesFolder(series.save, settings, resume=series.resume)
        is_stopped = _run_series(program, robot_source, plan, folder, logs, series.confirm, user_function)
    logs.finish()
    _print_series_end(folder, plan, is_stopped=is_stopped)


def _plan_runs(length: LengthOptions, series: SeriesOptions, *, in_cycles: bool) -> "Plan":
    """Return the plan of the runs, by default of 60 s, or of 500 cycles as in the toolbox."""
    from khep_twin.lab.experiment.series_run import Plan

    seconds, cycles = length.seconds, length.cycles
    if seconds is None and cycles is None:
        seconds, cycles = (None, 500) if in_cycles else (60.0, None)
    return Plan(series.runs, cycles, seconds, series.pause)


def _print_series_end(folder: "SeriesFolder | None", plan: "Plan", *, is_stopped: bool) -> None:
    """Print where the series is saved, and whether it was stopped, with exit code 130."""
    if folder is not None:
        print_files("series", [folder.path], command("series", folder.path))
    if is_stopped:
        saved = f"; {len(folder.rows)} of {plan.runs} runs are saved; resume with --resume" if folder else ""
        notify(f"stopped before its end{saved}")
        raise typer.Exit(130)


def _check_outputs(playpen: str, log: Path | None, picture: Path | None, html: Path | None) -> None:
    """Refuse a picture or page without a log, and output files that cannot be written."""
    if html is not None:
        if log is None:
            raise usage("--html plays the log; expected --log FILE.mcap with it")
        check_html(html, [log])
    if picture is not None and log is None:
        raise usage("--picture draws the path from the log; expected --log FILE.mcap with it")
    check_picture(picture, log)
    check_inputs([playpen], picture, html)


def _run_series(
    controller: "AnyController",
    robot_source: "RobotSource",
    plan: "Plan",
    folder: "SeriesFolder | None",
    logs: RunLogs,
    confirm: bool,
    user_function: Callable[..., Any] | None,
) -> bool:
    """Run the series, print and save each run; return whether it was stopped before its end."""
    from khep_twin.lab.experiment.controller_files import call_on_run_end
    from khep_twin.lab.experiment.series import run_series

    first = 1 if folder is None else robot_source.first_run(len(folder.rows), controller)
    last, is_late = 0, False
    awaited = "stopping the motors, waiting for the end of this cycle"
    with stopping(awaited, robot_source.hold) as is_interrupted, progress_bar() as show:

        def stop() -> bool:
            # A controller that catches every error also catches the log's.
            return is_interrupted() or logs.has_failed()

        wait = partial(_confirm, stop=stop) if confirm else None
        with closing(
            run_series(controller, robot_source, plan, first=first, before_run=wait, progress=show, stop=stop)
        ) as series:
            try:
                for run_result in series:
                    last = run_result.number
                    is_new = folder is None or folder.save(run_result)
                    typer.echo(run_result.text(plan.runs) + ("" if is_new else "  as before"))
                    if not is_late and (notice := run_result.delay_text()):
                        is_late = True
                        notify(notice)
                    if user_function is not None and is_new:
                        call_on_run_end(user_function, run_result)
                    if has_no_reader():
                        break
                return is_interrupted() and last < plan.runs
            except (KeyboardInterrupt, StoppedError):
                return True  # within a cycle


def _open_twins(
    stack: ExitStack,
    program: "AnyController",
    playpen: "Playpen",
    options: "TwinOptions",
    start_specs: Sequence[str],
    runs: int,
    on_start: "Callable[[Twin, int | None], None]",
) -> "tuple[RobotSource, dict[str, Any]]":
    """Return twins in this process and their settings: one for all runs, or one per run with starts."""
    from khep_twin.host.host_robot import open_robot
    from khep_twin.lab.experiment.controllers import as_controller
    from khep_twin.lab.experiment.series import FreshTwins, OneRobot
    from khep_twin.lab.experiment.start_poses import starts
    from khep_twin.log.run_description import versions
    from khep_twin.playpen import dump
    from khep_twin.ports.protocol_khep import Serial
    from khep_twin.ports.twin import equip_playpen, open_twin

    playpen, robot_indices = equip_playpen(playpen, options)
    for index in robot_indices:
        as_controller(program).require_model(playpen.robots[index].robot_model)
    note_firmware_only(options.rom, (playpen.robots[index] for index in robot_indices))
    values = {key: value for key, value in asdict(options).items() if key != "log"}
    settings: dict[str, Any] = {**values, "playpen": dump(playpen), "starts": start_specs, **versions()}
    if start_specs:
        start_poses = starts(start_specs, playpen, options.robot or 0, runs, options.seed)
        return FreshTwins(playpen, options, start_poses, on_start), settings
    model = playpen.robots[robot_indices[0]].robot_model
    robot = open_robot(model, Serial.of(open_twin(playpen, options), timeout=1.0))
    return OneRobot(stack.enter_context(robot), lambda twin: on_start(twin, None)), settings


def _confirm(number: int, stop: Callable[[], bool]) -> None:
    """Wait for the user to press Enter, or for the end of the series."""
    entered = ask_line(f"run {number}: place the robot, then press Enter ", stop, err=True)
    if entered is not None and not entered.endswith(b"\n"):
        raise ControllerError(f"--confirm: the input ended before run {number}; expected a terminal")
