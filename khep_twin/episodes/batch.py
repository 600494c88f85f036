"""Batched rollouts: many episodes in parallel, on all cores.

    from khep_twin import Network, rollout

    network = Network(hidden=(5,), recurrent=True)
    genes = numpy.random.default_rng(0).normal(size=(100, network.n_genes))
    results = rollout("looping-maze", network, range(100), 60.0, genes=genes)
    print(results.metrics["obstacle_avoidance"].max(), results.failures)

An episode depends only on its seed, genes, start and lamps. Results are bitwise equal for any number of
threads, and equal to those of a single `Episode` with the same setup. Every thread reuses the memory of one
episode, so only the results grow with the number of episodes. With `device="cuda"` an NVIDIA GPU runs
episodes in the plane (`cuda`).
"""

from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from dataclasses import dataclass, replace
from threading import Event
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from khep_twin.episodes.controllers import Driver, Floats, Network, Policy, readings_of
from khep_twin.episodes.device import Device, choose_device
from khep_twin.episodes.episode import Episode, is_compiled
from khep_twin.episodes.episode_batch import EpisodeBatch
from khep_twin.episodes.episode_options import DEFAULT_OPTIONS, EpisodeOptions, check_count, check_numbers
from khep_twin.episodes.episode_setup import EpisodeSetup
from khep_twin.episodes.line import LineTimes
from khep_twin.episodes.metrics import METRICS, compute_means
from khep_twin.errors import DivergedError
from khep_twin.playpen import Lamp, PlaypenLike
from khep_twin.playpen.starts import Start
from khep_twin.process.machine import n_cores
from khep_twin.simulation.mujoco_forms import movable_names
from khep_twin.units import SCAN_NS

BATCH_SIZE = 64
"""Episodes in one call of a policy: enough for array operations to be efficient, in bounded memory."""

MAX_LAUNCH_NS = 10_000_000_000
"""Longest simulated time of one launch on a GPU [ns]: the driver aborts long kernels if it has a display."""


@dataclass(frozen=True, slots=True)
class Failure:
    """An episode that failed.

    Attributes:
        index: Index in the batch.
        seed: Seed of the episode.
        step: Physics step at which it failed.
        reason: Reason, in one line.
    """

    index: int
    seed: int
    step: int
    reason: str


@dataclass(frozen=True, slots=True)
class RolloutResult:
    """Results of a batch of n episodes.

    With several robots per episode, all arrays have an axis of robots behind the axis of episodes.

    Attributes:
        metrics: Metrics by name (`metrics.METRICS`), NaN for failed episodes, each (n,).
        registers: Registers of each robot at the end (n, n_registers).
        poses: Final x, y [m] and heading [rad] (n, 3).
        objects: Final x, y [m] and heading [rad] of the movable objects, in the order of `Playpen.objects`
            (n, n_objects, 3); no axis of robots.
        failures: Failed episodes, in the batch's order.
        paths: Poses x, y [m] and heading [rad] every `paths_every` [s], NaN after a failure
            (n, n_samples, 3); without `paths_every` no samples.
    """

    metrics: Mapping[str, Floats]
    registers: NDArray[np.int64]
    poses: Floats
    objects: Floats
    failures: tuple[Failure, ...]
    paths: Floats


def rollout(
    playpen: PlaypenLike | EpisodeSetup,
    driver: Driver,
    seeds: Sequence[int] | range,
    seconds: float,
    *,
    genes: Floats | None = None,
    starts: Sequence[Start] | None = None,
    lamps: Sequence[Sequence[Lamp]] | None = None,
    line: LineTimes = None,
    options: EpisodeOptions = DEFAULT_OPTIONS,
    paths_every: float | None = None,
    planar: bool = False,
    device: Device = "cpu",
    threads: int | None = None,
    compiled: bool | None = None,
) -> RolloutResult:
    """Run a batch of episodes.

    Args:
        playpen: Playpen, its name or path, or an `EpisodeSetup` with step, period, plane and faults.
        driver: Controller of all episodes.
        seeds: Seeds of the episodes (n,).
        seconds: Duration of each episode [s], whole control periods.
        genes: Genome of each episode's controllers (n, n_genes), or of each robot's (n, n_robots, n_genes).
        starts: Start poses x, y [mm] and heading [deg] of each episode (n, 3), or of each robot
            (n, n_robots, 3); by default the playpen's.
        lamps: Lamps of each episode; by default the playpen's.
        line: Line between controllers and robots, as a speed [baud] or a `MeasuredCycle`; by default that of
            the options, where exchanges take no time.
        options: Options of all episodes; `genes`, `starts` and `lamps` override them for each episode.
        paths_every: Sampling period of the result's paths [s], whole control periods that divide `seconds`;
            None for no paths.
        planar: Whether to simulate in the plane, if `playpen` is not a setup.
        device: "cpu"; "cuda" for an NVIDIA GPU, in the plane; or "auto" for a GPU if one can run these
            episodes, and they fill it.
        threads: Number of threads; by default one per core. Uncompiled episodes use one.
        compiled: Whether to run compiled; None if numba is installed. The first call waits some ten seconds
            while numba compiles.

    Raises:
        ValueError: There is not one genome, start or list of lamps per seed, or a value is out of range.
        DeviceError: No GPU can run the episodes.
        ControllerError: Genes do not fit the controller, or numba cannot compile it.
        PlaypenError: The playpen has a feature that episodes without a serial line do not support.
    """
    period_ns = driver.period_ns if isinstance(driver, Network) else SCAN_NS
    setup = playpen
    if not isinstance(setup, EpisodeSetup):
        has_line = planar and (line or options.line) is not None
        setup = EpisodeSetup(setup, period_ns=period_ns, planar=planar, at_line=has_line)
    elif planar and setup.planar_scene is None:
        raise ValueError("planar = True: and a setup in MuJoCo; expected EpisodeSetup(..., planar=True)")
    n_episodes = len(seeds)
    max_threads = n_cores() if threads is None else check_count(threads, "threads")
    common_options = options if line is None else replace(options, line=line)
    arguments = _RolloutArguments(setup, seeds, seconds, common_options, genes, starts, lamps, paths_every)
    arguments.check(driver)
    uses_gpu = choose_device(device, setup, driver, common_options.line, n_episodes, lamps) == "cuda"
    results = _Results(setup, n_episodes, arguments.n_samples)
    use_compiled = uses_gpu or is_compiled(compiled)
    n_workers = max_threads if use_compiled else 1
    if uses_gpu:
        _run_on_gpu(driver, arguments, results)
        return results.result()
    n_slots = min(BATCH_SIZE if isinstance(driver, Policy) else n_workers, n_episodes)
    episodes = [Episode(setup, driver, compiled=use_compiled) for _ in range(n_slots)]
    if isinstance(driver, Policy) and n_episodes:
        with closing(EpisodeBatch(episodes, min(n_workers, n_slots))) as batch:
            for group_start in range(0, n_episodes, BATCH_SIZE):
                group = range(group_start, min(group_start + BATCH_SIZE, n_episodes))
                for _ in _run_group(batch, driver, group, arguments, results):
                    pass
    else:
        with ThreadPoolExecutor(n_workers) as pool:
            _run_threads(pool, episodes, arguments, results)
    return results.result()


@dataclass(frozen=True, slots=True)
class _RolloutArguments:
    """Arguments of `rollout` for each episode."""

    setup: EpisodeSetup
    seeds: Sequence[int] | range
    seconds: float
    common_options: EpisodeOptions
    genes: Floats | None
    starts: Sequence[Start] | None
    lamps: Sequence[Sequence[Lamp]] | None
    paths_every: float | None

    @property
    def n_samples(self) -> int:
        """Number of poses of a path; 0 for no paths."""
        if self.paths_every is None:
            return 0
        return 1 + self.setup.periods(self.seconds) // max(self.setup.periods(self.paths_every), 1)

    def check(self, driver: Driver) -> None:
        """Raise a `ValueError` for missing or unusable arguments of an episode."""
        if (interval := self.paths_every) is not None:
            periods = self.setup.periods(interval)
            if not periods or self.setup.periods(self.seconds) % periods:
                raise ValueError(f"paths_every = {interval:g}; expected a part of the {self.seconds:g} s")
            if isinstance(driver, Policy) and self.common_options.line is not None:
                problem = "a policy at a line decides at uneven times"
                raise ValueError(f"paths_every = {interval:g}: {problem}; expected no line")
        n_seeds, n_robots = len(self.seeds), len(self.setup.playpen.robots)
        for name, values in (("genes", self.genes), ("starts", self.starts), ("lamps", self.lamps)):
            if values is not None and len(values) != n_seeds:
                raise ValueError(f"{len(values)} {name} for {n_seeds} seeds; expected {n_seeds}")
        n_default_genes = len(self.common_options.genes) or (
            isinstance(driver, Network) and len(driver.genes)
        )
        if isinstance(driver, Network) and self.genes is None and not n_default_genes:
            raise ValueError(f"no genes for {driver}; expected shape ({n_seeds}, {driver.n_genes})")
        genes = np.zeros((0, 0)) if self.genes is None else np.asarray(self.genes, np.float64)
        if genes.ndim not in (2, 3) or not np.isfinite(genes).all():
            raise ValueError(f"genes of shape {genes.shape}; expected finite numbers (n, n_genes)")
        for index, start in enumerate(self.starts if self.starts is not None else ()):
            shape = (3,) if n_robots == 1 else (n_robots, 3)
            check_numbers(f"starts[{index}]", start, "x, y [mm] and heading [deg]", shape)
        for index, episode_lamps in enumerate(self.lamps if self.lamps is not None else ()):
            if isinstance(episode_lamps, Lamp):
                raise ValueError(f"lamps[{index}] is one lamp; expected a list of lamps for each episode")

    def options(self, index: int) -> EpisodeOptions:
        """Return the options of one episode."""
        varying = (("genes", self.genes), ("start", self.starts), ("lamps", self.lamps))
        changes: dict[str, Any] = {name: values[index] for name, values in varying if values is not None}
        return replace(self.common_options, **changes)


class _Results:
    """Results of all episodes, filled in one by one."""

    def __init__(self, setup: EpisodeSetup, n_episodes: int, n_samples: int) -> None:
        n_robots, n_objects = len(setup.playpen.robots), len(movable_names(setup.playpen))
        self.metrics = {name: np.full((n_episodes, n_robots), np.nan) for name in METRICS}
        self.registers = np.zeros((n_episodes, n_robots, setup.interface.n_registers), np.int64)
        self.poses = np.zeros((n_episodes, n_robots, 3))
        self.objects = np.zeros((n_episodes, n_objects, 3))
        self.paths = np.full((n_episodes, n_robots, n_samples, 3), np.nan)
        self.failures: list[Failure] = []
        self._stored_indices: set[int] = set()

    def store(self, index: int, seed: int, episode: Episode, failure: DivergedError | None) -> None:
        """Store the results of an episode that ended or failed."""
        self._stored_indices.add(index)
        self.registers[index] = [episode.read_registers(robot) for robot in range(len(episode.boards))]
        self.poses[index] = episode.poses
        self.objects[index] = episode.objects
        self._store_metrics(slice(index, index + 1), episode.sums[None])
        if failure is not None:
            self._store_failure(index, seed, episode.steps, failure)

    def store_group(
        self, group: range, seeds: Sequence[int], batch: EpisodeBatch, failures: Mapping[int, DivergedError]
    ) -> None:
        """Store the results of a group, except episodes that were stored before."""
        indices = np.array([index for index in group if index not in self._stored_indices], np.int64)
        if not len(indices):
            return
        slots = indices - group.start
        self.registers[indices], self.poses[indices] = batch.boards[slots], batch.episode_poses[slots]
        self.objects[indices] = batch.objects[slots]
        self._store_metrics(indices, batch.sums[slots])
        for slot, failure in sorted(failures.items()):
            if (index := group[slot]) not in self._stored_indices:
                self._store_failure(index, int(seeds[index]), int(batch.steps[slot]), failure)

    def _store_metrics(self, indices: NDArray[np.int64] | slice, sums: Floats) -> None:
        """Store the metrics of episodes from their sums (n, n_robots, N_SUMS)."""
        for name, values in compute_means(sums).items():
            self.metrics[name][indices] = values

    def _store_failure(self, index: int, seed: int, step: int, failure: DivergedError) -> None:
        self.failures.append(Failure(index, seed, step, str(failure)))
        for values in self.metrics.values():
            values[index] = np.nan

    def result(self) -> RolloutResult:
        """Return all results."""
        failures = tuple(sorted(self.failures, key=lambda failure: failure.index))
        metrics, registers, poses, paths = self.metrics, self.registers, self.poses, self.paths
        if poses.shape[1] == 1:
            metrics = {name: values[:, 0] for name, values in metrics.items()}
            registers, poses, paths = registers[:, 0], poses[:, 0], paths[:, 0]
        return RolloutResult(metrics, registers, poses, self.objects, failures, paths)


def _run_threads(
    pool: ThreadPoolExecutor, episodes: Sequence[Episode], arguments: _RolloutArguments, results: _Results
) -> None:
    """Run episodes in threads, each with one `Episode`; the assignment does not affect the results."""
    indices = iter(range(len(arguments.seeds)))

    def run_episodes(episode: Episode) -> None:
        for index in indices:  # one thread at a time advances the iterator
            failure = None
            try:
                episode.begin(int(arguments.seeds[index]), arguments.options(index))
                if arguments.paths_every is None:
                    episode.run(arguments.seconds)
                for sample in range(arguments.n_samples):
                    if sample:
                        episode.run(cast(float, arguments.paths_every))
                    results.paths[index, :, sample] = episode.poses
            except DivergedError as error:
                failure = error
            results.store(index, int(arguments.seeds[index]), episode, failure)

    try:
        for future in [pool.submit(run_episodes, episode) for episode in episodes]:
            future.result()
    finally:
        # After an interruption, wait only for the episodes that were started.
        for _ in indices:
            pass


def _run_on_gpu(driver: Driver, arguments: _RolloutArguments, results: _Results) -> None:
    """Run episodes on a GPU; the CPU prepares one group while the GPU runs another."""
    from khep_twin.episodes.cuda import card
    from khep_twin.episodes.cuda.card_batch import CardBatch, PreparedEpisode

    group_size, is_interrupted = 2 * card.EPISODES_PER_PROCESSOR * card.n_processors(), Event()

    def run_group(start: int) -> None:
        group = range(start, min(start + group_size, len(arguments.seeds)))
        batch = CardBatch([PreparedEpisode(arguments.setup, driver)] * len(group), driver)
        for _ in _run_group(batch, driver, group, arguments, results):
            if is_interrupted.is_set():
                return

    group_starts = range(0, len(arguments.seeds), group_size)
    if isinstance(driver, Policy):  # its function is called in the caller's thread
        for start in group_starts:
            run_group(start)
        return
    with ThreadPoolExecutor(2) as pool:
        futures = [pool.submit(run_group, start) for start in group_starts]
        try:
            for future in futures:
                future.result()
        finally:
            is_interrupted.set()
            pool.shutdown(cancel_futures=True)


def _run_group(
    batch: EpisodeBatch, driver: Driver, group: range, arguments: _RolloutArguments, results: _Results
) -> Iterator[None]:
    """Run a group (indices of episodes) in the slots of a batch; yield after each period or launch."""
    failures: dict[int, DivergedError] = {}
    batch.last_step = arguments.setup.periods(arguments.seconds) * arguments.setup.steps_per_period
    for slot, index in enumerate(group):
        try:
            batch.begin(slot, int(arguments.seeds[index]), arguments.options(index))
        except DivergedError as error:
            failures[slot] = error
            results.store(index, int(arguments.seeds[index]), batch.slot_episode(slot), error)
    failures |= batch.switch_on()
    steps_per_sample = max(batch.last_step // max(arguments.n_samples - 1, 1), 1)
    launch_steps = max(MAX_LAUNCH_NS // arguments.setup.step_ns, 1)
    while True:
        if arguments.n_samples:
            is_at_sample = batch.steps[: len(group)] % steps_per_sample == 0
            is_at_sample[list(failures)] = False
            if len(slots := np.flatnonzero(is_at_sample)):
                samples = batch.steps[slots] // steps_per_sample
                results.paths[slots + group.start, :, samples] = batch.episode_poses[slots]
        is_active = batch.steps[: len(group)] < batch.last_step
        is_active[list(failures)] = False
        active_slots = np.flatnonzero(is_active)
        if not len(active_slots):
            break
        if isinstance(driver, Policy):
            batch.speeds[active_slots] = _decide_speeds(driver, arguments.setup, batch, active_slots, group)
            failures |= batch.step(active_slots, arguments.setup.steps_per_period)
        else:
            steps = int(batch.steps[active_slots[0]])
            end_step = min(batch.last_step, steps - steps % steps_per_sample + steps_per_sample)
            failures |= batch.step(active_slots, min(end_step - steps, launch_steps))
        yield
    results.store_group(group, arguments.seeds, batch, failures)


def _decide_speeds(
    policy: Policy, setup: EpisodeSetup, batch: EpisodeBatch, slots: NDArray[np.int64], group: range
) -> Floats:
    """Return the speeds and commands that a policy decides on for some slots (n_slots, n_robots, n)."""
    boards, n_outputs = batch.registers[slots].reshape(-1, batch.registers.shape[2]), batch.speeds.shape[2]
    indices = np.repeat(slots + group.start, batch.registers.shape[1])
    proximity, ambient, *terms = (boards[:, slice(*reading)] for reading in readings_of(policy, setup))
    output = policy.decide(proximity, ambient, indices, *terms)
    try:
        speeds = np.asarray(output, np.float64)
    except (TypeError, ValueError) as error:
        raise ValueError(
            f"the policy returned no speeds: {error}; expected an array ({len(indices)}, {n_outputs})"
        ) from error
    if speeds.shape != (shape := (len(indices), n_outputs)):
        raise ValueError(f"the policy returned speeds of shape {speeds.shape}; expected {shape}")
    return speeds.reshape(len(slots), -1, n_outputs)
