"""`khep-twin exec`: programs compiled for the computers of robots, run on their twins."""

import shlex
from contextlib import ExitStack
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from khep_twin.cli.completion import playpens
from khep_twin.cli.option_groups import LiveViewOptions, LogOptions, with_help
from khep_twin.cli.options import (
    Faults,
    Switch,
    Viewer,
    check_new,
    notify,
    print_files,
    print_kept_log,
    usage,
)
from khep_twin.clock import to_ns
from khep_twin.robots.registry import installed_models

if TYPE_CHECKING:
    from khep_twin.ports.twin import Twin
    from khep_twin.programs.robot_program import RobotProgram


_SWITCH_STEP = 8_000
"""Step after which compiled code saves more time than its loading takes, measured with a Khepera IV."""


class ProgramClock(StrEnum):
    """Clock of the programs."""

    SIMULATED = "simulated"
    REAL = "real"


def _show_cflags(value: bool) -> None:
    if value:
        from khep_twin.programs.preload import compiler_flags

        typer.echo(" ".join(compiler_flags()))
        raise typer.Exit


@with_help
def execute(
    program: Annotated[list[str], typer.Argument(metavar="-- PROGRAM [ARGUMENT]")],
    *,
    playpen: Annotated[str, typer.Option(autocompletion=playpens)] = "arena4",
    robot: int = 0,
    other_programs: Annotated[list[str] | None, typer.Option("--also", metavar="PROGRAM")] = None,
    clock: ProgramClock = ProgramClock.SIMULATED,
    seconds: Annotated[float | None, typer.Option(min=0.01)] = None,
    extra_s: Annotated[float, typer.Option("--after", min=0)] = 0.0,
    seed: int = 0,
    noise: Switch = Switch.ON,
    vary: Switch = Switch.OFF,
    fault: Faults = None,
    logging: LogOptions,
    live_view: LiveViewOptions,
    viewer: Viewer = False,
    cflags: Annotated[bool, typer.Option("--cflags", callback=_show_cflags, is_eager=True)] = False,
) -> None:
    """Run a program of a robot's computer on a twin of the robot.

    Linux only. The program is a native build of the unchanged source. A preload library, compiled once by
    your C compiler, emulates its device nodes and, with the simulated clock, its time and wait functions.
    Input, output, signals and exit code are the program's; with several programs, the exit code is the first
    that is not 0.

    Args:
        program: Program and its arguments.
        playpen: Playpen with a robot that has a computer: a shipped name, or a path.
        robot: Number of the program's robot, counted from 0.
        other_programs: Run this program, in quotes with its arguments, on the next robot; repeatable.
        clock: simulated: time passes while the programs wait; real: the wall clock.
        seconds: End after this time [s]: SIGTERM, and 2 s later SIGKILL.
        extra_s: Continue for this time after the programs' end [s].
        seed: Seed of every random stream of the run.
        noise: Add noise to the sensors, as on the robot.
        vary: Draw another robot of the same model, by the seed.
        cflags: Print the options of cc for K-Team's libraries and programs, and exit.
    """
    from khep_twin.log.recorded import PROGRAM
    from khep_twin.ports.twin import TwinOptions, open_twin
    from khep_twin.programs.robot_program import run_programs

    check_new(logging.force, logging.log)
    commands = [program, *_split_commands(other_programs or [])]
    options = TwinOptions(seed, None, noise is Switch.ON, vary is Switch.ON, faults=tuple(fault or ()))
    with open_twin(playpen, options) as twin, ExitStack() as stack:
        robot_programs = _assign_robots(twin, robot, commands)
        if logging.log is not None:
            command_lines = "; ".join(shlex.join([Path(name).name, *rest]) for name, *rest in commands)
            twin.record(logging.log, facts={PROGRAM: command_lines}, on_failure=logging.on_failure)
        print_kept_log(twin.recorder)
        if clock is ProgramClock.SIMULATED and twin.world.code.switch_step is not None:
            twin.world.code.switch_step = _SWITCH_STEP
        watch = live_view.open_viewers(stack, playpen, viewer=viewer, real_time=clock is ProgramClock.REAL)
        watch(twin)
        end_ns = None if seconds is None else to_ns(seconds)
        codes = run_programs(
            robot_programs,
            simulated=clock is ProgramClock.SIMULATED,
            until_ns=end_ns,
            on_wall_clock=lambda: notify(
                "all threads wait for another program or a key; meanwhile the wall clock counts"
            ),
        )
        if extra_s:
            twin.world.advance(extra_s)
        is_cut_off = end_ns is not None and twin.world.time_ns >= end_ns
    if logging.log is not None:
        logging.check(twin.recorder)
        print_files("log", [logging.log], err=True)
    code = next((code for code in codes if code and not (is_cut_off and code in (-15, -9))), 0)
    if code < 0:
        notify(f"the program was ended by signal {-code}")
    raise typer.Exit(code if code >= 0 else 128 - code)


def _split_commands(command_lines: list[str]) -> list[list[str]]:
    """Return command lines as lists of arguments."""
    commands: list[list[str]] = []
    for command_line in command_lines:
        try:
            words = shlex.split(command_line)
        except ValueError as error:
            raise usage(f"--also {command_line}: {error}; expected a program and its arguments") from None
        if not words:
            raise usage(f"--also {command_line!r}: no program; expected one and its arguments")
        commands.append(words)
    return commands


def _assign_robots(twin: "Twin", first: int, commands: list[list[str]]) -> list["RobotProgram"]:
    """Assign programs to the robots of a twin that have a computer, starting with robot `first`."""
    from khep_twin.programs.computer import Machine
    from khep_twin.programs.robot_program import RobotProgram

    robots = twin.world.robots
    indices = [robot.index for robot in robots if "computer" in robot.robot_model.parts]
    listing = ", ".join(f"{index} ({robots[index].robot_model.title})" for index in indices)
    if not indices:
        models = [repr(name) for name, model in installed_models().items() if "computer" in model.parts]
        listing = f"a playpen with model = {' or '.join(models)}"
    if first not in indices:
        title = robots[first].robot_model.title if first in range(len(robots)) else "no robot"
        place = f"--robot {first}: {title} in {twin.world.playpen.name}"
        raise usage(f"{place}; expected one with a computer: {listing}")
    targets = [robots[index] for index in indices if index >= first]
    if len(commands) > len(targets):
        raise usage(f"{len(commands)} programs; expected up to {len(targets)} from robot {first}: {listing}")
    return [
        RobotProgram(command, Machine(robot, twin.world), robot.index + 1)
        for command, robot in zip(commands, targets, strict=False)
    ]
