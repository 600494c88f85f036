"""Speed of episodes without a serial line: `python -m benchmarks.scale`, in three playpens at two steps.

All rows drive the ROM's Braitenberg vehicle along the same path for the same time. The floor is a loop around
mj_step alone, called from Python, in the same scene with its rangefinders, driven by the motor voltages that
the vehicle had. A second floor has no sensors at all.
"""

import copy
import sys

import mujoco
import numpy as np

from benchmarks.table import LEGEND, Row, measure, text, timed
from khep_twin import units
from khep_twin.board import kernel
from khep_twin.episodes.batch import rollout
from khep_twin.episodes.controllers import Braitenberg, Driver, Floats, Network, Policy
from khep_twin.episodes.episode import Episode
from khep_twin.episodes.episode_setup import EpisodeSetup
from khep_twin.playpen import Playpen
from khep_twin.world import World

PLAYPENS = ("default", "obstacles", "looping-maze")
ROUNDS = 5
GENERATION_S = 1024 * 60
"""Simulated seconds of a generation: 1024 episodes of a minute."""


def voltages(setup: EpisodeSetup, seconds: float) -> list[tuple[float, float]]:
    """Return the vehicle's motor voltages, tick by tick."""
    episode = Episode(setup, Braitenberg())
    episode.begin(1)
    voltage_pairs: list[tuple[float, float]] = []
    for _ in range(round(seconds * 1e9) // units.TICK_NS):
        left, right = episode.data.ctrl.tolist()
        voltage_pairs.append((left, right))
        episode.step(setup.scene_model.timing.steps_per_tick)
    return voltage_pairs


def bare_row(name: str, setup: EpisodeSetup, seconds: float, *, sensors: bool = True) -> Row:
    """Return a row of a loop of mj_step alone."""
    driven = voltages(setup, seconds)
    model = setup.model
    if sensors:
        model = copy.copy(model)
        model.opt.disableflags &= ~int(mujoco.mjtDisableBit.mjDSBL_SENSOR)
    steps = setup.scene_model.timing.steps_per_tick

    def bare() -> None:
        data = mujoco.MjData(model)
        for voltage_pair in driven:
            data.ctrl[:] = voltage_pair
            for _ in range(steps):
                mujoco.mj_step(model, data)

    return Row(name, seconds, timed(bare))


def episode_row(name: str, setup: EpisodeSetup, seconds: float, *, compiled: bool = True) -> Row:
    """Return a row of one episode, with its creation."""

    def run() -> None:
        episode = Episode(setup, Braitenberg(), compiled=compiled)
        episode.begin(1)
        episode.run(seconds)

    return Row(name, seconds, timed(run))


def world_row(name: str, scene: Playpen, seconds: float, *, compiled: bool = True) -> Row:
    """Return a row of a world whose robots have no line, with its opening."""

    def run() -> None:
        world = World(scene, seed=1, compiled=compiled)
        board_registers = [robot.registers.data for robot in world.robots]
        for scan in range(round(seconds * 1e9) // units.SCAN_NS):
            for registers in board_registers:
                kernel.wander(registers)
            world.advance_to((scan + 1) * units.SCAN_NS)

    return Row(name, seconds, timed(run))


def batch_row(
    name: str,
    setup: EpisodeSetup,
    n_episodes: int,
    episode_s: float,
    threads: int,
    driver: Driver | None = None,
    line: int | None = None,
) -> Row:
    """Return a row of a batch of episodes, each with different genes if the controller is a network."""
    genes = random_genes(n_episodes) if isinstance(driver, Network) else None
    return Row(
        name,
        n_episodes * episode_s,
        timed(
            lambda: rollout(
                setup,
                driver or Braitenberg(),
                range(n_episodes),
                episode_s,
                genes=genes,
                line=line,
                threads=threads,
            )
        ),
        generation,
    )


NETWORK = Network(hidden=(5,), recurrent=True)


def random_genes(count: int) -> Floats:
    """Return the genes of random networks (count, n_genes)."""
    return np.random.default_rng(7).normal(scale=1.5, size=(count, NETWORK.n_genes))


def generation(rate: float) -> str:
    """Return the duration of a generation at a speed in simulated seconds per second."""
    return f"1024 x 60 s: {GENERATION_S / rate:.0f} s"


POLICY = Policy(lambda proximity, ambient, which: 10 - proximity[:, [3, 2]] / 100)
"""Minimal policy in plain Python."""


def main() -> None:
    for name in PLAYPENS:
        for step_ns in (units.STEP_NS, 2 * units.STEP_NS):
            setup = EpisodeSetup(Playpen.load(name), step_ns=step_ns)
            rows = [
                bare_row("bare mj_step, rangefinders (floor)", setup, 20.0),
                bare_row("bare mj_step, no sensors", setup, 20.0, sensors=False),
                episode_row("life, compiled", setup, 20.0),
                episode_row("life, plain", setup, 20.0, compiled=False),
                batch_row("batch, 1 thread", setup, 32, 4.0, 1),
                batch_row("batch, 2 threads", setup, 32, 4.0, 2),
                batch_row("Python policy, 1 thread", setup, 32, 4.0, 1, POLICY),
                batch_row("Python policy, 2 threads", setup, 32, 4.0, 2, POLICY),
            ]
            if step_ns == units.STEP_NS:
                for kind in (True, False):
                    word = "compiled" if kind else "plain"
                    rows.append(
                        world_row(f"World, told by no line, {word}", Playpen.load(name), 20.0, compiled=kind)
                    )
            table = measure(f"{name}, steps of {step_ns / 1e6:g} ms", rows, ROUNDS)
            print(text([table]), end="\n\n", flush=True)
    print(LEGEND)


if __name__ == "__main__":
    sys.exit(main())
