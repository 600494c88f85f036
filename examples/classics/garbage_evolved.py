"""Garbage collecting with the gripper, after Nolfi (1997): a network evolves to put cylinders outside.

    .venv/bin/pip install cmaes
    .venv/bin/python examples/classics/garbage_evolved.py --picture garbage_evolved.png

As in his work, a network without hidden neurons has two modules, for an empty gripper and for one with an
object. Each connects eight proximity sensors to both motors and to a neuron that starts a procedure, "pick
up" or "release". CMA-ES searches in the plane, which has no
gripper: a cylinder before the fingers counts as picked up, and a release over the wall as put out. The last
generations, one of 50, run in MuJoCo with the gripper, which the search's final mean is also evaluated in,
from new starts.
"""

import numpy as np
from curves import draw_curve
from evolution import evolve, parse_options
from numpy.typing import NDArray

from khep_twin import Episode, EpisodeOptions, EpisodeSetup, Playpen, Policy, RolloutResult, Start, rollout
from khep_twin.drawing import DrawnPath, draw, save
from khep_twin.episodes import EpisodeBatch
from khep_twin.randomness import stream
from khep_twin.units import ARM_DOWN, ARM_UP, COUNTS_LIMIT, FINGERS_OPEN

Floats = NDArray[np.float64]

options = parse_options(
    "Evolve a garbage collector.", generations=150, episodes=4, seconds=30.0, check_starts=10
)

ACTION_NS, STEP_NS, CHECK_STEP_NS, CHECK_S, TOP_SPEED_PULSES = 100_000_000, 5_000_000, 2_500_000, 60.0, 10
ARENA = Playpen.load("garbage")
SIDES_MM = np.array((ARENA.arena.width_mm, ARENA.arena.height_mm))
CYLINDERS_MM = np.array([(cylinder.x_mm, cylinder.y_mm) for cylinder in ARENA.cylinders])
DARK, OVER_WALL = 200, 225
"""Light barrier from which an object is between the fingers; position of the arm over a wall."""

NETWORK, PICK_UP, FORWARD, LIFT, LAST_PICK, RELEASE, LAST = 0, 1, 3, 5, 6, 7, 11
"""Steps: the network drives in 0; 1 to 6 pick up, 7 to 11 release. FORWARD ends when the barrier is dark."""
ACTIONS = np.array((0, 3, 9, 20, 8, 9, 7, 15, 7, 6, 8, 7))
SPEEDS = np.array((0, -5, 0, 2, 0, 0, -5, 3, 0, 0, 0, -5))
ARM = np.array((*[ARM_UP] * 2, *[ARM_DOWN] * 3, *[ARM_UP] * 3, *[OVER_WALL] * 2, *[ARM_UP] * 2))
CLOSED = np.array((0, 0, 0, 0, 1, 1, 1, 1, 1, 0, 0, 0), bool)
"""Duration, speed, arm and fingers of each step; in 0 and 6 the fingers stay closed around an object."""

PAIRS = (0, 1, 2, 2, 1, 0, 3, 3, 4)
"""Weights of the procedure's neuron, which is symmetric: proximity from left to right, back, and bias."""
N_WEIGHTS = 9 + 9 + 5
N_GENES = 2 * N_WEIGHTS


class Collectors:
    """Controllers of n robots, a `Policy`.

    Args:
        genomes: Genome of each (n, N_GENES).
    """

    def __init__(self, genomes: Floats) -> None:
        left, right, start = np.split(genomes.reshape(-1, 2, N_WEIGHTS), (9, 18), axis=2)
        self.weights = np.stack((left, right, start[..., PAIRS]), axis=2)
        self.step, self.left = np.zeros((2, len(genomes)), np.int64)
        self.picked_up, self.tries, self.released = np.zeros((3, len(genomes)), np.int64)
        self.carrying = np.zeros(len(genomes), bool)
        self.forwards, self.n_actions = np.zeros((2, len(genomes)))

    def decide(self, proximity: Floats, ambient: object, which: NDArray[np.int64], barrier: Floats) -> Floats:
        """Return speeds, position of the arm and of the fingers of some robots (n, 4)."""
        step, left, dark = self.step[which], self.left[which] - 1, barrier[:, 0] >= DARK
        has_ended = (step != NETWORK) & ((left <= 0) | ((step == FORWARD) & dark))
        is_lifted, is_released = has_ended & (step == LIFT), has_ended & (step == LAST)
        carrying = np.where(is_lifted | is_released | (step == NETWORK), dark, self.carrying[which])
        carrying &= is_lifted | self.carrying[which]
        self.picked_up[which] += is_lifted & dark
        step = np.where(has_ended, np.where(np.isin(step, (LAST_PICK, LAST)), NETWORK, step + 1), step)
        inputs = np.column_stack((proximity / COUNTS_LIMIT, np.ones(len(which))))
        outputs = np.tanh(np.einsum("noi,ni->no", self.weights[which, carrying.astype(int)], inputs))
        starts = (step == NETWORK) & (outputs[:, 2] > 0)
        self.tries[which] += starts & ~carrying
        self.released[which] += starts & carrying
        step = np.where(starts, np.where(carrying, RELEASE, PICK_UP), step)
        drives = step == NETWORK
        speeds = np.where(drives[:, None], TOP_SPEED_PULSES * outputs[:, :2], SPEEDS[step][:, None])
        clear = 1 - inputs[:, :6].max(axis=1)
        self.forwards[which] += drives * clear * np.maximum(speeds.mean(axis=1), 0) / TOP_SPEED_PULSES
        self.n_actions[which] += 1
        self.step[which], self.carrying[which] = step, carrying
        self.left[which] = np.where(has_ended | starts, ACTIONS[step], left)
        closed = np.where(np.isin(step, (NETWORK, LAST_PICK)), carrying, CLOSED[step])
        return np.column_stack((speeds, ARM[step], FINGERS_OPEN * ~closed))

    def mean_forwards(self) -> Floats:
        """Return the mean speed forwards of the network, away from obstacles, 0 to 1 (n,)."""
        return self.forwards / np.maximum(self.n_actions, 1)


def random_starts(count: int) -> list[Start]:
    """Return poses off the walls, 75 mm or more from the cylinders."""
    starts: list[Start] = []
    while len(starts) < count:
        x_mm, y_mm, heading_deg = rng.uniform((60, 60, -180), (*SIDES_MM - 60, 180)).tolist()
        if np.hypot(*(CYLINDERS_MM - (x_mm, y_mm)).T).min() >= 75:
            starts.append((x_mm, y_mm, heading_deg))
    return starts


def outside(positions_mm: Floats) -> NDArray[np.bool_]:
    """Return which positions are out of the arena (…,)."""
    return ((positions_mm < 0) | (positions_mm > SIDES_MM)).any(axis=-1)


def run_in_plane(genomes: Floats, carrying: bool) -> Floats:
    """Return the fitness of an episode of each genome, until it first picks up, or releases (n,).

    With an object in the gripper, a robot starts in an arena without cylinders.
    """
    collectors, fitness, n_actions = Collectors(genomes), np.zeros(len(genomes)), int(options.seconds * 10)
    collectors.carrying[:] = carrying
    starts, batch, has_ended = (
        random_starts(options.episodes),
        BATCHES[carrying],
        np.zeros(len(genomes), bool),
    )
    for index in range(len(genomes)):
        batch.begin(index, index, EpisodeOptions(start=starts[index % len(starts)]))
    for action in range(n_actions):
        running = np.flatnonzero(~has_ended)
        poses, objects_mm = batch.poses[running, 0], 1000 * batch.objects[running, :, :2]
        ahead = np.stack((np.cos(poses[:, 2]), np.sin(poses[:, 2])), axis=1)
        offsets = objects_mm - 1000 * poses[:, None, :2]
        front = np.einsum("nki,ni->nk", offsets, ahead)
        aside = offsets[..., 1] * ahead[:, :1] - offsets[..., 0] * ahead[:, 1:]
        dark = carrying | ((front > 0) & (front < 62) & (np.abs(aside) < 13)).any(axis=1)
        proximity = batch.registers[running, 0, slice(*PLANES[0].interface.proximity)]
        done = collectors.released if carrying else collectors.picked_up
        before = done[running]
        outputs = collectors.decide(proximity, None, running, 255.0 * dark[:, None])
        ends, quality = done[running] > before, 1.5 - action / n_actions / 2
        if carrying:
            quality = np.where(outside(1000 * poses[:, :2] + 55 * ahead), quality, -0.2)
        fitness[running] += ends * quality
        has_ended[running] |= ends
        batch.speeds[running, 0] = outputs[:, :2]
        batch.step(running, PLANES[0].steps_per_period)
    return fitness + 0.3 * collectors.mean_forwards() - 0.04 * (not carrying) * collectors.tries


def run_in_mujoco(
    genes: Floats, starts: list[Start], first_seed: int, seconds: float, step_ns: int = STEP_NS
) -> tuple[Collectors, NDArray[np.int64], RolloutResult]:
    """Run an episode of each genome with the gripper; return how many cylinders it put out, too."""
    collectors, seeds = Collectors(genes), range(first_seed, first_seed + len(genes))
    setup, commands = (
        EpisodeSetup(ARENA, step_ns=step_ns, period_ns=ACTION_NS),
        ("gripper_arm", "gripper_fingers"),
    )
    policy = Policy(collectors.decide, terms=("gripper_barrier",), commands=commands)
    results = rollout(setup, policy, seeds, seconds, starts=starts, paths_every=ACTION_NS / 1e9)
    return collectors, outside(1000 * results.objects[..., :2]).sum(axis=1), results


def judge(genomes: Floats, generation: int) -> Floats:
    """Return the fitness of each genome, the mean over its episodes, which are those of all.

    In MuJoCo it is 2 for each cylinder put out, and 1 for it and the next one picked up.
    """
    genes = genomes.repeat(options.episodes, axis=0)
    if generation < options.generations - max(options.generations // 50, 1):
        fitness = run_in_plane(genes, False) + run_in_plane(genes, True)
    else:
        starts, first_seed = random_starts(options.episodes) * len(genomes), generation * len(genes)
        collectors, out, _ = run_in_mujoco(genes, starts, first_seed, options.seconds)
        fitness = 2 * out + np.minimum(collectors.picked_up, out + 1) + 0.3 * collectors.mean_forwards()
    return fitness.reshape(len(genomes), -1).mean(axis=1)


rng = stream(options.seed, "garbage-evolved")
bare = ARENA.model_copy(update={"robots": (ARENA.robots[0].model_copy(update={"turrets": ()}),)})
PLANES = [
    EpisodeSetup(playpen, planar=True, period_ns=ACTION_NS)
    for playpen in (bare, bare.model_copy(update={"cylinders": ()}))
]
BATCHES = [
    EpisodeBatch([Episode(plane, compiled=True) for _ in range(options.population * options.episodes)], 1)
    for plane in PLANES
]
mean, curve = evolve(np.zeros(N_GENES), 1.0, options, judge)

count = options.check_starts
collectors, out, results = run_in_mujoco(
    np.tile(mean, (count, 1)), random_starts(count), 10_000, CHECK_S, CHECK_STEP_NS
)
for start in range(count):
    print(f"start {start}: {collectors.picked_up[start]} picked up, {out[start]} put out of the arena")
print(f"in MuJoCo, {count} new starts, {CHECK_S:g} s: {(out > 0).sum()} picked up and carried over the wall")

if options.picture:
    draw_curve(curve, "fitness", options.picture)
    best = int(out.argmax())
    path, objects_mm = results.paths[best], 1000 * results.objects[best, :, :2]
    track = DrawnPath("khepera0", np.arange(len(path)) * ACTION_NS / 1e9, 1000 * path[:, :2])
    title = f"The evolved network in {CHECK_S:g} s; crosses: cylinders put out"
    figure = draw(ARENA, [track], title=title, longer_side=4.8)
    crosses = np.clip(objects_mm[outside(objects_mm)], -30, SIDES_MM + 30)  # some have rolled on
    figure.axes[0].plot(*crosses.T, "x", ms=9, mew=2, color="#c0392b", zorder=8)
    figure.axes[0].set(xlim=(-50, SIDES_MM[0] + 50), ylim=(-50, SIDES_MM[1] + 50))
    save(figure, options.picture.with_name(f"{options.picture.stem}_way.png"))
