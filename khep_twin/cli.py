"""The command line: `khep-twin COMMAND`. Thin: each command calls into the package and prints.

What a command needs is imported inside it, so that `khep-twin --help` comes at once.
"""

import math
import shutil
import sys
from collections.abc import Callable, Generator, Mapping, Sequence
from contextlib import AbstractContextManager, ExitStack, closing, contextmanager
from enum import StrEnum
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from khep_twin import __version__
from khep_twin.cli_drive import drive
from khep_twin.cli_fit import fit
from khep_twin.cli_log import recover, repeat
from khep_twin.cli_playpen import PlaypenName, playpen_app
from khep_twin.cli_ports import ports
from khep_twin.cli_progress import progress as progress_bar
from khep_twin.cli_report import export, report
from khep_twin.cli_sense import sense
from khep_twin.cli_view import view
from khep_twin.errors import KhepTwinError, PortError
from khep_twin.files import unusable, write_whole

if TYPE_CHECKING:
    from khep_twin.log.line_recorder import LineRecorder
    from khep_twin.log.recorder import Recorder
    from khep_twin.ports.cable import Cable

app = typer.Typer(
    name="khep-twin",
    help="A physics-based digital twin of the Khepera miniature robot.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
)
app.add_typer(playpen_app, name="playpen")
app.command()(drive)
app.command()(export)
app.command()(fit)
app.command()(ports)
app.command()(report)
app.command()(recover)
app.command()(repeat)
app.command()(sense)
app.command()(view)


class Switch(StrEnum):
    """On or off, as in the options of khep://."""

    ON = "on"
    OFF = "off"


class Clock(StrEnum):
    """What makes time pass for a served twin."""

    REAL = "real"
    WIRE = "wire"


Seed = Annotated[int, typer.Option(help="Seed of every chance in the run.")]
Noise = Annotated[Switch, typer.Option(help="Noisy sensors, as on the robot.")]
Spread = Annotated[Switch, typer.Option(help="Sensors of another robot of the same make, by the seed.")]
RobotIndex = Annotated[int, typer.Option(help="Which of the playpen's robots, counted from 0.")]
Mode = Annotated[
    str | None,
    typer.Option(
        help="Running mode: 1, 2, 3 for 9600, 19200, 38400 baud, with rom khepera2 also 8, 9 for "
        "57600, 115200; 0 demo; 7 self-test."
    ),
]
RomVersion = Annotated[str | None, typer.Option(help="Version of the firmware: 5.02, 4.06 or khepera2.")]
Battery = Annotated[
    float | None,
    typer.Option(
        min=0, max=1000, help="Run on cells that were used so many minutes; without, on the charger."
    ),
]
Faults = Annotated[
    list[str] | None,
    typer.Option(
        "--fault",
        help="Let this go wrong, as often as wanted: drop:P, garble:P, late:P:MS, stuck:SENSOR, dead:SIDE or "
        "brown-out, with @SECONDS to begin later.",
    ),
]
Log = Annotated[Path | None, typer.Option(help="Record the run in this MCAP file.")]
CarryOn = Annotated[
    bool,
    typer.Option(
        "--carry-on",
        help="Go on without the log if it cannot be written any more, as on a full disk; ends with 3 then.",
    ),
]


def main() -> None:
    """Runs the command line; a user's mistake ends in one line, not in a trace."""
    try:
        app(standalone_mode=True)
    except KhepTwinError as error:
        for line in str(error).splitlines():
            print(f"khep-twin: {line}", file=sys.stderr)
        sys.exit(1)


def _show_version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"khep-twin {__version__}")
        raise typer.Exit


@app.callback()
def common(
    version: Annotated[
        bool,
        typer.Option("--version", help="Show the version and end.", callback=_show_version, is_eager=True),
    ] = False,
) -> None:
    """A physics-based digital twin of the Khepera miniature robot."""


@app.command()
def run(
    context: typer.Context,
    controller: Annotated[
        str, typer.Argument(help="A built-in controller (braitenberg), or FILE.py[:FUNCTION].")
    ] = "braitenberg",
    playpen: Annotated[str, typer.Option(help="Playpen of the twin: a shipped name, or a path.")] = "default",
    port: Annotated[
        str | None, typer.Option(help="Port of a robot or a served twin; without, a twin in this process.")
    ] = None,
    seconds: Annotated[float | None, typer.Option(help="End after this time [s]; 60 by default.")] = None,
    cycles: Annotated[int | None, typer.Option(help="End after so many cycles.")] = None,
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
    """Runs a controller on a twin or a robot."""
    from khep_twin.host import Khepera
    from khep_twin.lab import experiment
    from khep_twin.lab.controller_source import source_of
    from khep_twin.ports.protocol_khep import Serial
    from khep_twin.ports.serve import stopping
    from khep_twin.ports.twin import TwinOptions, open_twin

    if port is not None and (ignored := _given(context) & _OF_A_TWIN):
        option = min(ignored).replace("_", "-")
        raise _usage(f"--{option} is for a twin in this process, not for one behind --port")
    _check_carry_on(carry_on, log)
    if picture is not None:
        _check_picture(picture, log)
    if (seconds is not None and not 0 < seconds < math.inf) or (cycles is not None and cycles < 1):
        raise _usage("--seconds and --cycles are above 0 and finite")
    function = experiment.find_controller(controller)
    if seconds is None and cycles is None:
        seconds = 60.0
    port_or_twin: str | Serial
    recorder = None
    if port is None:
        options = TwinOptions(
            seed,
            robot,
            noise is Switch.ON,
            spread is Switch.ON,
            rom,
            _mode(mode),
            battery_used_min,
            faults=tuple(fault or ()),
        )
        twin = open_twin(playpen, options)
        if log is not None:
            source = source_of(function)
            told = _complain if carry_on else None
            twin.record(log, facts=source.facts, attachments=source.attachments, carry_on=told)
        recorder = twin.recorder
        _tell_kept(recorder)
        port_or_twin = Serial.of(twin, timeout=1.0)
    else:
        port_or_twin = port
    with (
        stopping() as stop,
        Khepera(port_or_twin) as khepera,
        progress_bar() as progress,
    ):

        def ends() -> bool:
            # A controller that catches every error catches the log's, too.
            return stop() or (not carry_on and recorder is not None and recorder.failure is not None)

        outcome = experiment.run(
            function, khepera, cycles=cycles, seconds=seconds, progress=progress, stop=ends
        )
        stopped = stop()
    typer.echo(f"{outcome.cycles} cycles in {outcome.duration:.1f} s")
    _check_log(recorder, carry_on)
    if log is not None and picture is not None:
        _draw_log(log, picture)
        typer.echo(f"picture  {picture}")
    if log is not None:
        typer.echo(f"log      {log}      look at it: {_program()} view {log}")
    if stopped:
        typer.echo("khep-twin: stopped before its end", err=True)
        raise typer.Exit(130)


@app.command()
def serve(
    context: typer.Context,
    playpen: PlaypenName = "default",
    link: Annotated[
        Path | None,
        typer.Option(help="Make this link to the pseudo-terminal; a bare name lies in a private directory."),
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
        Clock, typer.Option(help="real: with the clock on the wall; wire: only bytes on the line take time.")
    ] = Clock.REAL,
    speed: Annotated[str, typer.Option(help="Simulated per real second: a number, or max.")] = "1",
    unpaced: Annotated[bool, typer.Option("--unpaced", help="Let bytes cross the line in no time.")] = False,
    through: Annotated[
        str | None,
        typer.Option(help="Serve the robot at this port instead of a twin: all is passed on, and logged."),
    ] = None,
    strict_line: Annotated[
        bool, typer.Option("--strict-line", help="Garble the bytes of a host at another speed.")
    ] = False,
    ready_fd: Annotated[
        int | None, typer.Option(min=1, help="Write what hosts open to this descriptor, too, and close it.")
    ] = None,
    seed: Seed = 0,
    noise: Noise = Switch.ON,
    spread: Spread = Switch.OFF,
    robot: Annotated[
        int | None, typer.Option(help="Serve only this robot of the playpen, counted from 0.")
    ] = None,
    mode: Mode = None,
    rom: RomVersion = None,
    battery_used_min: Battery = None,
    fault: Faults = None,
    log: Log = None,
    carry_on: CarryOn = False,
) -> None:
    """Serves a twin, or with --through a robot, behind pseudo-terminals or on the network until stopped.

    Standard output has one line for each robot: what its host opens.
    """
    from khep_twin.ports.far_ends import far_ends
    from khep_twin.ports.serve import WIRE, stopping
    from khep_twin.ports.serve import serve as serve_twin
    from khep_twin.ports.twin import TwinOptions, open_twin

    _check_carry_on(carry_on, log)
    where = partial(far_ends, link=link, tcp=tcp, rfc2217=rfc2217, expose=expose)
    if through is not None:
        if ignored := _given(context) & (_OF_A_TWIN | _OF_A_SERVED_TWIN) - {"mode", "log", "carry_on"}:
            option = "PLAYPEN" if "playpen" in ignored else f"--{min(ignored).replace('_', '-')}"
            raise _usage(f"{option} is for a twin, not for a robot at --through")
        _relay(through, _mode(mode), where, ready_fd, log, carry_on)
        return
    factor = WIRE if clock is Clock.WIRE else _speed(speed)
    options = TwinOptions(
        seed,
        robot,
        noise is Switch.ON,
        spread is Switch.ON,
        rom,
        _mode(mode),
        battery_used_min,
        unpaced,
        strict_line,
        tuple(fault or ()),
    )
    with (
        stopping() as stop,
        open_twin(playpen, options) as twin,
        where({robot.index: robot.firmware.baud for robot in twin.robots}) as cables,
    ):
        if log is not None:
            twin.record(log, carry_on=_complain if carry_on else None)
            _tell_kept(twin.recorder)
        with _listed(cables, f"twin in {playpen}"):
            _announce(cables, ready_fd)
            pacer = serve_twin(twin, cables, factor, stop=stop, tell=_complain)
        dropped = sum(cable.dropped for cable in cables)
    if pacer.slips:
        typer.echo(f"fell behind {pacer.slips} times, {pacer.slipped_ns / 1e9:.2f} s in all", err=True)
    _tell_served(twin.world.time_ns, dropped)
    _check_log(twin.recorder, carry_on)


@app.command()
def conform(
    port: Annotated[str, typer.Argument(help="Port of a robot or a twin, such as khep://default.")],
    move: Annotated[bool, typer.Option("--move", help="Also run the checks that move the robot.")] = False,
    baudrate: Annotated[int, typer.Option(help="Speed of the line.")] = 9600,
    report: Annotated[Path | None, typer.Option(help="Write the report as JSON, too.")] = None,
) -> None:
    """Checks whether what is at a port speaks the robot's protocol; ends with 1 if it does not."""
    from khep_twin.lab import conformance

    if report is not None and (reason := unusable(report)):
        raise _usage(f"--report {report}: cannot be written: {reason}")
    if move:
        ways = dict.fromkeys(check.moves for check in conformance.checks(True) if check.moves)
        typer.echo(f"the robot {', '.join(ways)}", err=True)
    outcome = conformance.conform(port, move=move, baudrate=baudrate)
    typer.echo(outcome.text())
    if report is not None:
        write_whole(report, outcome.json().encode("utf-8"))
    if not outcome.passed:
        raise typer.Exit(1)


def _draw_log(log: Path, picture: Path) -> None:
    """The playpen and the driven paths of a log."""
    from khep_twin import drawing
    from khep_twin import playpen as playpens
    from khep_twin.log.reader import read

    run = read(log)
    tracks = [
        drawing.Track(name, track.times_ns / 1e9, track.pose[:, :2] * 1000)
        for name, track in run.robots.items()
    ]
    found = playpens.parse(run.attachments["playpen.toml"], f"{log}: playpen.toml")
    drawing.save(drawing.draw(found, tracks), picture)


_OF_A_TWIN = {
    "playpen",
    "seed",
    "noise",
    "spread",
    "robot",
    "mode",
    "rom",
    "battery_used_min",
    "fault",
    "log",
    "carry_on",
    "picture",
}

_OF_A_SERVED_TWIN = {"clock", "speed", "unpaced", "strict_line"}


def _given(context: typer.Context) -> set[str]:
    """The options that the user has typed."""
    sources = {name: context.get_parameter_source(name) for name in context.params}
    return {name for name, source in sources.items() if source is not None and source.name == "COMMANDLINE"}


def _check_carry_on(carry_on: bool, log: Path | None) -> None:
    if carry_on and log is None:
        raise _usage("--carry-on is about a log that fails; right is to give --log FILE.mcap too")


def _check_log(recorder: "Recorder | LineRecorder | None", carry_on: bool) -> None:
    """Ends a run whose log has failed with an exit code that says so."""
    if recorder is None or recorder.failure is None:
        return
    if carry_on:
        raise typer.Exit(3)
    raise recorder.failure


def _check_picture(picture: Path, log: Path | None) -> None:
    """Refuses a picture that could not be drawn at the end of the run."""
    if log is None:
        raise _usage("--picture draws the path from the log; right is to give --log FILE.mcap too")
    if picture.suffix.lower() not in (".png", ".svg", ".pdf"):
        raise _usage(f"--picture {picture}: right is a name that ends in .png, .svg or .pdf")
    if picture.resolve() == log.resolve():
        raise _usage(f"--picture {picture}: this is the log; right is a file of its own")
    if not picture.parent.is_dir():
        raise _usage(f"--picture {picture}: there is no directory {picture.parent}")


def _mode(digit: str | None) -> int | None:
    """A running mode as its jumpers have it, one hexadecimal digit."""
    if digit is not None and (len(digit) != 1 or digit.upper() not in "0123456789ABCDEF"):
        raise _usage(f"--mode {digit}: right is one digit, 0 to F")
    return None if digit is None else int(digit, 16)


def _speed(text: str) -> float:
    if text == "max":
        return math.inf
    try:
        speed = float(text)
    except ValueError:
        speed = math.nan
    if not 0.001 <= speed <= 1000:
        raise _usage(f"--speed {text}: right is a number from 0.001 to 1000, or max")
    return speed


def _program() -> str:
    """How this command is called here: by its name where the shell finds it, else as it was typed."""
    typed = sys.argv[0]
    found = shutil.which("khep-twin")
    return typed if Path(typed).name == "khep-twin" and found != typed else "khep-twin"


def _relay(
    through: str,
    mode: int | None,
    where: Callable[[Mapping[int, int]], AbstractContextManager[Sequence["Cable"]]],
    ready_fd: int | None,
    log: Path | None,
    carry_on: bool,
) -> None:
    """Serves the robot at a port."""
    from khep_twin.log.line_recorder import LineRecorder
    from khep_twin.ports.relay import Device, relay, since_now
    from khep_twin.ports.serve import stopping
    from khep_twin.rom import ROMS

    number, modes = 1 if mode is None else mode, ROMS["khepera2"]
    if reason := modes.refused(number):
        raise _usage(f"--mode {number:X}: {reason}")
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
            told = _complain if carry_on else None
            recorder = LineRecorder(log, {"through": through, "baud": baud}, now, carry_on=told)
            stack.enter_context(closing(recorder))
        _tell_kept(recorder)
        stack.enter_context(_listed(cables, f"robot at {through}"))
        _announce(cables, ready_fd)
        relay(device, cables[0], recorder, stop=stop, tell=_complain)
        duration_ns, dropped = now(), cables[0].dropped
    _tell_served(duration_ns, dropped)
    _check_log(recorder, carry_on)


@contextmanager
def _listed(cables: Sequence["Cable"], what: str) -> Generator[None, None, None]:
    """Lets `khep-twin ports` find what is served."""
    from khep_twin.ports.register import registered

    with ExitStack() as stack:
        try:
            stack.enter_context(registered([cable.path for cable in cables], what))
        except PortError as error:
            _complain(f"not listed by khep-twin ports: {error}")
        yield


def _tell_served(duration_ns: int, dropped: int) -> None:
    """What there is to say at the end of serving."""
    typer.echo(f"{duration_ns / 1e9:.1f} s served", err=True)
    if dropped:
        typer.echo(f"{dropped} bytes dropped that no host took", err=True)


def _tell_kept(recorder: "Recorder | LineRecorder | None") -> None:
    """Says that an unfinished log of an earlier run was found and where it is now."""
    if recorder is not None and recorder.kept is not None:
        remedy = f"{_program()} recover {recorder.kept}"
        typer.echo(
            f"khep-twin: an unfinished log of an earlier run is kept as {recorder.kept}; rescue it: {remedy}",
            err=True,
        )


def _complain(text: str) -> None:
    """One line on standard error."""
    typer.echo(f"khep-twin: {text}", err=True)


def _announce(cables: Sequence["Cable"], descriptor: int | None) -> None:
    """Says what hosts open, on standard output and to whoever waits at a descriptor."""
    paths = "".join(f"{cable.path}\n" for cable in cables)
    typer.echo(paths, nl=False)
    if descriptor is None:
        return
    try:
        with open(descriptor, "w") as file:
            file.write(paths)
    except OSError as error:
        raise _usage(f"--ready-fd {descriptor}: cannot be written: {error.strerror}") from None


def _usage(text: str) -> typer.Exit:
    """One line about wrong usage, and the exit that goes with it."""
    typer.echo(f"khep-twin: {text}", err=True)
    return typer.Exit(2)
