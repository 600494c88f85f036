"""Batched rollouts: many episodes at once, on all cores.

    from khep_twin import Network, rollout

    network = Network(hidden=(5,), recurrent=True)
    genes = numpy.random.default_rng(0).normal(size=(100, network.n_genes))
    results = rollout("looping-maze", network, range(100), 60.0, genes=genes)
    print(results.metrics["obstacle_avoidance"].max(), results.failures)

Each episode depends on its own seed, genes, start and lamps alone: results are the same, bit for bit, with
any number of threads, and the same as those of a single `Episode` with the same setup. Only the results grow
with the number of episodes: every thread has memory for one episode and reuses it. With `device="cuda"` an
NVIDIA card runs episodes in the plane (`cuda`).
"""

from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from dataclasses import dataclass, replace
from threading import Event
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from khep_twin.board.kernel import AMBIENT, N_REGISTERS, PROXIMITY
from khep_twin.episodes.controllers import Driver, Floats, Network, Policy
from khep_twin.episodes.device import Device, chosen_device
from khep_twin.episodes.episode import Episode, is_compiled
from khep_twin.episodes.episode_batch import EpisodeBatch
from khep_twin.episodes.episode_options import (
    DEFAULT_OPTIONS,
    EpisodeOptions,
    check_numbers,
    checked_count,
)
from khep_twin.episodes.episode_setup import EpisodeSetup
from khep_twin.episodes.line import LineTimes
from khep_twin.episodes.metrics import METRICS, means_of
from khep_twin.errors import DivergedError
from khep_twin.machine import n_cores
from khep_twin.playpen import Lamp, PlaypenLike
from khep_twin.playpen.starts import Start
from khep_twin.simulation.mujoco_forms import movable_names
from khep_twin.units import SCAN_NS

BATCH_SIZE = 64
"""Episodes in one call of a policy: enough for arrays to pay, at a bounded use of memory."""

CARD_SPAN_NS = 10_000_000_000
"""Longest simulated time of one launch on a card [ns]: a card that shows a desktop ends longer ones."""


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
        paths: Poses x, y [m] and heading [rad] from the start on, each `paths_every` [s], NaN after a failure
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
        playpen: Playpen, its name or path, or an `EpisodeSetup` with its step, period, plane
            and faults.
        driver: Controller of all episodes.
        seeds: Seeds of the episodes (n,).
        seconds: Duration of each episode [s], whole control periods.
        genes: Genes of each episode's controllers (n, n_genes), or of each robot's (n, n_robots, n_genes).
        starts: Start poses x, y [mm] and heading [deg] of each episode (n, 3), or of each robot
            (n, n_robots, 3); by default the playpen's.
        lamps: Lamps of each episode; by default the playpen's.
        line: Line between controllers and robots, as a speed [baud] or a `MeasuredCycle`; by default that of
            the options, where exchanges take no time.
        options: Options of all episodes, but for those that each is given its own of.
        paths_every: Time between the poses of the result's paths [s], a part of `seconds` and whole control
            periods; None for no paths.
        planar: Whether a playpen that is no setup is simulated in the plane.
        device: "cpu"; "cuda" for an NVIDIA card, in the plane; or "auto" for a card if there is one that can
            run these episodes, and they fill it.
        threads: Number of threads; by default one per core. Uncompiled episodes use one.
        compiled: Whether to run compiled; None if numba is installed. The first time this waits for
            numba, for some ten seconds.

    Raises:
        ValueError: The number of genes, starts or lamps is not that of the seeds, or a value is out of range.
        DeviceError: There is no card that can run the episodes.
        ControllerError: Genes do not fit the controller, or numba cannot compile it.
        PlaypenError: The playpen has a feature that episodes without a serial line do not support.
    """
    period_ns = driver.period_ns if isinstance(driver, Network) else SCAN_NS
    setup = playpen
    if not isinstance(setup, EpisodeSetup):
        at_line = planar and (line or options.line) is not None
        setup = EpisodeSetup(setup, period_ns=period_ns, planar=planar, at_line=at_line)
    elif planar and setup.planar_scene is None:
        raise ValueError("planar = True: and a setup in MuJoCo; expected EpisodeSetup(..., planar=True)")
    count = len(seeds)
    n_robots = len(setup.playpen.robots)
    most = n_cores() if threads is None else checked_count(threads, "threads")
    common = options if line is None else replace(options, line=line)
    batch = _Batch(setup, seeds, seconds, common, genes, starts, lamps, paths_every)
    batch.check(driver)
    on_card = chosen_device(device, setup, driver, common.line, count, lamps) == "cuda"
    results = _Results(count, n_robots, len(movable_names(setup.playpen)), batch.n_samples)
    fast = on_card or is_compiled(compiled)
    workers = most if fast else 1
    if on_card:
        _run_on_card(driver, batch, results)
        return results.result()
    room = min(BATCH_SIZE if isinstance(driver, Policy) else workers, count)
    episodes = [Episode(setup, driver, compiled=fast) for _ in range(room)]
    if isinstance(driver, Policy) and count:
        with closing(EpisodeBatch(episodes, min(workers, room))) as lanes:
            for first in range(0, count, BATCH_SIZE):
                group = range(first, min(first + BATCH_SIZE, count))
                for _ in _run_together(lanes, driver, group, batch, results):
                    pass
    else:
        with ThreadPoolExecutor(workers) as pool:
            _share_out(pool, episodes, batch, results)
    return results.result()


@dataclass(frozen=True, slots=True)
class _Batch:
    """Arguments of `rollout` for each episode."""

    setup: EpisodeSetup
    seeds: Sequence[int] | range
    seconds: float
    common: EpisodeOptions
    genes: Floats | None
    starts: Sequence[Start] | None
    lamps: Sequence[Sequence[Lamp]] | None
    every: float | None

    @property
    def n_samples(self) -> int:
        """Number of poses of a path; 0 for no paths."""
        if self.every is None:
            return 0
        return 1 + self.setup.periods(self.seconds) // max(self.setup.periods(self.every), 1)

    def check(self, driver: Driver) -> None:
        """Raise a `ValueError` unless there is what each episode needs."""
        if (every := self.every) is not None:
            periods = self.setup.periods(every)
            if not periods or self.setup.periods(self.seconds) % periods:
                raise ValueError(f"paths_every = {every:g}; expected a part of the {self.seconds:g} s")
            if isinstance(driver, Policy) and self.common.line is not None:
                raise ValueError(
                    f"paths_every = {every:g}: a policy at a line is asked at uneven times; expected no line"
                )
        count, n_robots = len(self.seeds), len(self.setup.playpen.robots)
        for name, given in (("genes", self.genes), ("starts", self.starts), ("lamps", self.lamps)):
            if given is not None and len(given) != count:
                raise ValueError(f"{len(given)} {name} for {count} seeds; expected {count}")
        own = len(self.common.genes) or (isinstance(driver, Network) and len(driver.genes))
        if isinstance(driver, Network) and self.genes is None and not own:
            raise ValueError(f"no genes for {driver}; expected shape ({count}, {driver.n_genes})")
        weights = np.zeros((0, 0)) if self.genes is None else np.asarray(self.genes, np.float64)
        if weights.ndim not in (2, 3) or not np.isfinite(weights).all():
            raise ValueError(f"genes of shape {weights.shape}; expected finite numbers (n, n_genes)")
        for index, start in enumerate(self.starts if self.starts is not None else ()):
            shape = (3,) if n_robots == 1 else (n_robots, 3)
            check_numbers(f"starts[{index}]", start, "x, y [mm] and heading [deg]", shape)
        for index, each in enumerate(self.lamps if self.lamps is not None else ()):
            if isinstance(each, Lamp):
                raise ValueError(f"lamps[{index}] is one lamp; expected a list of lamps for each episode")

    def options(self, index: int) -> EpisodeOptions:
        """Return the options of an episode of the batch."""
        own = (("genes", self.genes), ("start", self.starts), ("lamps", self.lamps))
        given: dict[str, Any] = {name: values[index] for name, values in own if values is not None}
        return replace(self.common, **given)


class _Results:
    """Results collected from each episode."""

    def __init__(self, count: int, n_robots: int, n_objects: int, n_samples: int) -> None:
        self.metrics = {name: np.full((count, n_robots), np.nan) for name in METRICS}
        self.registers = np.zeros((count, n_robots, N_REGISTERS), np.int64)
        self.poses = np.zeros((count, n_robots, 3))
        self.objects = np.zeros((count, n_objects, 3))
        self.paths = np.full((count, n_robots, n_samples, 3), np.nan)
        self.failures: list[Failure] = []
        self._kept: set[int] = set()

    def keep(self, index: int, seed: int, episode: Episode, failure: DivergedError | None) -> None:
        """Store the results of an episode that has ended, or has not begun."""
        self._kept.add(index)
        self.registers[index], self.poses[index] = episode.boards, episode.poses
        self.objects[index] = episode.objects
        self._rate(slice(index, index + 1), episode.sums[None])
        if failure is not None:
            self._fail(index, seed, episode.steps, failure)

    def keep_group(
        self, group: range, seeds: Sequence[int], lanes: EpisodeBatch, failures: Mapping[int, DivergedError]
    ) -> None:
        """Store the results of episodes side by side that have begun, all but those in `kept`."""
        lane = np.array([lane for lane, index in enumerate(group) if index not in self._kept], np.int64)
        if not len(lane):
            return
        rows = lane + group.start
        self.registers[rows], self.poses[rows] = lanes.boards[lane], lanes.joint_poses[lane]
        self.objects[rows] = lanes.objects[lane]
        self._rate(rows, lanes.sums[lane])
        for failed, failure in sorted(failures.items()):
            if (index := group[failed]) not in self._kept:
                self._fail(index, int(seeds[index]), int(lanes.steps[failed]), failure)

    def _rate(self, rows: NDArray[np.int64] | slice, sums: Floats) -> None:
        """Store the metrics of episodes, of their sums (n, n_robots, N_SUMS)."""
        for name, values in means_of(sums).items():
            self.metrics[name][rows] = values

    def _fail(self, index: int, seed: int, step: int, failure: DivergedError) -> None:
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


def _share_out(
    pool: ThreadPoolExecutor, episodes: Sequence[Episode], batch: _Batch, results: _Results
) -> None:
    """Run the next episode on each free room; the assignment makes no difference."""
    turns = iter(range(len(batch.seeds)))

    def work(episode: Episode) -> None:
        for index in turns:  # one thread at a time gets the next one
            failure = None
            try:
                episode.begin(int(batch.seeds[index]), batch.options(index))
                if batch.every is None:
                    episode.run(batch.seconds)
                for sample in range(batch.n_samples):
                    if sample:
                        episode.run(cast(float, batch.every))
                    results.paths[index, :, sample] = episode.poses
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


def _run_on_card(driver: Driver, batch: _Batch, results: _Results) -> None:
    """Run episodes on a card; the CPU prepares a group of them while the card runs another one."""
    from khep_twin.episodes.cuda import card
    from khep_twin.episodes.cuda.card_batch import CardBatch, PreparedEpisode

    size, interrupted = 2 * card.FILLING * card.n_processors(), Event()

    def work(first: int) -> None:
        group = range(first, min(first + size, len(batch.seeds)))
        lanes = CardBatch([PreparedEpisode(batch.setup, driver)] * len(group), driver)
        for _ in _run_together(lanes, driver, group, batch, results):
            if interrupted.is_set():
                return

    firsts = range(0, len(batch.seeds), size)
    if isinstance(driver, Policy):  # which is called in the caller's thread
        for first in firsts:
            work(first)
        return
    with ThreadPoolExecutor(2) as pool:
        groups = [pool.submit(work, first) for first in firsts]
        try:
            for done in groups:
                done.result()
        finally:
            interrupted.set()
            pool.shutdown(cancel_futures=True)


def _run_together(
    lanes: EpisodeBatch, driver: Driver, group: range, batch: _Batch, results: _Results
) -> Iterator[None]:
    """Run episodes side by side, a policy's by one control period at a time; yield after each part."""
    failures: dict[int, DivergedError] = {}
    lanes.last_step = batch.setup.periods(batch.seconds) * batch.setup.steps_per_period
    for lane, index in enumerate(group):
        try:
            lanes.begin(lane, int(batch.seeds[index]), batch.options(index))
        except DivergedError as error:
            failures[lane] = error
            results.keep(index, int(batch.seeds[index]), lanes.memory(lane), error)
    failures |= lanes.switch_on()
    steps_per_sample = max(lanes.last_step // max(batch.n_samples - 1, 1), 1)
    span = max(CARD_SPAN_NS // batch.setup.step_ns, 1)
    while True:
        if batch.n_samples:
            due = lanes.steps[: len(group)] % steps_per_sample == 0
            due[list(failures)] = False
            if len(lane := np.flatnonzero(due)):
                sample = lanes.steps[lane] // steps_per_sample
                results.paths[lane + group.start, :, sample] = lanes.joint_poses[lane]
        going = lanes.steps[: len(group)] < lanes.last_step
        going[list(failures)] = False
        living = np.flatnonzero(going)
        if not len(living):
            break
        if isinstance(driver, Policy):
            lanes.speeds[living] = _decided(driver, lanes, living, group)
            failures |= lanes.step(living, batch.setup.steps_per_period)
        else:
            done = int(lanes.steps[living[0]])
            left = min(lanes.last_step, done - done % steps_per_sample + steps_per_sample) - done
            failures |= lanes.step(living, min(left, span))
        yield
    results.keep_group(group, batch.seeds, lanes, failures)


def _decided(policy: Policy, lanes: EpisodeBatch, living: NDArray[np.int64], group: range) -> Floats:
    """Return the speeds that a policy decides on for some episodes (n_living, n_robots, 2)."""
    board = lanes.registers[living].reshape(-1, N_REGISTERS)
    which = np.repeat(living + group.start, lanes.registers.shape[1])
    decided = policy.decide(board[:, PROXIMITY], board[:, AMBIENT], which)
    try:
        speeds = np.asarray(decided, np.float64)
    except (TypeError, ValueError) as error:
        raise ValueError(
            f"the policy returned no speeds: {error}; expected an array ({len(which)}, 2)"
        ) from error
    if speeds.shape != (len(which), 2):
        raise ValueError(f"the policy returned speeds of shape {speeds.shape}; expected ({len(which)}, 2)")
    return speeds.reshape(len(living), -1, 2)
