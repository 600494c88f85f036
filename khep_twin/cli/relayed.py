"""A robot behind a relay, as `khep-twin serve --relay` and `khep-twin shadow --relay` serve it."""

from collections.abc import Callable
from contextlib import ExitStack, closing
from typing import TYPE_CHECKING

import typer

from khep_twin.cli.endpoints import EndpointOptions
from khep_twin.cli.option_groups import LogOptions
from khep_twin.cli.options import complain, tell_kept, tell_written, usage

if TYPE_CHECKING:
    from khep_twin.log.line_recorder import LineRecorder
    from khep_twin.log.recorder import Recorder
    from khep_twin.ports.relay import LineListener

ListenerMaker = Callable[[Callable[[], int]], "LineListener"]
"""Function of the line's clock [ns] that returns a listener."""


def line_baud(mode: int | None) -> int:
    """Return the speed of a robot's line in a running mode, of mode 1 without one [baud]."""
    from khep_twin.board.rom import ROMS

    number, modes = 1 if mode is None else mode, ROMS["khepera2"]
    if reason := modes.refused(number):
        raise usage(f"--mode {number:X}: {reason}")
    return modes.modes[number].baud


def relay_robot(
    port: str,
    baud: int,
    endpoint: EndpointOptions,
    logging: LogOptions,
    make_listener: ListenerMaker | None = None,
    *,
    poll: bool = False,
    stop: Callable[[], bool],
) -> None:
    """Serve the robot at a port.

    Args:
        port: Robot's port.
        baud: Speed of its line, until a host sets another [baud].
        endpoint: What hosts open.
        logging: Log of the line.
        make_listener: Makes one more listener on the line.
        poll: Whether to ask the robot while no host does.
        stop: Function that returns whether to end.
    """
    from khep_twin.log.line_recorder import LineRecorder
    from khep_twin.ports.idle_polls import IdlePolls
    from khep_twin.ports.relay import Device, relay, since_now

    with (
        closing(Device(port, baud)) as device,
        endpoint.open({0: baud}) as ports,
        ExitStack() as stack,
    ):
        now = since_now()
        listeners: list[LineListener] = []
        recorder = None
        if logging.log is not None:
            settings = {"relay": port, "baud": baud}
            recorder = LineRecorder(logging.log, settings, now, on_failure=logging.on_failure)
            listeners.append(stack.enter_context(closing(recorder)))
        tell_kept(recorder)
        if make_listener is not None:
            listeners.append(make_listener(now))
        stack.enter_context(endpoint.announced(ports, f"robot at {port}"))
        polls = IdlePolls() if poll else None
        relay(device, ports[0], listeners, polls, stop=stop, notify=complain)
        duration_ns, dropped = now(), ports[0].dropped
    tell_end(duration_ns, dropped, logging, recorder)


def tell_end(
    duration_ns: int, dropped: int, logging: LogOptions, recorder: "Recorder | LineRecorder | None"
) -> None:
    """Print a summary at the end of serving, and where the log is; end the command if that has failed."""
    typer.echo(f"{duration_ns / 1e9:.1f} s served", err=True)
    if dropped:
        typer.echo(f"{dropped} bytes dropped that no host took", err=True)
    logging.check(recorder)
    if logging.log is not None:
        tell_written("log", [logging.log], err=True)
