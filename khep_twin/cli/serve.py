"""`khep-twin serve`: a twin, or a relayed robot, on pseudo-terminals or network ports."""

import math
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass, replace
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from khep_twin.board.rom import SELF_TEST_MODE
from khep_twin.cli.completion import ports
from khep_twin.cli.endpoints import EndpointOptions, line_baud, print_end, relay_robot
from khep_twin.cli.option_groups import LiveViewOptions, LogOptions, RobotOptions, option_names, with_help
from khep_twin.cli.options import (
    Faults,
    Viewer,
    check_new,
    note_firmware_only,
    notify,
    print_kept_log,
    running_mode,
    typed_options,
    usage,
)
from khep_twin.cli.playpen import PlaypenName
from khep_twin.process.signals import stopping
from khep_twin.robots.registry import find_family

if TYPE_CHECKING:
    from khep_twin.ports.twin import Twin, TwinOptions


class Clock(StrEnum):
    """Clock of a served twin."""

    REAL = "real"
    WIRE = "wire"


@dataclass(frozen=True, slots=True)
class TimingOptions:
    """Timing of a served twin and of the bytes on its line."""

    clock: Annotated[
        Clock, typer.Option(help="real: the wall clock; wire: time advances only with bytes on the line.")
    ] = Clock.REAL
    speed: Annotated[str, typer.Option(help="Simulated seconds per real second: a number, or max.")] = "1"
    unpaced: Annotated[bool, typer.Option("--unpaced", help="Transmit bytes without delay.")] = False
    strict_line: Annotated[
        bool, typer.Option("--strict-line", help="Garble the bytes of a host at another baud rate.")
    ] = False

    def speed_factor(self) -> float:
        """Return the simulated seconds per real second."""
        from khep_twin.ports.serve import WIRE_SPEED

        if self.clock is Clock.WIRE:
            if self.speed != "1":
                raise usage("--speed: has no effect with --clock wire; expected one of them")
            return WIRE_SPEED
        return speed_factor(self.speed)


def speed_factor(text: str) -> float:
    """Return the simulated seconds per real second of an option --speed."""
    if text == "max":
        return math.inf
    try:
        speed = float(text)
    except ValueError:
        speed = math.nan
    if not 0.001 <= speed <= 1000:
        raise usage(f"--speed {text}: expected a number from 0.001 to 1000, or max")
    return speed


_TWIN_OPTIONS = option_names(RobotOptions, TimingOptions, LiveViewOptions) - {"mode", "model"} | {
    *("playpen", "robot", "fault", "viewer", "from_log")
}
"""Options of a twin that do not apply to a robot, by their parameters' names."""


_LOGGED_OPTIONS = (option_names(RobotOptions) | {"playpen", "unpaced", "strict_line", "relay"}) - {"seed"}
"""Options that a resumed twin takes from its log."""


@with_help
def serve(
    context: typer.Context,
    *,
    playpen: PlaypenName = "default",
    endpoint: EndpointOptions,
    timing: TimingOptions,
    relay: Annotated[str | None, typer.Option(autocompletion=ports)] = None,
    from_log: Annotated[str | None, typer.Option("--from", metavar="FILE.mcap[@SECONDS]")] = None,
    robot: int | None = None,
    twin: RobotOptions,
    fault: Faults = None,
    logging: LogOptions,
    live_view: LiveViewOptions,
    viewer: Viewer = False,
) -> None:
    """Serve a twin, or with --relay a robot, until stopped.

    Its serial lines are pseudo-terminals or network ports.

    Standard output has one line per robot: the path or URL for its host to open.

    Args:
        relay: Relay the robot at this port instead of a twin, and log its line; --model for another than a
            Khepera.
        from_log: Resume the run of this log at a time, or at its end, instead of a playpen.
        robot: Serve only this robot, counted from 0.
    """
    from khep_twin.host.opening import resolve_port

    check_new(logging.force, logging.log)
    endpoint.check()
    if relay is not None:
        if ignored := typed_options(context) & _TWIN_OPTIONS:
            option = "PLAYPEN" if "playpen" in ignored else f"--{min(ignored).replace('_', '-')}"
            option = option.removesuffix("-log") if option == "--from-log" else option
            raise usage(f"{option} is for a twin, not for a robot at --relay")
        with stopping() as stop:
            mode, model = running_mode(twin.mode), None if twin.model is None else find_family(twin.model)
            baud = line_baud(mode) if model is None or mode is not None else model.dialect.baud
            relay_robot(resolve_port(relay), baud, endpoint, logging, model=model, stop=stop)
        return
    if timing.strict_line and endpoint.tcp is not None:
        raise usage("--strict-line: hosts at --tcp have no baud rate; expected a terminal or --rfc2217")
    factor, faults = timing.speed_factor(), tuple(fault or ())
    if from_log is not None:
        if ignored := typed_options(context) & _LOGGED_OPTIONS:
            option = "PLAYPEN" if "playpen" in ignored else f"--{min(ignored).replace('_', '-')}"
            raise usage(f"{option} is that of the log; expected only --seed, --fault and --robot with --from")
        path, start_ns = _parse_log_time(from_log)
        seed = twin.seed if "seed" in typed_options(context) else None

        def open_resumed() -> "Twin":
            from khep_twin.log.recorded import BranchPoint
            from khep_twin.ports.branching import open_log
            from khep_twin.ports.resume import run_end_ns

            change = BranchPoint(run_end_ns(path) if start_ns is None else start_ns, seed=seed, faults=faults)
            return open_log(path, change, robot, logging.log, all_robots=True, on_failure=logging.on_failure)

        _serve_twin(open_resumed, from_log, factor, endpoint, logging, live_view, viewer)
        return
    options = replace(
        twin.options(robot), unpaced=timing.unpaced, strict_line=timing.strict_line, faults=faults
    )
    _serve_twin(
        lambda: _open_twin(playpen, options, logging), playpen, factor, endpoint, logging, live_view, viewer
    )


def _open_twin(playpen: str, options: "TwinOptions", logging: LogOptions) -> "Twin":
    """Open the twin of a playpen, and start its log."""
    from khep_twin.ports.twin import open_twin

    twin = open_twin(playpen, options)
    robots = [twin.world.playpen.robots[robot.index] for robot in twin.robots]
    note_firmware_only(options.rom, robots)
    if any(robot.mode == SELF_TEST_MODE for robot in robots):
        notify("mode 7: the self-test has run at power-up; hosts that send restart get its report")
    if logging.log is not None:
        twin.record(logging.log, on_failure=logging.on_failure)
    return twin


def _parse_log_time(text: str) -> tuple[Path, int | None]:
    """Return the file and the time [ns] of FILE.mcap[@SECONDS]; None for its end."""
    name, separator, seconds = text.rpartition("@")
    if not separator or text.endswith(".mcap"):
        return Path(text), None
    try:
        if 0 < (time_s := float(seconds)) < 1e9:
            return Path(name), round(time_s * 1e9)
    except ValueError:
        pass
    raise usage(f"--from {text}: expected FILE.mcap@SECONDS, with a time above 0")


def _serve_twin(
    open_twin: "Callable[[], Twin]",
    name: str,
    speed_factor: float,
    endpoint: EndpointOptions,
    logging: LogOptions,
    live_view: LiveViewOptions,
    viewer: bool,
) -> None:
    """Serve a twin at `speed_factor` simulated seconds per real second."""
    from khep_twin.ports.serve import MANY_ROBOTS, WIRE_SPEED
    from khep_twin.ports.serve import serve as serve_twin

    with (
        stopping() as stop,
        open_twin() as twin,
        endpoint.open({robot.index: robot.firmware.baud for robot in twin.robots}) as ports,
        ExitStack() as stack,
    ):
        print_kept_log(twin.recorder)
        remote = endpoint.allow_remote
        live_view.open_viewers(stack, name, viewer=viewer, real_time=False, allow_remote=remote)(twin)
        if speed_factor > 1 or speed_factor == WIRE_SPEED or len(twin.world.robots) >= MANY_ROBOTS:
            # Load compiled code before the first host opens, as that takes half a second.
            twin.world.code.switch_if_ready()
        with endpoint.announce(ports, f"twin in {name}", speed_factor):
            pacer = serve_twin(twin, ports, speed_factor, stop=stop, notify=notify)
        dropped_bytes = sum(port.dropped for port in ports)
    if pacer.slips:
        typer.echo(f"fell behind {pacer.slips} times, {pacer.slipped_ns / 1e9:.2f} s in all", err=True)
    print_end(twin.world.time_ns, dropped_bytes, logging, twin.recorder)
