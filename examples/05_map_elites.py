"""MAP-Elites in the maze of Kheperax (Grillotti and Cully 2023), with pyribs; minutes on two cores.

    .venv/bin/pip install ribs
    .venv/bin/python examples/05_map_elites.py --picture archive.png --elites elites.npz

The task is Kheperax's standard one in the maze of Mouret and Doncieux (2012), for a Khepera: the playpen
`deceptive-maze` is as large beside the robot as the maze there. The descriptor of a network is the position
of the robot at the end of the episode. The objective is 1 less the control effort, which is the mean of the
squares of both wheels' speeds as parts of full speed: 1 for a robot at rest, 0 for full speed all the time.
Kheperax's reward is the same with another scale. In an episode full speed covers 6.3 sides of the maze,
there 6.25. The network has one hidden layer of eight neurons, as there, and the Khepera's eight sensors.

Episodes run in a plane, all with the same seed. Some of the elites are then evaluated again: in MuJoCo, and
in the plane with another seed, whose noise alone also moves the end of an episode.
"""

import argparse
import sys
import time
from pathlib import Path

import numpy as np

from khep_twin import EpisodeSetup, Network, Playpen, rollout
from khep_twin.drawing import draw, save
from khep_twin.errors import pip_install
from khep_twin.files import unusable
from khep_twin.randomness import stream

try:
    from ribs.archives import GridArchive
    from ribs.emitters import GaussianEmitter
    from ribs.schedulers import Scheduler
except ImportError:
    sys.exit(f"ribs is not installed; to install it: {pip_install('ribs')}")

parser = argparse.ArgumentParser(description="Fill a MAP-Elites archive of end positions in a maze.")
parser.add_argument("--iterations", type=int, default=100)
parser.add_argument("--batch", type=int, default=512, help="evaluations per iteration")
parser.add_argument("--cells", type=int, default=50, help="cells of the archive along a side of the maze")
parser.add_argument(
    "--sigma", type=float, default=0.05, help="standard deviation of the mutation of a weight"
)
parser.add_argument("--seconds", type=float, default=72.0, help="duration of an episode")
parser.add_argument("--seed", type=int, default=0)
parser.add_argument("--line", type=int, help="speed of the line between controller and robot [baud]")
parser.add_argument("--device", default="cpu", help="cpu, or cuda for an NVIDIA card, with --batch 4096")
parser.add_argument("--judge", type=int, default=20, help="number of elites that are evaluated again")
parser.add_argument("--picture", type=Path, help="draw the archive over the maze to this file")
parser.add_argument("--elites", type=Path, help="write genomes, objectives and descriptors to this NPZ file")
options = parser.parse_args()
for path in (options.picture, options.elites):
    if path is not None and (reason := unusable(path)):
        parser.error(f"{path}: cannot be written: {reason}")

NETWORK = Network(hidden=(8,))

maze = Playpen.load("deceptive-maze")
side = maze.arena.width_mm / 1000
plane = EpisodeSetup(maze, planar=True, at_line=options.line is not None)
mujoco = EpisodeSetup(maze)


def judge(setup: EpisodeSetup, genomes: np.ndarray, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the objective of each genome (n,) and the position at the end (n, 2) [m]."""
    seeds, device = [seed] * len(genomes), options.device if setup is plane else "cpu"
    results = rollout(setup, NETWORK, seeds, options.seconds, genes=genomes, line=options.line, device=device)
    return 1 - np.nan_to_num(results.metrics["effort"], nan=1.0), results.poses[:, :2]


archive = GridArchive(
    solution_dim=NETWORK.n_genes, dims=[options.cells] * 2, ranges=[(0, side)] * 2, seed=options.seed
)
first = stream(options.seed, "first genomes").normal(size=(options.batch, NETWORK.n_genes))
emitter = GaussianEmitter(
    archive,
    sigma=options.sigma,
    initial_solutions=first,
    batch_size=options.batch,
    seed=int(stream(options.seed, "emitter").integers(2**32)),
)
search = Scheduler(archive, [emitter])
began = time.monotonic()
for iteration in range(1, options.iterations + 1):
    search.tell(*judge(plane, search.ask(), options.seed))
    if iteration % 10 == 0 or iteration == options.iterations:
        print(
            f"iteration {iteration:4}  evaluations {iteration * options.batch:7}  "
            f"coverage {100 * archive.stats.coverage:4.1f} %  QD score {archive.stats.qd_score:6.1f}  "
            f"{time.monotonic() - began:5.0f} s",
            flush=True,
        )

elites = archive.data(["solution", "objective", "measures", "index"], return_type="dict")
if options.elites:
    np.savez(
        options.elites,
        genomes=elites["solution"],
        objectives=elites["objective"],
        end_m=elites["measures"],
    )

# The cells are drawn by the seed, and listed by their distance from the start.
count = min(options.judge, len(elites["index"]))
if count:
    drawn = stream(options.seed, "judged").choice(len(elites["index"]), count, replace=False)
    start = np.array([maze.robots[0].x_mm, maze.robots[0].y_mm]) / 1000
    drawn = drawn[np.argsort(np.hypot(*(elites["measures"][drawn] - start).T), kind="stable")]
    genomes, ends = elites["solution"][drawn], elites["measures"][drawn]
    offs = []
    for setup, seed in ((mujoco, options.seed), (plane, options.seed + 1), (mujoco, options.seed + 1)):
        offs.append(1000 * np.hypot(*(judge(setup, genomes, seed)[1] - ends).T))
    print("distance of the end from that of the elite, mm")
    print("   end, mm  objective   MuJoCo, same seed   plane, next seed   MuJoCo, next seed")
    for (x, y), objective, off in zip(ends, elites["objective"][drawn], np.transpose(offs), strict=True):
        print(f"{1000 * x:5.0f},{1000 * y:4.0f}{objective:11.3f}{off[0]:20.0f}{off[1]:19.0f}{off[2]:20.0f}")
    middle = np.median(offs, axis=1)
    print(f"{'median':10}{'':11}{middle[0]:20.0f}{middle[1]:19.0f}{middle[2]:20.0f}")

if options.picture:
    grid = np.full([options.cells] * 2, np.nan)
    grid[tuple(archive.int_to_grid_index(elites["index"]).T)] = elites["objective"]
    figure = draw(
        maze,
        title=f"{options.iterations * options.batch} evaluations: coverage "
        f"{100 * archive.stats.coverage:.1f} %, QD score {archive.stats.qd_score:.0f}",
    )
    axes = figure.axes[0]
    edges = np.linspace(0, 1000 * side, options.cells + 1)
    cells = axes.pcolormesh(edges, edges, grid.T, vmin=0, vmax=1, cmap="viridis", zorder=1.5)
    # Room for the scale on the right.
    (left, bottom, width, height), part = axes.get_position().bounds, 1 / 1.13
    figure.set_figwidth(figure.get_figwidth() / part)
    axes.set_position((left * part, bottom, width * part, height))
    scale_axes = figure.add_axes(((left + width) * part + 0.02, bottom, 0.02, height))
    figure.colorbar(cells, cax=scale_axes, label="objective: 1 - control effort")
    save(figure, options.picture)
print(f"{len(elites['index'])} elites; processor time {time.process_time():.0f} s")
