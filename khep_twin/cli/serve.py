"""`khep-twin serve`: a twin, or a robot, behind pseudo-terminals or on the network."""

import math
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass, replace
from enum import StrEnum
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from khep_twin.cli.completion import ports
from khep_twin.cli.endpoints import EndpointOptions, line_baud, relay_robot, tell_end
from khep_twin.cli.option_groups import LiveViewOptions, LogOptions, RobotOptions, grouped, option_names
from khep_twin.cli.options import (
    Faults,
    Viewer,
    check_body,
    check_new,
    complain,
    given,
    running_mode,
    tell_kept,
    usage,
)
from khep_twin.cli.playpen import PlaypenName
from khep_twin.signals import stopping

if TYPE_CHECKING:
    from khep_twin.ports.twin import Twin, TwinOptions


class Clock(StrEnum):
    """Clock of a served twin."""

    REAL = "real"
    WIRE = "wire"


@dataclass(frozen=True, slots=True)
class TimingOptions:
    """Time of a served twin, and that of bytes on its line."""

    clock: Annotated[
        Clock, typer.Option(help="real: the wall clock; wire: only bytes on the line take time.")
    ] = Clock.REAL
    speed: Annotated[str, typer.Option(help="Simulated seconds per real second: a number, or max.")] = "1"
    unpaced: Annotated[bool, typer.Option("--unpaced", help="Let bytes cross the line in no time.")] = False
    strict_line: Annotated[
        bool, typer.Option("--strict-line", help="Garble the bytes of a host at another speed.")
    ] = False

    def factor(self) -> float:
        """Return the simulated seconds per real second."""
        from khep_twin.ports.serve import WIRE

        if self.clock is Clock.WIRE:
            if self.speed != "1":
                raise usage("--speed: has no effect with --clock wire; expected one of them")
            return WIRE
        if self.speed == "max":
            return math.inf
        try:
            speed = float(self.speed)
        except ValueError:
            speed = math.nan
        if not 0.001 <= speed <= 1000:
            raise usage(f"--speed {self.speed}: expected a number from 0.001 to 1000, or max")
        return speed


_OF_A_TWIN = option_names(RobotOptions, TimingOptions, LiveViewOptions) - {"mode"} | {
    *("playpen", "robot", "fault", "viewer", "from_log")
}
"""Options of a twin that mean nothing to a robot, by the names of their parameters."""


_OF_THE_LOG = (option_names(RobotOptions) | {"playpen", "unpaced", "strict_line", "relay"}) - {"seed"}
"""Options of a twin that is resumed from a log which are the log's."""


@grouped
def serve(
    context: typer.Context,
    *,
    playpen: PlaypenName = "default",
    endpoint: EndpointOptions,
    timing: TimingOptions,
    relay: Annotated[
        str | None,
        typer.Option(
            help="Serve the robot at this port instead of a twin: all is passed on, and logged.",
            autocompletion=ports,
        ),
    ] = None,
    from_log: Annotated[
        str | None,
        typer.Option(
            "--from",
            metavar="FILE.mcap[@SECONDS]",
            help="Take up the run of this log at a moment, or at its end, instead of a playpen.",
        ),
    ] = None,
    robot: Annotated[int | None, typer.Option(help="Serve only this robot, counted from 0.")] = None,
    twin: RobotOptions,
    fault: Faults = None,
    logging: LogOptions,
    live_view: LiveViewOptions,
    viewer: Viewer = False,
) -> None:
    """Serve a twin, or with --relay a robot, until stopped.

    Its lines are pseudo-terminals, or ports of the network.

    Standard output has one line for each robot: the path or URL that its host opens.
    """
    from khep_twin.host.opening import numbered

    check_new(logging.force, logging.log)
    endpoint.check()
    if relay is not None:
        if ignored := given(context) & _OF_A_TWIN:
            option = "PLAYPEN" if "playpen" in ignored else f"--{min(ignored).replace('_', '-')}"
            option = option.removesuffix("-log") if option == "--from-log" else option
            raise usage(f"{option} is for a twin, not for a robot at --relay")
        with stopping() as stop:
            relay_robot(numbered(relay), line_baud(running_mode(twin.mode)), endpoint, logging, stop=stop)
        return
    if timing.strict_line and endpoint.tcp is not None:
        raise usage("--strict-line: hosts at --tcp have no speed; expected a terminal or --rfc2217")
    factor, faults = timing.factor(), tuple(fault or ())
    if from_log is not None:
        if ignored := given(context) & _OF_THE_LOG:
            option = "PLAYPEN" if "playpen" in ignored else f"--{min(ignored).replace('_', '-')}"
            raise usage(f"{option} is the log's own; --from goes with --seed, --fault and --robot")
        path, at_ns = _moment(from_log)
        seed = twin.seed if "seed" in given(context) else None
        opening = partial(_open_log, path, at_ns, seed, faults, robot, logging)
        _serve_twin(opening, from_log, factor, endpoint, logging, live_view, viewer)
        return
    options = replace(
        twin.options(robot), unpaced=timing.unpaced, strict_line=timing.strict_line, faults=faults
    )
    _serve_twin(
        lambda: _open(playpen, options, logging), playpen, factor, endpoint, logging, live_view, viewer
    )


def _open(playpen: str, options: "TwinOptions", logging: LogOptions) -> "Twin":
    """Open the twin of a playpen, and begin its log."""
    from khep_twin.board.rom import SELF_TEST_MODE
    from khep_twin.ports.twin import open_twin

    twin = open_twin(playpen, options)
    robots = [twin.world.playpen.robots[robot.index] for robot in twin.robots]
    check_body(options.rom, robots)
    if any(robot.mode == SELF_TEST_MODE for robot in robots):
        complain("mode 7: the self-test has run at power-up; hosts that send restart get its report")
    if logging.log is not None:
        twin.record(logging.log, on_failure=logging.on_failure)
    return twin


def _open_log(
    path: Path,
    at_ns: int | None,
    seed: int | None,
    faults: tuple[str, ...],
    robot: int | None,
    logging: LogOptions,
) -> "Twin":
    """Take up the run of a log."""
    from khep_twin.log.recorded import BranchPoint
    from khep_twin.ports.branching import open_log
    from khep_twin.ports.resume import run_end_ns

    change = BranchPoint(run_end_ns(path) if at_ns is None else at_ns, seed=seed, faults=faults)
    return open_log(path, change, robot, logging.log, served=True, on_failure=logging.on_failure)


def _moment(text: str) -> tuple[Path, int | None]:
    """Return the file and the moment [ns] of FILE.mcap[@SECONDS]; None for its end."""
    name, at, seconds = text.rpartition("@")
    if not at or text.endswith(".mcap"):
        return Path(text), None
    try:
        if 0 < (moment := float(seconds)) < 1e9:
            return Path(name), round(moment * 1e9)
    except ValueError:
        pass
    raise usage(f"--from {text}: expected FILE.mcap@SECONDS, with a time above 0")


def _serve_twin(
    open_it: "Callable[[], Twin]",
    name: str,
    factor: float,
    endpoint: EndpointOptions,
    logging: LogOptions,
    live_view: LiveViewOptions,
    viewer: bool,
) -> None:
    """Serve a twin at so many simulated seconds per real second."""
    from khep_twin.ports.serve import MANY, WIRE
    from khep_twin.ports.serve import serve as serve_twin

    with (
        stopping() as stop,
        open_it() as twin,
        endpoint.open({robot.index: robot.firmware.baud for robot in twin.robots}) as ports,
        ExitStack() as stack,
    ):
        tell_kept(twin.recorder)
        remote = endpoint.allow_remote
        live_view.watching(stack, name, viewer=viewer, real_time=False, allow_remote=remote)(twin)
        if factor > 1 or factor == WIRE or len(twin.world.robots) >= MANY:
            # Before the first host, as loading compiled code takes half a second.
            twin.world.code.switch_if_ready()
        with endpoint.announced(ports, f"twin in {name}"):
            pacer = serve_twin(twin, ports, factor, stop=stop, notify=complain)
        dropped = sum(port.dropped for port in ports)
    if pacer.slips:
        typer.echo(f"fell behind {pacer.slips} times, {pacer.slipped_ns / 1e9:.2f} s in all", err=True)
    tell_end(twin.world.time_ns, dropped, logging, twin.recorder)
