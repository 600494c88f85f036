"""`khep-twin shadow`: a twin that estimates a robot's state, live or from a log."""

import os
import time
from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import AbstractContextManager, closing, nullcontext
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from khep_twin.cli.completion import logs, ports
from khep_twin.cli.endpoints import EndpointOptions, line_baud, relay_robot
from khep_twin.cli.option_groups import LogOptions, option_names, with_help
from khep_twin.cli.options import check_inputs, check_new, check_writable, notify, refuse, running_mode, usage
from khep_twin.cli.playpen import PlaypenName
from khep_twin.cli.progress import progress as progress_bar
from khep_twin.cli.shadow_run import EXIT_CODES, ExitOn, ShadowOptions, ShadowRun
from khep_twin.clock import NS_PER_S
from khep_twin.process.machine import lower_priority
from khep_twin.process.signals import stopping
from khep_twin.process.status_line import beside_status_line, status_line

if TYPE_CHECKING:
    from khep_twin.playpen import Playpen
    from khep_twin.robots.model import RobotModel
    from khep_twin.shadow.line_pipe import LineReceiver
    from khep_twin.shadow.recording import LineChunk
    from khep_twin.shadow.shadow import ShadowSettings

_MAX_DELAY_S = 2.0
"""Delay of the estimate above which it is reported (assumed) [s]."""

_NICENESS_STEPS = 5
"""Increment of the niceness of a shadow beside a relay (assumed)."""

_ROBOT_OPTIONS = option_names(EndpointOptions) | {"mode", "poll", "view", "web", "log", "ignore_log_errors"}
"""Options of a robot at --relay that do not apply to a log, by their parameters' names."""


@with_help
def shadow(
    context: typer.Context,
    *,
    playpen: PlaypenName,
    recording: Annotated[Path | None, typer.Argument(metavar="LOG", autocompletion=logs)] = None,
    relay: Annotated[str | None, typer.Option(autocompletion=ports)] = None,
    endpoint: EndpointOptions,
    mode: str | None = None,
    poll: bool = False,
    robot: Annotated[int, typer.Option(min=0)] = 0,
    options: ShadowOptions,
    end_s: Annotated[float | None, typer.Option("--until", min=0)] = None,
    exit_on: Annotated[
        list[ExitOn] | None,
        typer.Option(
            help=f"Stop at the first alarm, with exit code {EXIT_CODES[ExitOn.ALARM]}, or when the followed "
            f"robot is lost, with {EXIT_CODES[ExitOn.LOST]}; repeatable."
        ),
    ] = None,
    output: Annotated[Path | None, typer.Option("--output", "-o")] = None,
    view: bool = False,
    web: bool = False,
    logging: LogOptions,
    line_fd: Annotated[int | None, typer.Option(hidden=True)] = None,
) -> None:
    """Follow a robot by its serial line, live or from a log.

    The twin estimates the robot's pose and diagnoses its faults.

    Standard output has a line for each start and end of an alarm, and when the robot is lost or found again;
    with --relay, after the line for the host.

    Args:
        recording: Log of a relay, or of a twin, FILE.mcap.
        relay: Follow the robot at this port, and relay its line to its host.
        mode: Running mode of the robot, which sets the baud rate of its line; by default its usual one.
        poll: Poll the robot while its host is idle.
        robot: Number of the robot in playpen and log, from 0.
        end_s: Stop at this log time [s].
        output: Log to write, FILE.mcap, of poses, residuals and alarms.
        view: Show the shadow live in rerun.
        web: With --view: in a browser, not a window.
    """
    mode_number = running_mode(mode)
    check_writable(output)
    check_inputs([playpen, *([] if recording is None else [recording])], output, logging.log)
    check_new(logging.force, output, logging.log)
    robot_playpen, has_others = options.load(playpen, robot)
    model = robot_playpen.robots[0].robot_model
    dialect = model.dialect
    baud = dialect.baud if mode_number is None else line_baud(mode_number)
    settings = replace(options.settings(baud), others=has_others)
    if relay is not None:
        if recording is not None or end_s is not None:
            raise usage("--relay follows a robot, not a log; expected one of them, --until only with a log")
        endpoint.check()
        args = [playpen, f"--robot={robot}", *options.as_arguments(), *(["--mode", mode] if mode else [])]
        args += [*(f"--exit-on={event}" for event in exit_on or ()), *(["--force"] if logging.force else [])]
        args += ["--output", str(output)] if output is not None else []
        args += [*(["--view"] if view else []), *(["--web"] if web else [])]
        from khep_twin.host.opening import resolve_port
        from khep_twin.shadow.recording import reads_of

        requests = [dialect.framing.encode(read.request) for read in reads_of(dialect) if poll]
        _relay_with_shadow(resolve_port(relay), baud, args, endpoint, logging, model, requests)
        return
    if line_fd is not None:
        run = ShadowRun(robot_playpen, settings, exit_on or (), output)
        _follow_line(line_fd, run, run.show_in_viewer(web=web) if view else nullcontext())
        return
    refuse(context, _ROBOT_OPTIONS, "a robot at --relay, not for a log")
    if recording is None:
        raise usage("nothing to follow; expected a log, FILE.mcap, or a robot's port, --relay PORT")
    _follow_log(recording, robot, end_s, robot_playpen, settings, exit_on or (), output)


def _follow_log(
    path: Path,
    robot: int,
    end_s: float | None,
    playpen: "Playpen",
    settings: "ShadowSettings",
    exit_on: Collection[ExitOn],
    output: Path | None,
) -> None:
    """Follow a recorded robot."""
    from khep_twin.shadow.recording import read_recording

    line = read_recording(path, robot, playpen.robots[0].robot_model)
    settings = replace(settings, baud=line.baud or settings.baud)
    end_ns = line.chunks[-1].time_ns
    if end_s is not None and end_s * NS_PER_S < end_ns:
        end_ns = int(end_s * NS_PER_S)
    with stopping() as stop, closing(ShadowRun(playpen, settings, exit_on, output, path)) as run:
        start_wall_s = time.monotonic()
        with progress_bar() as show:
            code = run.follow(_chunks_until(line.chunks, end_ns, show), stop)
        took_s = time.monotonic() - start_wall_s
    run.print_summary(took_s)
    if code:
        raise typer.Exit(code)


def _follow_line(descriptor: int, run: ShadowRun, viewer: AbstractContextManager[None]) -> None:
    """Follow a relay's line, in the process of `cli.shadow_process`."""
    from khep_twin.cli.shadow_process import READY
    from khep_twin.shadow.line_pipe import LineReceiver

    # The relay and the host have priority if cores are few.
    lower_priority(by=_NICENESS_STEPS)
    with viewer, stopping(None) as stop:
        with closing(run), status_line() as status:
            os.write(descriptor, READY)
            line = LineReceiver(descriptor, stop)
            code = run.follow(_watch_delay(line), stop, None if status is None else status.show)
        run.print_summary()
        os.write(descriptor, bytes([code]))
        os.close(descriptor)
    if code:
        raise typer.Exit(code)


def _watch_delay(line: "LineReceiver") -> "Iterator[LineChunk]":
    """Yield the bytes on the line; print a line if the shadow falls behind or catches up."""
    is_late = False
    for chunk in line:
        yield chunk
        delay_s = line.lag_s(chunk.time_ns)
        if not is_late and delay_s > _MAX_DELAY_S:
            notify(f"the shadow is {delay_s:.1f} s behind its robot; nothing is lost, its alarms are late")
            is_late = True
        elif is_late and delay_s < _MAX_DELAY_S / 2:
            notify("the shadow has caught up with its robot")
            is_late = False


def _relay_with_shadow(
    port: str,
    baud: int,
    args: list[str],
    endpoint: EndpointOptions,
    logging: LogOptions,
    model: "RobotModel",
    requests: "Sequence[bytes]",
) -> None:
    """Relay a robot's line, with a shadow in a separate process."""
    from khep_twin.cli.shadow_process import run_shadow

    with stopping() as stop, run_shadow(args, stop) as shadow, beside_status_line():

        def has_ended() -> bool:
            return stop() or shadow.has_ended_on_event()

        try:
            listener = shadow.make_listener
            relay_robot(
                port, baud, endpoint, logging, listener, model=model, poll_requests=requests, stop=has_ended
            )
        except Exception:
            shadow.finish()
            raise
        code = shadow.finish()
    if code:
        raise typer.Exit(code)


def _chunks_until(
    chunks: "Sequence[LineChunk]", end_ns: int, progress: Callable[[float], None] | None
) -> "Iterator[LineChunk]":
    """Yield recorded bytes up to a time, and a chunk without bytes at that time."""
    from khep_twin.shadow.recording import LineChunk

    for chunk in chunks:
        if chunk.time_ns > end_ns:
            break
        yield chunk
        if progress is not None:
            progress(chunk.time_ns / max(end_ns, 1))
    yield LineChunk(end_ns, to_robot=True, data=b"")
