"""Speed of the Khepera IV: its world, a program that reads all sensors at 20 Hz under exec, and rollouts."""

import subprocess
from collections.abc import Callable
from functools import partial
from pathlib import Path

import mujoco
import numpy as np

from benchmarks.scale import world_row
from benchmarks.table import Row, Table, measure, timed
from khep_twin.episodes.batch import rollout
from khep_twin.episodes.controllers import Network
from khep_twin.playpen import Playpen
from khep_twin.programs.computer import Machine
from khep_twin.programs.robot_program import RobotProgram, run_programs
from khep_twin.robots.khepera4.registers import DspicRegister
from khep_twin.robots.khepera4.robot import Khepera4Robot
from khep_twin.world import World

PLAYPEN = "arena4"
SOURCE = Path(__file__).with_suffix(".c")

_READ_NS = 50_000_000
_N_SENSORS = 23
"""Numbers that a Khepera IV's sensors have: 12 infrared, 5 ultrasonic, 6 inertial; a Khepera has 8."""


def open_world(compiled: bool = True) -> tuple[World, Khepera4Robot]:
    """Return a world with a Khepera IV."""
    world = World(PLAYPEN, seed=1, compiled=compiled)
    robot = world.robots[0]
    assert isinstance(robot, Khepera4Robot)
    return world, robot


def bare(seconds: float) -> None:
    """Run a loop of mj_step alone."""
    world, _ = open_world()
    for _ in range(round(seconds * 400)):
        mujoco.mj_step(world.model, world.data)


def read_sensors(seconds: float, reads: bool = True, compiled: bool = True) -> None:
    """Advance a world, and read all sensors at 20 Hz."""
    world, robot = open_world(compiled)
    for _ in range(round(seconds * 20)):
        world.advance_to(world.time_ns + _READ_NS)
        if reads:
            for register, count in (
                (DspicRegister.AMBIENT, 29),
                (DspicRegister.ACCELEROMETER, 30),
                (DspicRegister.GYROSCOPE, 30),
            ):
                robot.dspic.read(register, 2 * count)


def run_program(program: Path, seconds: float) -> None:
    """Run the program that reads them."""
    world, robot = open_world()
    (code,) = run_programs([RobotProgram([str(program), str(round(seconds))], Machine(robot, world))])
    assert code == 0


def roll_out(playpen: str, model: str, planar: bool, n_episodes: int, seconds: float) -> None:
    """Run episodes of a network that reads proximity every 20 ms, in one thread."""
    network = Network(hidden=(4,), model=model)
    genes = np.random.default_rng(1).normal(size=(n_episodes, network.n_genes))
    seeds = range(n_episodes)
    rollout(playpen, network, seeds, seconds, genes=genes, planar=planar, compiled=True, threads=1)


def rollout_rows(seconds: float) -> list[Row]:
    """Return rows of rollouts of both robots, in MuJoCo and in the plane."""
    rows: list[Row] = []
    for title, playpen, model in (("Khepera IV", PLAYPEN, "khepera4"), ("Khepera", "obstacles", "khepera")):
        for place, planar, count in (("MuJoCo", False, 1), ("plane", True, 8)):
            run = partial(roll_out, playpen, model, planar, count, seconds)
            rows.append(Row(f"rollout of a {title}, {place}", count * seconds, timed(run)))
    return rows


def table(folder: Path, part: float, rounds: int) -> Table:
    """Measure a loop of mj_step, worlds of both robots, and the program.

    Args:
        folder: Folder for the compiled program.
        part: Fraction of the usual length.
        rounds: Number of counted rounds.
    """
    seconds, program = max(round(20 * part), 1), folder / "khepera4"
    subprocess.run(["cc", "-O2", "-o", program, SOURCE], check=True)

    def row(name: str, run: Callable[[], None]) -> Row:
        return Row(name, seconds, timed(run), lambda rate: f"{1000 / rate:.1f} ms a simulated s")

    rows = [
        row("bare mj_step (floor)", lambda: bare(seconds)),
        row("World, no program", lambda: read_sensors(seconds, reads=False)),
        row("World, all sensors at 20 Hz", lambda: read_sensors(seconds)),
        row("the same sensors, plain", lambda: read_sensors(seconds, compiled=False)),
        row("exec, all sensors at 20 Hz", lambda: run_program(program, seconds)),
        world_row("World of a Khepera, obstacles", Playpen.load("obstacles"), seconds),
        world_row("the same, plain", Playpen.load("obstacles"), seconds, compiled=False),
        *rollout_rows(float(seconds)),
    ]
    remark = f"a Khepera IV's sensors have {_N_SENSORS} numbers, a Khepera's 8"
    return measure(f"{PLAYPEN}, Khepera IV", rows, rounds, remarks=[remark])
