"""Phototaxis: a network evolves to find the brighter of two lamps, which a screen hides; minutes on one core.

    .venv/bin/pip install cmaes
    .venv/bin/python examples/classics/phototaxis.py --picture phototaxis.png

The network connects proximity and light directly to both motors, with feedback of the motors' last values.
CMA-ES searches its weights in the plane, from weights of 0. An episode starts anywhere. Its fitness is the
time left when the robot arrives within 60 mm of the bright lamp, as a part of the episode, and a fifth of
exp(-d / 100 mm) for the smallest distance d. The final mean of the search is then compared in MuJoCo, from
other starts, with Braitenberg's vehicle 2b that also avoids obstacles, and with the ROM's vehicle, which is
blind to light.
"""

import numpy as np
from curves import draw_curve
from evolution import evolve, parse_options
from trajectories import trajectories

from khep_twin import Braitenberg, EpisodeSetup, Network, Playpen, Start
from khep_twin.drawing import DrawnPath, draw, save
from khep_twin.episodes import Driver
from khep_twin.playpen import anywhere
from khep_twin.randomness import stream

options = parse_options(
    "Evolve phototaxis around a screen.", generations=80, episodes=16, seconds=30.0, check_starts=100
)

ARRIVED_MM = 60.0
SAMPLE_S = 0.2
NETWORK = Network(recurrent=True, ambient=True)
ARENA = Playpen.load("light-seeking")
BRIGHT = np.array((ARENA.lamps[0].x_mm, ARENA.lamps[0].y_mm))


def random_starts(first_seed: int, count: int) -> list[Start]:
    """Return free poses of the arena."""
    robots = [anywhere(ARENA, seed).robots[0] for seed in range(first_seed, first_seed + count)]
    return [(robot.x_mm, robot.y_mm, robot.heading_deg) for robot in robots]


def vehicle() -> np.ndarray:
    """Return the genes of vehicle 2b, crossed excitation by light, that turns away from obstacles."""
    motors = np.zeros((2, 1 + 8 + 8))  # bias, proximity, light
    motors[:, 0] = 0.3
    for motor, same_side, other_side in (
        (0, 0, 3),
        (1, 3, 0),
    ):  # first sensors of the motor's same_side and other_side side
        motors[motor, 1 + same_side : 4 + same_side], motors[motor, 1 + other_side : 4 + other_side] = (
            0.5,
            -1.0,
        )
        motors[motor, 9 + other_side : 12 + other_side] = 1 / 3
    return motors.ravel()


def distances_mm(
    setup: EpisodeSetup, driver: Driver, genes: np.ndarray, starts: list[Start], first_seed: int
):
    """Return the distances from the bright lamp (episodes, samples) [mm] and the poses."""
    poses = trajectories(
        setup, driver, genes, starts, options.seconds, sample_s=SAMPLE_S, first_seed=first_seed
    )
    return np.hypot(*np.moveaxis(poses[..., :2] - BRIGHT, -1, 0)), poses


def arrivals(distances: np.ndarray) -> np.ndarray:
    """Return the times of the arrivals [s] (episodes,), infinity for none."""
    is_near = distances < ARRIVED_MM
    return np.where(is_near.any(axis=1), is_near.argmax(axis=1) * SAMPLE_S, np.inf)


def judge(genomes: np.ndarray, generation: int) -> np.ndarray:
    """Return the fitness of each genome, the mean over its episodes, which are those of all."""
    starts = [pool[index] for index in rng.integers(len(pool), size=options.episodes)] * len(genomes)
    genes, first_seed = genomes.repeat(options.episodes, axis=0), generation * len(starts)
    distances, _ = distances_mm(plane, NETWORK, genes, starts, first_seed)
    left = np.maximum(1 - arrivals(distances) / options.seconds, 0)
    fitness = left + 0.2 * np.exp(-distances.min(axis=1) / 100)
    return fitness.reshape(len(genomes), -1).mean(axis=1)


plane = EpisodeSetup(ARENA, planar=True)
pool, rng = random_starts(1000, 400), stream(options.seed, "phototaxis")
evolved, curve = evolve(np.zeros(NETWORK.n_genes), 0.8, options, judge)

mujoco = EpisodeSetup(ARENA)
starts = random_starts(0, options.check_starts)
print(f"in MuJoCo, {len(starts)} starts, {options.seconds:g} s   arrive   median time    there at the end")
for name, driver, genes in (
    ("ROM's vehicle, blind", Braitenberg(), np.zeros(0)),
    ("vehicle 2b, avoiding", Network(ambient=True), vehicle()),
    ("evolved network", NETWORK, evolved),
):
    distances, poses = distances_mm(mujoco, driver, genes, starts, 0)
    times = arrivals(distances)
    print(
        f"{name:32}{np.isfinite(times).mean():9.0%}{np.median(times):12.1f} s"
        f"{(distances[:, -1] < ARRIVED_MM).mean():18.0%}"
    )

if options.picture:
    draw_curve(curve, "time left at arrival, and nearness", options.picture)
    tracks = []
    for episode_poses, arrival in list(zip(poses, times, strict=True))[:6]:
        n_samples = round(min(arrival, options.seconds) / SAMPLE_S) + 1
        tracks.append(DrawnPath("", np.arange(n_samples) * SAMPLE_S, episode_poses[:n_samples, :2]))
    title = "The evolved network from six starts, until it arrives"
    path_file = options.picture.with_name(f"{options.picture.stem}_way.png")
    save(draw(ARENA, tracks, title=title, longer_side=5), path_file)
