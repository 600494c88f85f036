"""`khep-twin exec`: programs that were compiled for a Khepera IV, on twins of it."""

import shlex
from contextlib import ExitStack
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from khep_twin.cli.completion import playpens
from khep_twin.cli.option_groups import LiveViewOptions, LogOptions, grouped
from khep_twin.cli.options import Switch, Viewer, check_new, complain, tell_kept, tell_written, usage
from khep_twin.clock import to_ns
from khep_twin.errors import PlaypenError

if TYPE_CHECKING:
    from khep_twin.khepera4.programs import RobotProgram
    from khep_twin.ports.twin import Twin

CFLAGS = "-fcommon -funsigned-char -fno-pie -no-pie"
"""Options of `cc` for K-Team's library and its programs: it keeps pointers in 32 bits, and defines variables
in its headers; the robot's `char` has no sign."""


class ProgramClock(StrEnum):
    """Clock of the programs."""

    SIMULATED = "simulated"
    REAL = "real"


def _show_cflags(wanted: bool) -> None:
    if wanted:
        typer.echo(CFLAGS)
        raise typer.Exit


@grouped
def execute(
    program: Annotated[
        list[str], typer.Argument(metavar="-- PROGRAM [ARGUMENT]", help="Program and its arguments.")
    ],
    *,
    playpen: Annotated[
        str,
        typer.Option(help="Playpen with a Khepera IV: a shipped name, or a path.", autocompletion=playpens),
    ] = "arena4",
    robot: Annotated[int, typer.Option(help="Number of the program's robot, counted from 0.")] = 0,
    also: Annotated[
        list[str] | None,
        typer.Option(
            metavar="PROGRAM",
            help="Run this program, in quotes with its arguments, on the next Khepera IV; may be repeated.",
        ),
    ] = None,
    clock: Annotated[
        ProgramClock,
        typer.Option(help="simulated: time passes while the programs wait; real: the wall clock."),
    ] = ProgramClock.SIMULATED,
    seconds: Annotated[
        float | None,
        typer.Option(min=0.01, help="End after this time [s]: SIGTERM, and 2 s later SIGKILL."),
    ] = None,
    after: Annotated[
        float, typer.Option(min=0, help="Let the robots go on for this time after the programs [s].")
    ] = 0.0,
    seed: Annotated[int, typer.Option(help="Seed of every random stream of the run.")] = 0,
    noise: Annotated[Switch, typer.Option(help="Add noise to the sensors, as on the robot.")] = Switch.ON,
    vary: Annotated[
        Switch, typer.Option(help="Draw another robot of the same make, by the seed.")
    ] = Switch.OFF,
    logging: LogOptions,
    live_view: LiveViewOptions,
    viewer: Viewer = False,
    cflags: Annotated[
        bool,
        typer.Option(
            "--cflags",
            help="Print the options of cc for K-Team's library and programs, and exit.",
            callback=_show_cflags,
            is_eager=True,
        ),
    ] = False,
) -> None:
    """Run a program of the Khepera IV on a twin of it.

    Linux only. The program is a native build of the unchanged source; a preload library, compiled once by
    your C compiler, answers its device nodes and, with the simulated clock, what asks for the time or waits.
    Input, output, signals and exit code are the program's; with several, the exit code is the first that is
    not 0.
    """
    from khep_twin.khepera4.programs import run_programs
    from khep_twin.log.recorded import PROGRAM
    from khep_twin.ports.twin import TwinOptions, open_twin

    check_new(logging.force, logging.log)
    lines = [program, *_split(also or [])]
    options = TwinOptions(seed, None, noise is Switch.ON, vary is Switch.ON)
    with open_twin(playpen, options) as twin, ExitStack() as stack:
        chosen = _on_robots(twin, robot, lines)
        if logging.log is not None:
            told = "; ".join(shlex.join([Path(name).name, *rest]) for name, *rest in lines)
            twin.record(logging.log, facts={PROGRAM: told}, on_failure=logging.on_failure)
        tell_kept(twin.recorder)
        watch = live_view.watching(stack, playpen, viewer=viewer, real_time=clock is ProgramClock.REAL)
        watch(twin)
        until_ns = None if seconds is None else to_ns(seconds)
        codes = run_programs(chosen, simulated=clock is ProgramClock.SIMULATED, until_ns=until_ns)
        if after:
            twin.world.advance(after)
        is_cut_off = until_ns is not None and twin.world.time_ns >= until_ns
    if logging.log is not None:
        logging.check(twin.recorder)
        tell_written("log", [logging.log], err=True)
    code = next((code for code in codes if code and not (is_cut_off and code in (-15, -9))), 0)
    if code < 0:
        complain(f"the program was ended by signal {-code}")
    raise typer.Exit(code if code >= 0 else 128 - code)


def _split(also: list[str]) -> list[list[str]]:
    """Return command lines as words."""
    found: list[list[str]] = []
    for line in also:
        try:
            words = shlex.split(line)
        except ValueError as error:
            raise usage(f"--also {line}: {error}; expected a program and its arguments") from None
        if not words:
            raise usage(f"--also {line!r}: no program; expected one and its arguments")
        found.append(words)
    return found


def _on_robots(twin: "Twin", first: int, lines: list[list[str]]) -> list["RobotProgram"]:
    """Return the programs on the Khepera IVs of a twin, from a robot on."""
    from khep_twin.khepera4.machine import Machine
    from khep_twin.khepera4.programs import RobotProgram
    from khep_twin.khepera4.robot import Khepera4Robot

    name, robots = twin.world.playpen.name, twin.world.robots
    there = [each for each in robots if isinstance(each, Khepera4Robot)]
    numbers = [each.index for each in there]
    if not there:
        raise PlaypenError(f'{name}: no Khepera IV; expected a robot with model = "khepera4", as in arena4')
    if first not in numbers:
        raise usage(f"--robot {first}: not a Khepera IV of {name}; expected one of {numbers}")
    free = there[numbers.index(first) :]
    if len(lines) > len(free):
        raise usage(
            f"{len(lines)} programs; expected up to {len(free)}, the Khepera IVs of {name} from there on"
        )
    return [
        RobotProgram(line, Machine(each.dspic, twin.world), each.index + 1)
        for line, each in zip(lines, free, strict=False)
    ]
