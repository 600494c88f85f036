"""Wall or cylinder, after Nolfi (1996): a network evolves to find a cylinder and stay, and to leave walls.

    .venv/bin/pip install cmaes
    .venv/bin/python examples/classics/wall_or_cylinder.py --picture wall_or_cylinder.png

As in his work, eight proximity sensors are connected directly to two motors, without memory, an action takes
100 ms, and the fitness is the part of an episode near the cylinder: within 80 mm between the centres, 40 mm
between the edges. The search is CMA-ES in the plane, from weights of 0, instead of his genetic algorithm. The
search's final mean is evaluated in MuJoCo from new starts, 100 mm or more from the cylinder.
"""

import numpy as np
from curves import draw_curve
from evolution import evolve, parse_options
from trajectories import trajectories

from khep_twin import EpisodeSetup, Network, Playpen, Start
from khep_twin.drawing import DrawnPath, draw, save
from khep_twin.randomness import stream

options = parse_options(
    "Evolve the discrimination of a cylinder from walls.",
    generations=50,
    episodes=8,
    seconds=50.0,
    check_starts=50,
)

NEAR_MM, SAMPLE_S, ACTION_NS = 80.0, 0.5, 100_000_000
NETWORK = Network()
ARENA = Playpen.load("wall-or-cylinder")
CYLINDER = np.array((ARENA.cylinders[0].x_mm, ARENA.cylinders[0].y_mm))
rng = stream(options.seed, "wall-or-cylinder")


def random_starts(count: int) -> list[Start]:
    """Return poses off the walls, 100 mm or more from the cylinder."""
    starts: list[Start] = []
    while len(starts) < count:
        x_mm, y_mm, heading_deg = rng.uniform((40, 40, -180), (360, 360, 180)).tolist()
        if np.hypot(x_mm - CYLINDER[0], y_mm - CYLINDER[1]) >= 100:
            starts.append((x_mm, y_mm, heading_deg))
    return starts


def near_cylinder(poses: np.ndarray) -> np.ndarray:
    """Return which poses are near the cylinder (episodes, samples)."""
    return np.hypot(poses[..., 0] - CYLINDER[0], poses[..., 1] - CYLINDER[1]) <= NEAR_MM


def judge(genomes: np.ndarray, generation: int) -> np.ndarray:
    """Return the fitness of each genome, the mean over its episodes, which are those of all."""
    starts = random_starts(options.episodes) * len(genomes)
    genes, first_seed = genomes.repeat(options.episodes, axis=0), generation * len(starts)
    poses = trajectories(
        plane, NETWORK, genes, starts, options.seconds, sample_s=SAMPLE_S, first_seed=first_seed
    )
    return near_cylinder(poses).reshape(len(genomes), -1).mean(axis=1)


plane = EpisodeSetup(ARENA, planar=True, period_ns=ACTION_NS)
evolved, curve = evolve(np.zeros(NETWORK.n_genes), 1.0, options, judge)

mujoco = EpisodeSetup(ARENA, period_ns=ACTION_NS)
starts = random_starts(options.check_starts)
poses = trajectories(mujoco, NETWORK, evolved, starts, options.seconds)
near = near_cylinder(poses)
x_mm, y_mm = poses[..., 0], poses[..., 1]
sides = ARENA.arena.width_mm, ARENA.arena.height_mm
to_wall = np.minimum(np.minimum(x_mm, sides[0] - x_mm), np.minimum(y_mm, sides[1] - y_mm))
print(
    f"in MuJoCo, {len(starts)} starts, {options.seconds:g} s: {near.mean():.1%} of the time near it, "
    f"{(to_wall - 27.5 < 40).mean():.1%} within 40 mm of a wall; "
    f"at the cylinder in the end {near[:, -1].mean():.0%}"
)

if options.picture:
    draw_curve(curve, "part of the time near the cylinder", options.picture)
    times = np.arange(poses.shape[1]) * 0.1
    tracks = [DrawnPath("", times, path[:, :2]) for path in poses[: min(3, len(poses))]]
    path_file = options.picture.with_name(f"{options.picture.stem}_way.png")
    save(draw(ARENA, tracks, title="The evolved network from three starts", longer_side=4.5), path_file)
