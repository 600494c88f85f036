"""Evolution of obstacle avoidance as in Floreano and Mondada (1994), in their maze; minutes on two cores.

    .venv/bin/pip install cmaes
    .venv/bin/python examples/04_evolve.py --picture evolution.png --network best.npz
    khep-twin run best.npz --port /dev/ttyUSB0         drives a robot with the best network

As in their work, the network connects eight sensors directly to two motors, with feedback of the motors' last
values, and its fitness is the mean of V (1 - sqrt(dV)) (1 - i). There are two differences. V has no sign, so
driving to and fro on the spot would earn nearly all of it, and does evolve here. The mean is therefore
multiplied by the distance driven forwards, as a part of that at full speed, at least 0. The search is CMA-ES
of the package cmaes, not a genetic algorithm, and starts with weights of 0. The fitness of a genome is the
mean of eight episodes, from each of the maze's spots in both directions. Each generation has different noise.
"""

import argparse
import sys
import time
from pathlib import Path

import numpy as np

from khep_twin import Episode, EpisodeOptions, EpisodeSetup, Network, Playpen, rollout
from khep_twin.drawing import DrawnPath, draw, save
from khep_twin.errors import pip_install
from khep_twin.files import unusable
from khep_twin.lab.experiment import run_statistics
from khep_twin.process.invocation import command
from khep_twin.units import BODY_RADIUS

try:
    from cmaes import CMA
except ImportError:
    sys.exit(f"cmaes is not installed; to install it: {pip_install('cmaes')}")

parser = argparse.ArgumentParser(description="Evolve obstacle avoidance in the looping maze.")
parser.add_argument("--generations", type=int, default=40)
parser.add_argument("--population", type=int, default=20)
parser.add_argument("--seconds", type=float, default=10.0, help="duration of an episode")
parser.add_argument("--check-seconds", type=float, default=60.0, help="duration of an evaluation episode")
parser.add_argument("--seed", type=int, default=0)
parser.add_argument("--picture", type=Path, help="draw curve and path to NAME.png and NAME_way.png")
parser.add_argument("--network", type=Path, help="write the best network to this NPZ file")
options = parser.parse_args()
for path in (options.picture, options.network):
    if path is not None and (reason := unusable(path)):
        parser.error(f"{path}: cannot be written: {reason}")

NETWORK = Network(recurrent=True)
FULL_SPEED = NETWORK.top_speed * 0.008
"""Full speed [m/s]: a pulse in 10 ms is 8 mm/s."""

maze = Playpen.load("looping-maze")
starts = [(spot.x_mm, spot.y_mm, spot.heading_deg + turn) for turn in (0.0, 180.0) for spot in maze.spots]
setup = EpisodeSetup(maze, step_ns=5_000_000)


def judge(genomes: np.ndarray, first_seed: int) -> np.ndarray:
    """Return the fitness of each genome, the mean over its episodes."""
    results = rollout(
        setup,
        NETWORK,
        np.tile(np.arange(first_seed, first_seed + len(starts)), len(genomes)),
        options.seconds,
        genes=np.repeat(genomes, len(starts), axis=0),
        starts=starts * len(genomes),
    )
    forwards = np.maximum(results.metrics["forward_m"], 0) / (options.seconds * FULL_SPEED)
    fitness = np.nan_to_num(results.metrics["obstacle_avoidance"] * forwards)
    return fitness.reshape(len(genomes), len(starts)).mean(axis=1)


search = CMA(mean=np.zeros(NETWORK.n_genes), sigma=1.0, population_size=options.population, seed=options.seed)
curve = []
began = time.monotonic()
for generation in range(options.generations):
    genomes = np.array([search.ask() for _ in range(options.population)])
    fitness = judge(genomes, 1000 + generation * len(starts))
    search.tell([(genome, -value) for genome, value in zip(genomes, fitness, strict=True)])
    curve.append((fitness.max(), fitness.mean(), fitness.min()))
    print(
        f"generation {generation:3}  best {fitness.max():.3f}  mean {fitness.mean():.3f}  "
        f"{time.monotonic() - began:5.0f} s",
        flush=True,
    )

# The search's mean combines all generations; it is evaluated in new episodes, at the default time step.
best = search.mean
if options.network:
    NETWORK.save(options.network, best, setup=setup, seed=options.seed)
    drives = command("run", options.network, "--port", "/dev/ttyUSB0")
    print(f"network  {options.network}      drive a robot with it: {drives}")
tracks = []
print("start            fitness  forwards    turning     laps  collisions  touching")
for seed, start in enumerate(starts):
    episode = Episode(EpisodeSetup(maze), NETWORK)
    episode.begin(seed, EpisodeOptions(start=start, genes=best))
    poses = [episode.pose]
    for _ in range(round(options.check_seconds * 50)):
        episode.run(0.02)
        poses.append(episode.pose)
    times, trajectory, metrics = np.arange(len(poses)) * 0.02, np.array(poses), episode.metrics()
    turned = np.abs(np.diff(np.unwrap(trajectory[:, 2]))).sum()
    # Laps around the middle of the maze, which is wall.
    lap_angles = np.unwrap(np.arctan2(trajectory[:, 1] - 0.25, trajectory[:, 0] - 0.4))
    hits = run_statistics.collisions(times, trajectory, maze, BODY_RADIUS)
    print(
        f"{start[0]:3g},{start[1]:3g},{start[2]:4g}"
        f"{metrics['obstacle_avoidance']:12.3f}"
        f"{1000 * metrics['forward_m'] / times[-1]:6.0f} mm/s"
        f"{np.degrees(turned) / times[-1]:5.0f} deg/s"
        f"{(lap_angles[-1] - lap_angles[0]) / (2 * np.pi):7.1f}"
        f"{len(hits.times_s):12}{hits.total_s:8.2f} s"
    )
    tracks.append(DrawnPath("khepera0", times, 1000 * trajectory[:, :2]))

if options.picture:
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(6.4, 3.4), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    looks = (("best", "#2f7d5b"), ("mean", "#2b2f36"), ("worst", "#a9adb5"))
    for (name, colour), values in zip(looks, np.array(curve).T, strict=True):
        axes.plot(values, label=name, color=colour, lw=1.4)
    axes.set(xlabel="generation", ylabel="fitness: V (1 - √ΔV) (1 - i), times distance forwards")
    axes.set_ylim(bottom=0)
    axes.legend(loc="upper left", frameon=False)
    save(figure, options.picture)
    path_file = options.picture.with_name(f"{options.picture.stem}_way.png")
    save(draw(maze, tracks[:1], title=f"{options.check_seconds:g} s of the evolved network"), path_file)
