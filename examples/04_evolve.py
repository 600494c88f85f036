"""Evolves obstacle avoidance after Floreano and Mondada (1994), in their looping maze.

    pip install cmaes
    python examples/04_evolve.py --generations 40 --picture evolution.png --genome best.npy

Eight sensors drive two motors, and the fitness is their V (1 - sqrt(dV)) (1 - i), multiplied by the way as a
part of that at full speed. V counts the speeds that are asked for, whatever their sign: their recurrent
network comes to ask for full speed ahead and back in turn here, which is worth nearly all of V on the spot,
or it shuttles. So this one has no memory, and the search begins with networks that drive ahead. It is CMA-ES
of the package cmaes and not a genetic algorithm. A generation lives through the same noise and starts, the
next one through others.
"""

import argparse
from pathlib import Path

import numpy as np
from cmaes import CMA

from khep_twin import playpen
from khep_twin.drawing import Track, draw, save
from khep_twin.lab import run_statistics
from khep_twin.scale.batch import rollout
from khep_twin.scale.life import Ground, Life
from khep_twin.scale.minds import Network
from khep_twin.units import BODY_RADIUS

NETWORK = Network()

FULL_SPEED = NETWORK.top_speed * 0.008
"""A pulse in 10 ms is 8 mm/s [m/s]."""

wish = argparse.ArgumentParser(description="Evolves obstacle avoidance in the looping maze.")
wish.add_argument("--generations", type=int, default=40)
wish.add_argument("--population", type=int, default=20)
wish.add_argument("--lives", type=int, default=2, help="each genome is judged by the mean of so many")
wish.add_argument("--seconds", type=float, default=16.0, help="of each life")
wish.add_argument("--check-seconds", type=float, default=60.0, help="of each life of the best")
wish.add_argument("--seed", type=int, default=0)
wish.add_argument("--picture", type=Path, help="draw curve and way in PNG files: NAME.png and NAME_way.png")
wish.add_argument("--genome", type=Path, help="keep the best in this NPY file")
options = wish.parse_args()

maze = playpen.load("looping-maze")
ground = Ground(maze, step_ns=5_000_000)


def judge(genomes: np.ndarray, first_seed: int, lives: int) -> np.ndarray:
    """Fitness of each genome, the mean over its lives."""
    seeds = np.tile(np.arange(first_seed, first_seed + lives), len(genomes))
    found = rollout(ground, NETWORK, seeds, options.seconds, genes=np.repeat(genomes, lives, axis=0))
    way = found.numbers["distance_m"] / (options.seconds * FULL_SPEED)
    return np.nan_to_num(found.numbers["obstacle_avoidance"] * way).reshape(-1, lives).mean(axis=1)


ahead = np.zeros(NETWORK.n_genes)
ahead[[0, 9]] = 0.5  # the biases of left and right
search = CMA(
    mean=ahead,
    sigma=1.0,
    population_size=options.population,
    seed=options.seed,
)
curve = []
for generation in range(options.generations):
    genomes = np.array([search.ask() for _ in range(options.population)])
    fitness = judge(genomes, 1000 + generation * options.lives, options.lives)
    search.tell([(genome, -value) for genome, value in zip(genomes, fitness, strict=True)])
    curve.append((fitness.max(), fitness.mean(), fitness.min()))
    print(f"generation {generation:3}  best {fitness.max():.3f}  mean {fitness.mean():.3f}", flush=True)

# The search's mean has been judged by all generations; lives it has never met say what it is worth. They go
# at the robot's own step.
best = search.mean
if options.genome:
    np.save(options.genome, best)
tracks = []
print("start  fitness  forward speed  turning  collisions  touching")
for seed, spot in enumerate(maze.spots):
    life = Life(Ground(maze), NETWORK)
    life.begin(seed, start=(spot.x_mm, spot.y_mm, spot.heading_deg), genes=best)
    poses = [life.pose]
    for _ in range(round(options.check_seconds * 50)):
        life.live(0.02)
        poses.append(life.pose)
    times, way = np.arange(len(poses)) * 0.02, np.array(poses)
    moved = np.diff(way[:, :2], axis=0)
    facing = np.stack((np.cos(way[:-1, 2]), np.sin(way[:-1, 2])), axis=1)
    turned = np.abs(np.diff(np.unwrap(way[:, 2])))
    hits = run_statistics.collisions(times, way, maze, BODY_RADIUS)
    print(
        f"{spot.name:5}  {life.numbers()['obstacle_avoidance']:7.3f}  "
        f"{1000 * (moved * facing).sum() / times[-1]:8.1f} mm/s  "
        f"{np.degrees(turned.sum()) / times[-1]:3.0f} deg/s  "
        f"{len(hits.times_s):10}  {hits.total_s:6.2f} s"
    )
    tracks.append(Track("khepera0", times, 1000 * way[:, :2]))

if options.picture:
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(6.4, 3.4), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    for name, values, colour in zip(
        ("best", "mean", "worst"), np.array(curve).T, ("#2f7d5b", "#2b2f36", "#a9adb5"), strict=True
    ):
        axes.plot(values, label=name, color=colour, lw=1.4)
    axes.set(xlabel="generation", ylabel="fitness: V (1 - √ΔV) (1 - i), by way", ylim=(0, 1))
    axes.legend(loc="lower right", frameon=False)
    save(figure, options.picture)
    way_file = options.picture.with_name(f"{options.picture.stem}_way.png")
    save(draw(maze, tracks[:1], title=f"{options.check_seconds:g} s of the evolved network"), way_file)
