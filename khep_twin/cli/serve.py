"""`khep-twin serve`: a twin, or a robot, behind pseudo-terminals or on the network."""

import fcntl
import math
import os
from collections.abc import Callable, Generator, Mapping, Sequence
from contextlib import AbstractContextManager, ExitStack, closing, contextmanager
from enum import StrEnum
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from khep_twin.cli.completion import ports
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
    RomVersion,
    Seed,
    Spread,
    Switch,
    Viewer,
    check_body,
    check_carry_on,
    check_log,
    check_new,
    complain,
    given,
    running_mode,
    tell_kept,
    usage,
)
from khep_twin.cli.playpen import PlaypenName
from khep_twin.errors import PortError
from khep_twin.invocation import command
from khep_twin.signals import stopping

if TYPE_CHECKING:
    from khep_twin.ports.host_connection import Cable

_OF_A_SERVED_TWIN = {"clock", "speed", "unpaced", "strict_line"}


class Clock(StrEnum):
    """Clock of a served twin."""

    REAL = "real"
    WIRE = "wire"


def serve(
    context: typer.Context,
    playpen: PlaypenName = "default",
    link: Annotated[
        str | None,
        typer.Option(
            metavar="PATH",
            help="Make this link to the pseudo-terminal; the path to open is printed. NAME alone lies in a "
            "private directory, $XDG_RUNTIME_DIR/khep_twin; ./NAME lies in the current directory.",
        ),
    ] = None,
    tcp: Annotated[
        str | None, typer.Option(help="Serve on TCP at HOST:PORT instead, for socket://HOST:PORT.")
    ] = None,
    rfc2217: Annotated[
        str | None, typer.Option(help="Serve by RFC 2217 at HOST:PORT instead, for rfc2217://HOST:PORT.")
    ] = None,
    expose: Annotated[
        bool, typer.Option("--expose", help="Let other machines reach --tcp or --rfc2217, too.")
    ] = False,
    clock: Annotated[
        Clock, typer.Option(help="real: the wall clock; wire: only bytes on the line take time.")
    ] = Clock.REAL,
    speed: Annotated[str, typer.Option(help="Simulated seconds per real second: a number, or max.")] = "1",
    unpaced: Annotated[bool, typer.Option("--unpaced", help="Let bytes cross the line in no time.")] = False,
    through: Annotated[
        str | None,
        typer.Option(
            help="Serve the robot at this port instead of a twin: all is passed on, and logged.",
            autocompletion=ports,
        ),
    ] = None,
    strict_line: Annotated[
        bool, typer.Option("--strict-line", help="Garble the bytes of a host at another speed.")
    ] = False,
    ready_fd: Annotated[
        int | None, typer.Option(help="Write what hosts open to this descriptor, too, and close it.")
    ] = None,
    seed: Seed = 0,
    noise: Noise = Switch.ON,
    spread: Spread = Switch.OFF,
    robot: Annotated[
        int | None, typer.Option(help="Serve only this robot of the playpen, counted from 0.")
    ] = None,
    mode: Mode = None,
    rom: RomVersion = None,
    model: Model = None,
    battery_used_min: Battery = None,
    fault: Faults = None,
    log: Log = None,
    carry_on: CarryOn = False,
    viewer: Viewer = False,
    force: Force = False,
) -> None:
    """Serve a twin, or with --through a robot, behind pseudo-terminals or on the network until stopped.

    Standard output has one line for each robot: the path or URL that its host opens.
    """
    from khep_twin.host.opening import numbered
    from khep_twin.ports.endpoints import far_ends
    from khep_twin.ports.serve import WIRE
    from khep_twin.ports.serve import serve as serve_twin
    from khep_twin.ports.twin import TwinOptions, open_twin

    check_carry_on(carry_on, log)
    check_new(force, log)
    _check_ready_fd(ready_fd)
    where = partial(far_ends, link=link, tcp=tcp, rfc2217=rfc2217, expose=expose)
    if through is not None:
        if ignored := given(context) & (OF_A_TWIN | _OF_A_SERVED_TWIN) - {"mode", "log", "carry_on"}:
            option = "PLAYPEN" if "playpen" in ignored else f"--{min(ignored).replace('_', '-')}"
            raise usage(f"{option} is for a twin, not for a robot at --through")
        _relay(numbered(through), running_mode(mode), where, ready_fd, log, carry_on)
        return
    factor = WIRE if clock is Clock.WIRE else _speed(speed)
    options = TwinOptions(
        seed,
        robot,
        noise is Switch.ON,
        spread is Switch.ON,
        rom,
        running_mode(mode),
        battery_used_min,
        unpaced,
        strict_line,
        tuple(fault or ()),
        model=model,
    )
    with (
        stopping() as stop,
        open_twin(playpen, options) as twin,
        where({robot.index: robot.firmware.baud for robot in twin.robots}) as cables,
        ExitStack() as stack,
    ):
        check_body(rom, (twin.world.playpen.robots[robot.index] for robot in twin.robots))
        if log is not None:
            twin.record(log, carry_on=complain if carry_on else None)
            tell_kept(twin.recorder)
        if viewer:
            from khep_twin.mujoco_viewer import MujocoViewer

            window = stack.enter_context(closing(MujocoViewer(real_time=False)))
            window.watch(twin.world)
        what = f"twin in {playpen}"
        with _listed(cables, what):
            _announce(cables, ready_fd, what)
            pacer = serve_twin(twin, cables, factor, stop=stop, tell=complain)
        dropped = sum(cable.dropped for cable in cables)
    if pacer.slips:
        typer.echo(f"fell behind {pacer.slips} times, {pacer.slipped_ns / 1e9:.2f} s in all", err=True)
    _tell_served(twin.world.time_ns, dropped)
    check_log(twin.recorder, carry_on)
    _tell_log(log)


def _relay(
    through: str,
    mode: int | None,
    where: Callable[[Mapping[int, int]], AbstractContextManager[Sequence["Cable"]]],
    ready_fd: int | None,
    log: Path | None,
    carry_on: bool,
) -> None:
    """Serve the robot at a port."""
    from khep_twin.board.rom import ROMS
    from khep_twin.log.line_recorder import LineRecorder
    from khep_twin.ports.relay import Device, relay, since_now

    number, modes = 1 if mode is None else mode, ROMS["khepera2"]
    if reason := modes.refused(number):
        raise usage(f"--mode {number:X}: {reason}")
    baud = modes.modes[number].baud
    with (
        stopping() as stop,
        closing(Device(through, baud)) as device,
        where({0: baud}) as cables,
        ExitStack() as stack,
    ):
        now = since_now()
        recorder = None
        if log is not None:
            told = complain if carry_on else None
            recorder = LineRecorder(log, {"through": through, "baud": baud}, now, carry_on=told)
            stack.enter_context(closing(recorder))
        tell_kept(recorder)
        what = f"robot at {through}"
        stack.enter_context(_listed(cables, what))
        _announce(cables, ready_fd, what)
        relay(device, cables[0], recorder, stop=stop, tell=complain)
        duration_ns, dropped = now(), cables[0].dropped
    _tell_served(duration_ns, dropped)
    check_log(recorder, carry_on)
    _tell_log(log)


@contextmanager
def _listed(cables: Sequence["Cable"], what: str) -> Generator[None, None, None]:
    """Let `khep-twin ports` find what is served."""
    from khep_twin.ports.service_registry import registered

    with ExitStack() as stack:
        try:
            stack.enter_context(registered([cable.path for cable in cables], what))
        except PortError as error:
            complain(f"not listed by khep-twin ports: {error}")
        yield


def _tell_served(duration_ns: int, dropped: int) -> None:
    """Print a summary at the end of serving."""
    typer.echo(f"{duration_ns / 1e9:.1f} s served", err=True)
    if dropped:
        typer.echo(f"{dropped} bytes dropped that no host took", err=True)


def _tell_log(log: Path | None) -> None:
    """Print where the log is, if there is one."""
    if log is not None:
        typer.echo(f"log      {log}      look at it: {command('view', log)}", err=True)


def _announce(cables: Sequence["Cable"], descriptor: int | None, what: str) -> None:
    """Print what is served and what hosts open: on standard output and to the descriptor, if any."""
    complain(f"serving a {what}; hosts open what the next lines name; Ctrl-C ends it")
    paths = "".join(f"{cable.path}\n" for cable in cables)
    typer.echo(paths, nl=False)
    if descriptor is None:
        return
    try:
        with open(descriptor, "w") as file:
            file.write(paths)
    except OSError as error:
        raise usage(f"--ready-fd {descriptor}: cannot be written: {error.strerror}") from None


def _check_ready_fd(descriptor: int | None) -> None:
    """Refuse a descriptor that is not open for writing."""
    if descriptor is None:
        return
    wish = "expected 3 or above, of what is open for writing, such as --ready-fd 3 3>ready"
    if not 3 <= descriptor < 2**31:
        raise usage(f"--ready-fd {descriptor}: {wish}")
    try:
        # What this process has opened itself is not passed on to others.
        given = os.get_inheritable(descriptor)
        writable = fcntl.fcntl(descriptor, fcntl.F_GETFL) & os.O_ACCMODE != os.O_RDONLY
    except OSError:
        given = writable = False
    if not (given and writable):
        raise usage(f"--ready-fd {descriptor}: is not open{' for writing' if given else ''}; {wish}")


def _speed(text: str) -> float:
    if text == "max":
        return math.inf
    try:
        speed = float(text)
    except ValueError:
        speed = math.nan
    if not 0.001 <= speed <= 1000:
        raise usage(f"--speed {text}: expected a number from 0.001 to 1000, or max")
    return speed
