"""`khep-twin shadow`: the twin beside a robot, live or from a log."""

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
from khep_twin.cli.option_groups import LogOptions, grouped, option_names
from khep_twin.cli.options import (
    check_apart,
    check_new,
    check_writable,
    complain,
    refuse,
    running_mode,
    usage,
)
from khep_twin.cli.playpen import PlaypenName
from khep_twin.cli.progress import progress as progress_bar
from khep_twin.cli.shadow_run import EXIT_CODES, ExitOn, ShadowOptions, ShadowRun
from khep_twin.clock import NS_PER_S
from khep_twin.machine import lower_priority
from khep_twin.signals import stopping
from khep_twin.status_line import beside_status_line, status_line

if TYPE_CHECKING:
    from khep_twin.playpen import Playpen
    from khep_twin.shadow.line_pipe import LineReceiver
    from khep_twin.shadow.recording import Heard
    from khep_twin.shadow.shadow import ShadowSettings

_BEHIND_S = 2.0
"""Delay of the estimate that is reported (assumed) [s]."""

_NICE = 5
"""What a shadow beside a relay adds to its niceness (assumed)."""


_OF_A_ROBOT = option_names(EndpointOptions) | {"mode", "poll", "view", "web", "log", "ignore_log_errors"}
"""Options of a robot at --relay that mean nothing to a log, by the names of their parameters."""


@grouped
def shadow(
    context: typer.Context,
    *,
    playpen: PlaypenName,
    recording: Annotated[
        Path | None,
        typer.Argument(metavar="LOG", help="Log of a relay, or of a twin, FILE.mcap.", autocompletion=logs),
    ] = None,
    relay: Annotated[
        str | None,
        typer.Option(
            help="Follow the robot at this port, and pass all on to its host.", autocompletion=ports
        ),
    ] = None,
    endpoint: EndpointOptions,
    mode: Annotated[
        str | None, typer.Option(help="Running mode of the robot: the speed of its line.")
    ] = None,
    poll: Annotated[bool, typer.Option("--poll", help="Ask the robot while no host does.")] = False,
    robot: Annotated[int, typer.Option(min=0, help="Number of the robot in playpen and log, from 0.")] = 0,
    options: ShadowOptions,
    until: Annotated[float | None, typer.Option(min=0, help="End at this time of the log [s].")] = None,
    exit_on: Annotated[
        list[ExitOn] | None,
        typer.Option(
            help=f"End at the first alarm, with exit code {EXIT_CODES[ExitOn.ALARM]}, or where the followed "
            f"robot is lost, with {EXIT_CODES[ExitOn.LOST]}; may be given for both."
        ),
    ] = None,
    output: Annotated[
        Path | None,
        typer.Option("--output", "-o", help="Log of poses, residuals and alarms to write, FILE.mcap."),
    ] = None,
    view: Annotated[bool, typer.Option("--view", help="Show it in rerun while it goes on.")] = False,
    web: Annotated[bool, typer.Option("--web", help="With --view: in a browser, not in a window.")] = False,
    logging: LogOptions,
    line_fd: Annotated[int | None, typer.Option(hidden=True)] = None,
) -> None:
    """Follow a robot by its line, live or from a log.

    The twin tells where the robot is, and what is wrong with it.

    Standard output has a line for each alarm that begins or ends, and where the robot is lost or found again,
    with --relay after what a host opens.
    """
    settings = options.settings(line_baud(running_mode(mode)))
    check_writable(output)
    check_apart([playpen, *([] if recording is None else [recording])], output, logging.log)
    check_new(logging.force, output, logging.log)
    if relay is not None:
        if recording is not None or until is not None:
            raise usage("--relay follows a robot, not a log; expected either, and --until with a log only")
        endpoint.check()
        words = [playpen, f"--robot={robot}", *options.words(), *(["--mode", mode] if mode else [])]
        words += [*(f"--exit-on={each}" for each in exit_on or ()), *(["--force"] if logging.force else [])]
        words += ["--output", str(output)] if output is not None else []
        words += [*(["--view"] if view else []), *(["--web"] if web else [])]
        from khep_twin.host.opening import numbered

        _beside_robot(numbered(relay), settings.baud, words, endpoint, logging, poll)
        return
    found, has_others = options.load(playpen, robot)
    settings = replace(settings, others=has_others)
    if line_fd is not None:
        run = ShadowRun(found, settings, exit_on or (), output)
        _follow_line(line_fd, run, run.show_in_viewer(web=web) if view else nullcontext())
        return
    refuse(context, _OF_A_ROBOT, "a robot at --relay, not for a log")
    if recording is None:
        raise usage("nothing to follow; expected a log, FILE.mcap, or a robot's port, --relay PORT")
    _follow_log(recording, robot, until, found, settings, exit_on or (), output)


def _follow_log(
    path: Path,
    robot: int,
    until: float | None,
    playpen: "Playpen",
    settings: "ShadowSettings",
    exit_on: Collection[ExitOn],
    output: Path | None,
) -> None:
    """Follow a recorded robot."""
    from khep_twin.shadow.recording import recorded

    line = recorded(path, robot)
    if line.baud is not None:
        settings = replace(settings, baud=line.baud)
    end_ns = line.heard[-1].time_ns
    if until is not None and until * NS_PER_S < end_ns:
        end_ns = int(until * NS_PER_S)
    with stopping() as stop, closing(ShadowRun(playpen, settings, exit_on, output, path)) as run:
        begun = time.monotonic()
        with progress_bar() as show:
            code = run.follow(_until(line.heard, end_ns, show), stop)
        took_s = time.monotonic() - begun
    run.print_summary(took_s)
    if code:
        raise typer.Exit(code)


def _follow_line(descriptor: int, run: ShadowRun, viewer: AbstractContextManager[None]) -> None:
    """Follow a relay's line, as the process of `cli.shadow_process`."""
    from khep_twin.cli.shadow_process import READY
    from khep_twin.shadow.line_pipe import LineReceiver

    # Where cores are few, the relay and the host come first.
    lower_priority(by=_NICE)
    with viewer, stopping(None) as stop:
        with closing(run), status_line() as status:
            os.write(descriptor, READY)
            line = LineReceiver(descriptor, stop)
            code = run.follow(_on_time(line), stop, None if status is None else status.show)
        run.print_summary()
        os.write(descriptor, bytes([code]))
        os.close(descriptor)
    if code:
        raise typer.Exit(code)


def _on_time(line: "LineReceiver") -> "Iterator[Heard]":
    """Yield what crosses the line; tell where the shadow falls behind."""
    told = False
    for each in line:
        yield each
        behind_s = line.behind_s(each.time_ns)
        if not told and behind_s > _BEHIND_S:
            complain(f"the shadow is {behind_s:.1f} s behind its robot; nothing is lost, its alarms are late")
            told = True
        elif told and behind_s < _BEHIND_S / 2:
            complain("the shadow has caught up with its robot")
            told = False


def _beside_robot(
    port: str, baud: int, words: list[str], endpoint: EndpointOptions, logging: LogOptions, poll: bool
) -> None:
    """Relay a robot's line, with a shadow in its own process."""
    from khep_twin.cli.shadow_process import run_shadow

    with stopping() as stop, run_shadow(words, stop) as shadow, beside_status_line():

        def ends() -> bool:
            return stop() or shadow.ended_as_asked()

        try:
            relay_robot(port, baud, endpoint, logging, shadow.listener, poll=poll, stop=ends)
        except Exception:
            shadow.finish()
            raise
        code = shadow.finish()
    if code:
        raise typer.Exit(code)


def _until(
    heard: "Sequence[Heard]", end_ns: int, progress: Callable[[float], None] | None
) -> "Iterator[Heard]":
    """Yield what was heard up to a time, and that nothing came after it until then."""
    from khep_twin.shadow.recording import Heard

    for each in heard:
        if each.time_ns > end_ns:
            break
        yield each
        if progress is not None:
            progress(each.time_ns / max(end_ns, 1))
    yield Heard(end_ns, True, b"")
