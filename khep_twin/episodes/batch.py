"""Batched rollouts: many episodes at once, on all cores.

    from khep_twin import playpen
    from khep_twin.episodes.batch import rollout
    from khep_twin.episodes.controllers import Network

    network = Network(hidden=(5,), recurrent=True)
    genes = numpy.random.default_rng(0).normal(size=(100, network.n_genes))
    results = rollout("looping-maze", network, range(100), 60.0, genes=genes)
    print(results.metrics["obstacle_avoidance"].max(), results.failures)

Each episode depends on its own seed, genes, start and lamps alone: results are the same, bit for bit, with
any number of threads, and the same as those of a single `Episode` with the same setup. Only the results grow
with the number of episodes: every thread has memory for one episode and reuses it.
"""

from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from khep_twin import units
from khep_twin.board.fault_injection import Fault
from khep_twin.board.kernel import AMBIENT, N_REGISTERS, PROXIMITY
from khep_twin.episodes.controllers import Driver, Floats, Network, Policy
from khep_twin.episodes.episode import Episode, is_compiled
from khep_twin.episodes.episode_batch import EpisodeBatch
from khep_twin.episodes.episode_setup import EpisodeSetup
from khep_twin.episodes.metrics import METRICS
from khep_twin.errors import DivergedError
from khep_twin.machine import n_cores
from khep_twin.playpen import Lamp, PlaypenLike
from khep_twin.playpen.starts import Start
from khep_twin.simulation.mujoco_forms import movable_names

BATCH_SIZE = 64
"""Episodes in one call of a policy: enough for arrays to pay, at a bounded use of memory."""


@dataclass(frozen=True, slots=True)
class Failure:
    """An episode that ended early.

    Attributes:
        index: Index in the batch.
        seed: Seed of the episode.
        step: Physics step at which it ended.
        reason: Reason, in one line.
    """

    index: int
    seed: int
    step: int
    reason: str


@dataclass(frozen=True, slots=True)
class RolloutResult:
    """Results of a batch of n episodes.

    Where an episode has several robots, all arrays have an axis of robots behind that of episodes.

    Attributes:
        metrics: Metrics of the episodes by name (`metrics.METRICS`), NaN for those that failed, each (n,).
        registers: Registers of each board at the end (n, N_REGISTERS).
        poses: Final x, y [m] and heading [rad] (n, 3).
        objects: Final x, y [m] and heading [rad] of the movable objects, in the order of `Playpen.objects`
            (n, n_objects, 3); no axis of robots.
        failures: Episodes that ended early, in the batch's order.
    """

    metrics: Mapping[str, Floats]
    registers: NDArray[np.int64]
    poses: Floats
    objects: Floats
    failures: tuple[Failure, ...]


def rollout(
    playpen: PlaypenLike | EpisodeSetup,
    driver: Driver,
    seeds: Sequence[int] | range,
    seconds: float,
    *,
    genes: Floats | None = None,
    starts: Sequence[Start] | None = None,
    lamps: Sequence[Sequence[Lamp]] | None = None,
    noise: bool = True,
    vary: bool = False,
    home: tuple[float, float, float, float] | None = None,
    faults: Sequence[Fault] = (),
    step_ns: int | None = None,
    period_ns: int = units.SCAN_NS,
    planar: bool = False,
    threads: int | None = None,
    compiled: bool | None = None,
) -> RolloutResult:
    """Run a batch of episodes.

    Args:
        playpen: Playpen, its name or path, or an `EpisodeSetup`, which has its own step, period and plane.
        driver: Controller of all episodes.
        seeds: Seeds of the episodes (n,).
        seconds: Duration of each episode [s], whole control periods.
        genes: Genes of each episode's controllers (n, n_genes), or of each robot's (n, n_robots, n_genes).
        starts: Start poses x, y [mm] and heading [deg] of each episode (n, 3), or of each robot
            (n, n_robots, 3); by default the playpen's.
        lamps: Lamps of each episode; by default the playpen's.
        noise: Whether sensors are noisy.
        vary: Whether each episode has another robot of the same make, by its seed.
        home: Home x, y, radius [mm] and duration of a charge [s], for the metric "homing".
        faults: Faults of the robots.
        step_ns: Physics step [ns]: 2.5 ms as on the robot, or 5 or 10 ms; by default 2.5 ms, and 10 ms in a
            plane.
        period_ns: Control period [ns].
        planar: Whether robots move in a plane instead of MuJoCo, for screening.
        threads: Number of threads; by default one per core. Uncompiled episodes use one.
        compiled: Whether to run compiled; None if numba is installed. The first time this waits for
            numba, for some ten seconds.

    Raises:
        ValueError: The number of genes, starts or lamps is not that of the seeds, or a value is out of range.
        ControllerError: Genes do not fit the controller, or numba cannot compile it.
        PlaypenError: The playpen has a feature that episodes without a serial line do not support.
    """
    fast = is_compiled(compiled)
    setup = _setup(playpen, step_ns, period_ns, planar)
    count = len(seeds)
    n_robots = len(setup.playpen.robots)
    weights = _checked_genes(driver, count, n_robots, genes, starts, lamps, threads)
    batch = _Batch(setup, seeds, seconds, weights, starts, lamps, noise, vary, _in_metres(home))
    results = _Results(count, n_robots, len(movable_names(setup.playpen)))
    workers = (threads or n_cores()) if fast else 1
    room = min(BATCH_SIZE if isinstance(driver, Policy) else workers, count)
    episodes = [Episode(setup, driver, compiled=fast, faults=faults) for _ in range(room)]
    if isinstance(driver, Policy) and count:
        with closing(EpisodeBatch(episodes, min(workers, room))) as lanes:
            for first in range(0, count, BATCH_SIZE):
                group = range(first, min(first + BATCH_SIZE, count))
                _run_together(lanes, driver, group, batch, results)
    else:
        with ThreadPoolExecutor(workers) as pool:
            _share_out(pool, episodes, batch, results)
    return results.result()


def _setup(
    playpen: PlaypenLike | EpisodeSetup, step_ns: int | None, period_ns: int, planar: bool
) -> EpisodeSetup:
    """Return the setup of a batch, unchanged if one is given."""
    if not isinstance(playpen, EpisodeSetup):
        return EpisodeSetup(playpen, step_ns=step_ns, period_ns=period_ns, planar=planar)
    given = (
        step_ns not in (None, playpen.step_ns)
        or period_ns not in (units.SCAN_NS, playpen.period_ns)
        or (planar and playpen.planar_scene is None)
    )
    if given:
        raise ValueError(
            "step_ns, period_ns or planar given with an EpisodeSetup, which has its own; expected them as "
            "arguments of EpisodeSetup"
        )
    return playpen


def _checked_genes(
    driver: Driver,
    count: int,
    n_robots: int,
    genes: Floats | None,
    starts: Sequence[Start] | None,
    lamps: Sequence[Sequence[Lamp]] | None,
    threads: int | None,
) -> Floats:
    """Return the genes of each episode; raise a `ValueError` unless there is what each episode needs."""
    for name, given in (("genes", genes), ("starts", starts), ("lamps", lamps)):
        if given is not None and len(given) != count:
            raise ValueError(f"{len(given)} {name} for {count} seeds; expected {count}")
    if isinstance(driver, Network) and genes is None:
        raise ValueError(f"no genes for {driver}; expected shape ({count}, {driver.n_genes})")
    weights = np.zeros((count, 0)) if genes is None else np.asarray(genes, np.float64)
    if weights.ndim not in (2, 3) or not np.isfinite(weights).all():
        raise ValueError(f"genes of shape {weights.shape}; expected finite numbers (n, n_genes)")
    if threads is not None and threads < 1:
        raise ValueError(f"{threads} threads; expected 1 or more")
    for index, start in enumerate(() if starts is None else starts):
        shape = (3,) if n_robots == 1 else (n_robots, 3)
        _check(f"starts[{index}]", start, "x, y [mm] and heading [deg]", shape)
    for index, each in enumerate(() if lamps is None else lamps):
        if isinstance(each, Lamp):
            raise ValueError(f"lamps[{index}] is one lamp; expected a list of lamps for each episode")
    return weights


def _in_metres(home: tuple[float, float, float, float] | None) -> tuple[float, float, float, float]:
    """Return a home with its lengths in metres, all 0 for none; raise a `ValueError` if it is none."""
    if home is None:
        return 0.0, 0.0, 0.0, 0.0
    _check("home", home, "x, y, radius [mm] and duration of a charge [s]", (4,))
    if home[2] <= 0 or home[3] <= 0:
        raise ValueError(f"home = {home}; expected a radius and a charge above 0")
    return units.metres(home[0]), units.metres(home[1]), units.metres(home[2]), home[3]


def _check(name: str, given: object, what: str, shape: tuple[int, ...]) -> None:
    """Raise a `ValueError` unless these are finite numbers of a shape."""
    try:
        numbers = np.asarray(given, np.float64)
        fits = numbers.shape == shape and bool(np.isfinite(numbers).all())
    except (TypeError, ValueError):
        fits = False
    if not fits:
        count = " x ".join(map(str, shape))
        raise ValueError(f"{name} = {given!r}; expected {what}, {count} finite numbers")


@dataclass(frozen=True, slots=True)
class _Batch:
    """Arguments of `rollout` for each episode, once checked; home in metres."""

    setup: EpisodeSetup
    seeds: Sequence[int] | range
    seconds: float
    genes: Floats
    starts: Sequence[Start] | None
    lamps: Sequence[Sequence[Lamp]] | None
    noise: bool
    vary: bool
    home: tuple[float, float, float, float]

    def options(self, index: int) -> dict[str, Any]:
        """Return the arguments of `Episode.begin` for an episode of the batch."""
        return dict(
            seed=int(self.seeds[index]),
            start=None if self.starts is None else self.starts[index],
            noise=self.noise,
            vary=self.vary,
            lamps=None if self.lamps is None else self.lamps[index],
            genes=self.genes[index],
            home=self.home,
        )


class _Results:
    """Results collected from each episode."""

    def __init__(self, count: int, n_robots: int, n_objects: int) -> None:
        self.metrics = {name: np.full((count, n_robots), np.nan) for name in METRICS}
        self.registers = np.zeros((count, n_robots, N_REGISTERS), np.int64)
        self.poses = np.zeros((count, n_robots, 3))
        self.objects = np.zeros((count, n_objects, 3))
        self.failures: list[Failure] = []

    def keep(self, index: int, seed: int, episode: Episode, failure: DivergedError | None) -> None:
        """Store the results of an episode that has ended."""
        self.registers[index], self.poses[index] = episode.boards, episode.poses
        self.objects[index] = episode.objects
        if failure is not None:
            self.failures.append(Failure(index, seed, episode.steps, str(failure)))
            return
        for robot in range(len(episode.boards)):
            for name, value in episode.metrics(robot).items():
                self.metrics[name][index, robot] = value

    def result(self) -> RolloutResult:
        """Return all results."""
        failures = tuple(sorted(self.failures, key=lambda failure: failure.index))
        if self.poses.shape[1] > 1:
            return RolloutResult(self.metrics, self.registers, self.poses, self.objects, failures)
        metrics = {name: values[:, 0] for name, values in self.metrics.items()}
        return RolloutResult(metrics, self.registers[:, 0], self.poses[:, 0], self.objects, failures)


def _share_out(
    pool: ThreadPoolExecutor, episodes: Sequence[Episode], batch: _Batch, results: _Results
) -> None:
    """Run the next episode on each free room; the assignment makes no difference."""
    turns = iter(range(len(batch.seeds)))

    def work(episode: Episode) -> None:
        for index in turns:  # one thread at a time gets the next one
            failure = None
            try:
                episode.begin(**batch.options(index))
                episode.run(batch.seconds)
            except DivergedError as error:
                failure = error
            results.keep(index, int(batch.seeds[index]), episode, failure)

    try:
        for done in [pool.submit(work, episode) for episode in episodes]:
            done.result()
    finally:
        # On an interruption, wait for the episodes that have begun, not for all of them.
        for _ in turns:
            pass


def _run_together(
    lanes: EpisodeBatch, policy: Policy, group: range, batch: _Batch, results: _Results
) -> None:
    """Run episodes side by side, one control period at a time."""
    failures: dict[int, DivergedError] = {}
    for lane, index in enumerate(group):
        try:
            lanes.begin(lane, **batch.options(index))
        except DivergedError as error:
            failures[lane] = error
    n_robots = lanes.speeds.shape[1]
    for _ in range(batch.setup.periods(batch.seconds)):
        living = np.array([lane for lane in range(len(group)) if lane not in failures], np.int64)
        if not len(living):
            break
        board = lanes.registers[living].reshape(-1, N_REGISTERS)
        which = np.repeat(living + group.start, n_robots)
        decided = policy.decide(board[:, PROXIMITY], board[:, AMBIENT], which)
        try:
            speeds = np.asarray(decided, np.float64)
        except (TypeError, ValueError) as error:
            raise ValueError(
                f"the policy returned no speeds: {error}; expected an array ({len(which)}, 2)"
            ) from error
        if speeds.shape != (len(which), 2):
            raise ValueError(
                f"the policy returned speeds of shape {speeds.shape}; expected ({len(which)}, 2)"
            )
        lanes.speeds[living] = speeds.reshape(-1, n_robots, 2)
        failures |= lanes.step(living, batch.setup.steps_per_period)
    for lane, index in enumerate(group):
        results.keep(index, int(batch.seeds[index]), lanes.episodes[lane], failures.get(lane))
