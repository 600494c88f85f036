"""From a genome to a Khepera IV: `python -m studies khepera4-transfer best4.npz`, files of networks.

Each network drives in the playpen from random starts, and the columns have the mean `obstacle_avoidance` of
rollouts in the plane and in MuJoCo, over `khep://`, and of its program in C under `exec`. A second row has
those on other robots of the model (`vary`). Run n has the same seed and start in all columns. It needs a C
compiler.
"""

import subprocess
from collections.abc import Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from numpy.typing import NDArray

from khep_twin import EpisodeOptions, EpisodeSetup, Network, NetworkController, Playpen, rollout
from khep_twin.episodes.fitness import TOP_SPEED_PULSES, obstacle_avoidance
from khep_twin.lab.experiment import StartPose, starts
from khep_twin.lab.experiment.series import FreshTwins, run_series
from khep_twin.lab.experiment.series_run import Plan
from khep_twin.playpen.starts import at_start
from khep_twin.ports.twin import TwinOptions, open_twin
from khep_twin.programs.computer import Machine
from khep_twin.programs.robot_program import RobotProgram, run_programs
from khep_twin.robots.khepera4.model import KHEPERA_4
from khep_twin.robots.khepera4.registers import DspicRegister
from tools.command_table import command_line

SEED = 100


class MeasuredMachine(Machine):
    """Machine that computes the fitness of each cycle, from the readings and the speeds of its program."""

    def __init__(self, *parts: Any) -> None:
        super().__init__(*parts)
        self.fitness: list[float] = []
        self._nearest: float | None = None

    def transfer(self, bus: int, messages: Sequence[tuple[int, int, bytes]], byte_ns: int) -> bytes:
        """Run messages on the bus."""
        reply, content = super().transfer(bus, messages, byte_ns), messages[0][2]
        none, full = KHEPERA_4.episode_interface.counts
        if content[0] == DspicRegister.PROXIMITY:
            counts = np.frombuffer(reply[:16], "<u2")
            self._nearest = max(float(counts.max()) - none, 0) / (full - none)
        elif content[0] == DspicRegister.SPEED_ORDER_LEFT and self._nearest is not None:
            scale = TOP_SPEED_PULSES / KHEPERA_4.episode_interface.top_speed
            left, right = np.frombuffer(content[1:], "<i2") * scale
            self.fitness.append(float(obstacle_avoidance(left, right, self._nearest)))
            self._nearest = None
        return reply


class Transfer:
    """Runs of one network, from the same starts with the same seeds."""

    def __init__(self, network: Network, playpen: Playpen, rollouts: int, runs: int, seconds: float) -> None:
        self._network, self._playpen, self._seconds, self._runs = network, playpen, seconds, runs
        self._seeds = range(SEED, SEED + rollouts)
        self._starts: list[StartPose] = starts(["random"], playpen, robot=0, runs=rollouts, seed=SEED)

    def rollouts(self, vary: bool, planar: bool) -> NDArray[np.float64]:
        """Return the fitness of rollouts."""
        setup, options = EpisodeSetup(self._playpen, planar=planar), EpisodeOptions(vary=vary)
        results = rollout(
            setup, self._network, self._seeds, self._seconds, starts=self._starts, options=options
        )
        return results.metrics["obstacle_avoidance"]

    def line(self, vary: bool) -> float:
        """Return the mean fitness of runs over `khep://`."""
        twins = FreshTwins(self._playpen, TwinOptions(SEED, vary=vary), self._starts)
        plan = Plan(self._runs, None, self._seconds, 0.0)
        runs = run_series(NetworkController(self._network), twins, plan)
        return float(np.mean([run.metrics["fitness"] for run in runs]))

    def program(self, vary: bool) -> float:
        """Return the mean fitness of runs of the program."""
        with TemporaryDirectory() as folder:
            program = Path(folder, "network")
            self._network.save(program.with_suffix(".c"))
            subprocess.run(["cc", "-O2", "-o", program, program.with_suffix(".c"), "-lm"], check=True)
            runs = list(zip(self._seeds, self._starts, strict=True))[: self._runs]
            return float(np.mean([self._execute(program, seed, start, vary) for seed, start in runs]))

    def _execute(self, program: Path, seed: int, start: StartPose, vary: bool) -> float:
        with open_twin(at_start(self._playpen, 0, start), TwinOptions(seed, vary=vary)) as twin:
            machine = MeasuredMachine(twin.world.robots[0], twin.world)
            run_programs([RobotProgram([str(program)], machine)], until_ns=round(self._seconds * 1e9))
            return float(np.mean(machine.fitness))


def main() -> None:
    parser = command_line(__doc__)
    parser.add_argument("networks", nargs="+", help="files of networks")
    parser.add_argument("--playpen", default="arena4")
    parser.add_argument("--rollouts", type=int, default=200)
    parser.add_argument("--runs", type=int, default=20)
    parser.add_argument("--seconds", type=float, default=30.0)
    options = parser.parse_args()
    many, few = options.rollouts, options.runs
    print(f"| network | plane, {many} | MuJoCo, {many} | MuJoCo, {few} | `khep://`, {few} | `exec`, {few} |")
    print("|---|---|---|---|---|---|", flush=True)
    for file in options.networks:
        network, playpen = Network.load(file), Playpen.load(options.playpen)
        transfer = Transfer(network, playpen, many, few, options.seconds)
        for vary in (False, True):
            plane, mujoco = (transfer.rollouts(vary, planar) for planar in (True, False))
            means = [plane.mean(), mujoco.mean(), mujoco[:few].mean()]
            means += [transfer.line(vary), transfer.program(vary)]
            cells = " | ".join(f"{mean:.3f}" for mean in means)
            print(f"| {file}{', other robots' if vary else ''} | {cells} |", flush=True)
