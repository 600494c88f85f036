"""Differences between episodes in the planar model and in MuJoCo.

It prints two tables; `python -m benchmarks` measures the speeds. Paths: the same episodes in both, without
noise, as median and largest differences. They run with speeds from a list, regardless of obstacles, and with
the ROM's vehicle and networks, whose feedback from the sensors amplifies any difference. Ranks: Spearman's
correlation of a metric over random networks between both, and, as an upper bound, between episodes in MuJoCo
with different seeds.
"""

from collections.abc import Sequence

import mujoco
import numpy as np
from scipy.stats import spearmanr

from benchmarks.growth import TWENTY_BLOCKS, twenty_blocks
from benchmarks.scale import NETWORK, random_genes
from khep_twin.episodes.batch import rollout
from khep_twin.episodes.controllers import Braitenberg, ConstantSpeed, Driver, Network
from khep_twin.episodes.episode import Episode
from khep_twin.episodes.episode_options import EpisodeOptions
from khep_twin.episodes.episode_setup import EpisodeSetup
from khep_twin.playpen import Arena, Playpen, RobotEntry
from tools.command_table import command_line

GENOMES, SEEDS, EPISODE_S, ELITE = 200, 3, 30.0, 20
TIMES_S = (1.0, 6.0, 60.0)
REPEATS = 10


def open_floor() -> Playpen:
    """Return a floor without obstacles within a minute's drive."""
    robot = RobotEntry(x_mm=5000, y_mm=5000, heading_deg=20)
    arena = Arena(width_mm=10_000, height_mm=10_000)
    return Playpen(version=1, name="open-floor", arena=arena, robot=(robot,), surfaces={})


def without_gripper() -> Playpen:
    """Return the arena with five cylinders, for a robot without a gripper that pushes them."""
    scene = Playpen.load("garbage")
    robots = tuple(robot.model_copy(update={"turrets": ()}) for robot in scene.robots)
    return scene.model_copy(update={"name": "garbage, pushed", "robots": robots})


def scenes() -> dict[str, Playpen]:
    shipped = {name: Playpen.load(name) for name in ("default", "obstacles", "looping-maze")}
    return {**shipped, TWENTY_BLOCKS: twenty_blocks()}


def path(setup: EpisodeSetup, index: int, driver: Driver | None) -> list[tuple[float, float, float]]:
    """Return the poses of an episode at TIMES_S; without a driver, speeds change at random every 0.5 s."""
    episode = Episode(setup, driver or ConstantSpeed())
    genes = random_genes(REPEATS)[index] if isinstance(driver, Network) else ()
    robot = setup.entry
    start = (robot.x_mm, robot.y_mm, robot.heading_deg + 3.0 * index)
    episode.begin(index, EpisodeOptions(start=start, noise=False, genes=genes))
    rng = np.random.default_rng(index)
    poses: list[tuple[float, float, float]] = []
    for half in range(round(2 * TIMES_S[-1])):
        if driver is None:
            episode.drive(*rng.integers(-10, 16, 2).tolist())
        episode.run(0.5)
        if (half + 1) / 2 in TIMES_S:
            poses.append(episode.pose)
    return poses


def paths(title: str, scene: Playpen, driver: Driver | None) -> None:
    """Print the distances between setups."""
    setups = [EpisodeSetup(scene), EpisodeSetup(scene, planar=True)]
    poses = np.array([[path(setup, index, driver) for setup in setups] for index in range(REPEATS)])
    differences = poses[:, 0] - poses[:, 1]
    distances_mm = np.hypot(differences[..., 0], differences[..., 1]) * 1e3
    turned = np.degrees(np.abs((differences[..., 2] + np.pi) % (2 * np.pi) - np.pi))
    cells = [
        f"{np.median(distances_mm[:, i]):8.2f} {distances_mm[:, i].max():7.1f} {np.median(turned[:, i]):7.2f}"
        for i in range(len(TIMES_S))
    ]
    print(f"{title:36}{'   '.join(cells)}", flush=True)


def ranks(name: str, scene: Playpen) -> None:
    """Print the correlation of both rankings of the same networks."""
    genes = np.repeat(random_genes(GENOMES), SEEDS, axis=0)

    def mean_metrics(first: int, planar: bool) -> dict[str, np.ndarray]:
        seeds = [first + seed for _ in range(GENOMES) for seed in range(SEEDS)]
        setup = EpisodeSetup(scene, planar=planar)
        results = rollout(setup, NETWORK, seeds, EPISODE_S, genes=genes)
        numbers = {number: results.metrics[number] for number in ("obstacle_avoidance", "distance_m")}
        if results.objects.size:
            first = rollout(setup, NETWORK, seeds[:1], 0.0, genes=genes[:1]).objects
            numbers["objects moved"] = np.hypot(*(results.objects - first)[..., :2].T).sum(axis=0)
        return {name: values.reshape(GENOMES, SEEDS).mean(axis=1) for name, values in numbers.items()}

    plane, true, again = mean_metrics(0, True), mean_metrics(0, False), mean_metrics(SEEDS, False)
    for number in plane:
        hit = len(set(_best_first(plane[number])[:ELITE]) & set(_best_first(true[number])[:ELITE]))
        seed_hits = len(set(_best_first(again[number])[:ELITE]) & set(_best_first(true[number])[:ELITE]))
        best = int(_best_first(true[number])[0])
        rank = int(np.flatnonzero(_best_first(plane[number]) == best)[0]) + 1
        print(
            f"{name:14}{number:20}{spearmanr(plane[number], true[number])[0]:8.3f}"
            f"{spearmanr(again[number], true[number])[0]:12.3f}{hit:10d}{seed_hits:10d}{rank:10d}",
            flush=True,
        )


def _best_first(metrics: np.ndarray) -> np.ndarray:
    return np.argsort(-metrics, kind="stable")  # NaN last


def main(arguments: Sequence[str] | None = None) -> None:
    parser = command_line(__doc__)
    parser.add_argument("table", nargs="?", choices=["paths", "ranks"], help="print one table; default both")
    tables = parser.parse_args(arguments).table or "paths and ranks"
    print(f"mujoco {mujoco.__version__}")
    if "paths" in tables:
        print("apart after" + "".join(f"{time_s:>24g} s " for time_s in TIMES_S))
        print(" " * 36 + "   ".join("  median     max    turn" for _ in TIMES_S) + "  [mm, mm, deg]")
        paths("open floor, speeds by a list", open_floor(), None)
        for name, scene in scenes().items():
            paths(f"{name}, speeds by a list", scene, None)
        for name, scene in scenes().items():
            paths(f"{name}, ROM's vehicle", scene, Braitenberg())
        for name, scene in scenes().items():
            paths(f"{name}, random networks", scene, NETWORK)
    if "ranks" in tables:
        print(
            f"{GENOMES} networks, {SEEDS} episodes of {EPISODE_S:g} s: Spearman's rank correlation to MuJoCo"
        )
        print(f"{'':34}{'plane':>8}{'own seeds':>12}{f'of {ELITE}':>10}{'own':>10}{'best at':>10}")
        for name, scene in {**scenes(), "garbage": without_gripper()}.items():
            ranks(name, scene)
