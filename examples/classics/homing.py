"""Homing after Floreano and Mondada (1996): a network evolves to return to its charger in time.

    .venv/bin/python examples/classics/homing.py --picture homing.png

As in their work: an arena of 400 x 450 mm with a charger of 80 mm under a light tower in a corner; a charge
of 20 s, renewed immediately on the charger, where the fitness is 0; an episode ("life") of at most 150
actions; five recurrent hidden neurons from eight proximity sensors, two light receivers, a floor sensor and
the charge; a fitness of V (1 - i) for each action, as a part of 150 actions; a population of 100 and 240
generations. The robot has no floor sensor: that input is computed from its position, as the charge is from
the time.

V is the mean of both speeds, forwards. The published one uses their absolute values, which would also reward
a robot that spins on the spot. An action takes 400 ms, so a charge lasts for 50. Roulette selection,
crossover (0.1), mutations (0.2, up to 0.5) and full speed (80 mm/s) are assumed. Episodes run in the plane.
The twenty best of the last generation are evaluated again in MuJoCo, and the best of these there in new
episodes.
"""

import argparse
import time
from itertools import compress
from pathlib import Path
from typing import NamedTuple

import numpy as np
from curves import draw_curve

from khep_twin import Episode, EpisodeOptions, EpisodeSetup, Playpen, Sensor
from khep_twin.board import AMBIENT, PROXIMITY
from khep_twin.drawing import DrawnPath, draw, save
from khep_twin.files import unusable
from khep_twin.randomness import stream
from khep_twin.units import COUNTS_LIMIT

parser = argparse.ArgumentParser(description="Evolve homing to a charger.")
parser.add_argument("--generations", type=int, default=240)
parser.add_argument("--population", type=int, default=100)
parser.add_argument("--check-lives", type=int, default=50, help="episodes of the best in MuJoCo")
parser.add_argument("--seed", type=int, default=0)
parser.add_argument("--picture", type=Path, help="draw curve and path to NAME.png and NAME_way.png")
options = parser.parse_args()
if options.picture is not None and (reason := unusable(options.picture)):
    parser.error(f"{options.picture}: cannot be written: {reason}")

ACTIONS, CHARGE, ACTION_NS = 150, 50, 400_000_000
N_HIDDEN, N_INPUTS, TOP_SPEED_PULSES, CHARGER = 5, 8 + 2 + 1 + 1, 10, 0.08
N_FIRST = N_HIDDEN * (N_INPUTS + 1 + N_HIDDEN)
N_GENES = N_FIRST + 2 * (N_HIDDEN + 1)
RECEIVERS = [AMBIENT[Sensor.LEFT_45], AMBIENT[Sensor.RIGHT_45]]


class EpisodeResults(NamedTuple):
    """Results of n episodes: fitness (n,), actions (n,), poses (actions, n, 3), charge left at returns."""

    fitness: np.ndarray
    actions: np.ndarray
    poses: np.ndarray
    returns: list[float]


def run_episodes(setup: EpisodeSetup, genomes: np.ndarray, first_seed: int) -> EpisodeResults:
    """Run an episode of each genome from a random start, all in step."""
    count = len(genomes)
    first = genomes[:, :N_FIRST].reshape(count, N_HIDDEN, -1)
    second = genomes[:, N_FIRST:].reshape(count, 2, -1)
    while len(reused[setup]) < count:
        reused[setup].append(Episode(setup, compiled=True))
    episodes = reused[setup][:count]
    for index, episode in enumerate(episodes):
        # Off the walls and the charger.
        episode.begin(
            first_seed + index, EpisodeOptions(start=rng.uniform((100, 100, -180), (360, 410, 180)).tolist())
        )
    dark, floor = setup.calibration.ambient.dark_counts, setup.calibration.ambient.floor_counts
    one, hidden, was_home = np.ones((count, 1)), np.zeros((count, N_HIDDEN)), np.ones(count, bool)
    charge, fitness, actions = np.full(count, CHARGE), np.zeros(count), np.zeros(count, int)
    poses, returns = [], []
    for _ in range(ACTIONS):
        boards = np.array([episode.registers for episode in episodes])
        poses.append([episode.pose for episode in episodes])
        home = np.hypot(*np.array(poses[-1])[:, :2].T) < CHARGER
        alive = charge > 0
        if not alive.any():
            break
        returns += (charge / CHARGE)[home & ~was_home & alive].tolist()
        was_home = home
        charge = np.where(alive & home, CHARGE, charge)
        near = boards[:, PROXIMITY] / COUNTS_LIMIT
        light = (dark - boards[:, RECEIVERS]) / (dark - floor)
        inputs = np.column_stack((near, light, home, charge / CHARGE, one, hidden))
        hidden = sigmoid(np.einsum("nhi,ni->nh", first, inputs))
        out = sigmoid(np.einsum("noh,nh->no", second, np.column_stack((hidden, one))))
        speeds = TOP_SPEED_PULSES * (2 * out - 1)
        forwards = np.maximum(speeds.mean(axis=1), 0) / TOP_SPEED_PULSES
        fitness += np.where(alive & ~home, forwards * (1 - near.max(axis=1)), 0)
        for episode, (left, right) in compress(zip(episodes, speeds, strict=True), alive):
            episode.drive(left, right)
            episode.step(setup.steps_per_period)
        actions += alive
        charge -= alive
    return EpisodeResults(fitness / ACTIONS, actions, np.array(poses), returns)


def sigmoid(sums: np.ndarray) -> np.ndarray:
    """Return the neurons' values, 0 to 1."""
    return 1 / (1 + np.exp(-np.clip(sums, -50, 50)))


def offspring(genomes: np.ndarray, fitness: np.ndarray) -> np.ndarray:
    """Return the next generation: the best as it is, others by roulette, crossover and mutation."""
    chance = fitness - fitness.min() + 1e-9
    next_ones = genomes[rng.choice(len(genomes), len(genomes), p=chance / chance.sum())]
    for index in range(0, len(genomes) - 1, 2):
        if rng.random() < 0.1:
            cut = rng.integers(1, N_GENES)
            next_ones[[index, index + 1], cut:] = next_ones[[index + 1, index], cut:]
    mutated = rng.random(next_ones.shape) < 0.2
    next_ones += mutated * rng.uniform(-0.5, 0.5, next_ones.shape)
    next_ones[0] = genomes[fitness.argmax()]
    return next_ones


began = time.monotonic()
arena, rng = Playpen.load("homing"), stream(options.seed, "homing")
plane, mujoco = (EpisodeSetup(arena, planar=planar, period_ns=ACTION_NS) for planar in (True, False))
reused: dict[EpisodeSetup, list[Episode]] = {plane: [], mujoco: []}
genomes = rng.uniform(-0.5, 0.5, (options.population, N_GENES))
curve = []
for generation in range(options.generations):
    if generation:
        genomes = offspring(genomes, curve[-1])
    results = run_episodes(plane, genomes, generation * len(genomes))
    curve.append(results.fitness)
    print(
        f"generation {generation:3}  best {results.fitness.max():.3f}  mean {results.fitness.mean():.3f}  "
        f"{(results.actions == ACTIONS).sum():3} live for {ACTIONS} actions  "
        f"{time.monotonic() - began:5.0f} s",
        flush=True,
    )

elite = genomes[np.argsort(-curve[-1], kind="stable")[:20]]
judged = run_episodes(mujoco, elite.repeat(5, axis=0), 0).fitness.reshape(-1, 5)
best = elite[judged.mean(axis=1).argmax()]
checked = run_episodes(mujoco, np.tile(best, (options.check_lives, 1)), 1000)
print(
    f"in MuJoCo, {options.check_lives} new lives of the best: fitness {checked.fitness.mean():.3f}; "
    f"{(checked.actions == ACTIONS).mean():.0%} live for {ACTIONS} actions"
)
if checked.returns:
    low, median, high = np.percentile(checked.returns, (25, 50, 75))
    print(
        f"{len(checked.returns) / options.check_lives:.1f} returns a life, {median:.0%} of the charge left "
        f"(median; quartiles {low:.0%} and {high:.0%})"
    )

if options.picture:
    draw_curve(curve, "fitness: V (1 - i), off the charger", options.picture)
    path = checked.poses[:, 0]
    tracks = [DrawnPath("khepera0", np.arange(len(path)) * 0.4, 1000 * path[:, :2])]
    path_file = options.picture.with_name(f"{options.picture.stem}_way.png")
    save(draw(arena, tracks, title="A life of the evolved network", longer_side=4), path_file)
