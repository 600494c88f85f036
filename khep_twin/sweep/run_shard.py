"""Runs a task's episodes, and returns their results as columns."""

from collections.abc import Mapping
from functools import lru_cache

import numpy as np

from khep_twin import playpen
from khep_twin.episodes.batch import RolloutResult, rollout
from khep_twin.episodes.controllers import Floats
from khep_twin.episodes.episode_options import EpisodeOptions
from khep_twin.episodes.episode_setup import EpisodeSetup
from khep_twin.errors import ControllerError, exception_text
from khep_twin.lab.experiment import start_poses
from khep_twin.playpen.starts import Start
from khep_twin.process.signals import is_interruption
from khep_twin.sweep.programs import Program, driver_of, function_of
from khep_twin.sweep.shards import Shard, Work
from khep_twin.sweep.study import NS_PER_MS

Columns = Mapping[str, object]
"""Values of each episode by column name; None or NaN for no value."""


def run_shard(work: Work, task: Shard, threads: int | None = 1) -> Columns:
    """Run a task; return one row per episode, in order.

    The results do not depend on the number of threads; None stands for one per core.
    """
    study, group = work.study, work.groups[task.group]
    point = group.point
    controller = work.controllers[group.controller]
    setup = _make_setup(
        work.playpens[group.playpen],
        point.lighting,
        point.planar,
        point.line_baud > 0,
        point.step_ms,
        point.period_ms,
    )
    indices = np.arange(task.first - group.first, task.first - group.first + task.count)
    combinations, seeds = np.divmod(indices, study.seeds)
    genome_indices, start_indices = np.divmod(combinations, len(group.starts))
    seeds += study.first_seed
    # np.divmod is typed for single numbers only.
    start_names: list[str] = [group.starts[index] for index in start_indices.tolist()]  # pyright: ignore
    starts = [_start_pose(setup, name, seed) for name, seed in zip(start_names, seeds.tolist(), strict=True)]
    home = study.home
    results = rollout(
        setup,
        driver_of(controller.driver),
        seeds.tolist(),
        point.seconds,
        genes=controller.genomes[genome_indices],
        starts=starts,
        line=point.line_baud or None,
        options=EpisodeOptions(
            noise=point.noise,
            vary=point.vary,
            home=None if home is None else (home.x_mm, home.y_mm, home.radius_mm, home.charge_s),
        ),
        device=study.device,
        threads=threads,
    )
    failures = {failure.index: failure for failure in results.failures}
    count = task.count
    return {
        "episode": np.arange(task.first, task.first + count),
        "playpen": [study.playpens[group.playpen]] * count,
        "controller": [controller.name] * count,
        "genome": genome_indices,
        "seed": seeds,
        **{name: [value] * count for name, value in point._asdict().items()},
        "start": start_names,
        "start_x_mm": np.array([start[0] for start in starts], np.float64),
        "start_y_mm": np.array([start[1] for start in starts], np.float64),
        "start_heading_deg": np.array([start[2] for start in starts], np.float64),
        **{name: results.metrics[name] for name in study.fitness},
        **{name: evaluate(measure, results) for name, measure in work.measures},
        "end_x_m": results.poses[:, 0],
        "end_y_m": results.poses[:, 1],
        "end_heading_rad": results.poses[:, 2],
        "failed_step": [failures[i].step if i in failures else None for i in range(count)],
        "failure": [failures[i].reason if i in failures else None for i in range(count)],
    }


def evaluate(measure: Program, results: RolloutResult) -> Floats:
    """Return the values of a user's function for each episode (n,); NaN for those that failed.

    The function takes an episode's metrics by name, its board's registers (N_REGISTERS,) and its final pose
    x, y [m] and heading [rad], and runs in pure Python.
    """
    function = function_of(measure)
    column = np.full(len(results.poses), np.nan)
    failed_indices = {failure.index for failure in results.failures}
    for index in range(len(column)):
        if index in failed_indices:
            continue
        metrics = {name: float(values[index]) for name, values in results.metrics.items()}
        registers, pose = results.registers[index].copy(), tuple(results.poses[index].tolist())
        try:
            column[index] = float(function(metrics, registers, pose))
        except BaseException as error:  # the user's own function may raise anything
            if is_interruption(error):
                raise
            location = f"{measure.file}:{measure.function}"
            raise ControllerError(f"{location}: {exception_text(error)}") from error
    return column


def _start_pose(setup: EpisodeSetup, name: str, seed: int) -> Start:
    if name == "playpen":
        return setup.start(seed)
    return start_poses.starts([name], setup.playpen, 0, 1, seed)[0]


@lru_cache(maxsize=4)
def _make_setup(
    playpen_toml: str, lighting: str, planar: bool, at_line: bool, step_ms: float, period_ms: int
) -> EpisodeSetup:
    override = "off" if lighting == "off" else None
    study_playpen = start_poses.with_lighting(playpen.parse(playpen_toml, "a study's playpen"), override)
    step_ns, period_ns = round(step_ms * NS_PER_MS), period_ms * NS_PER_MS
    return EpisodeSetup(study_playpen, step_ns=step_ns, period_ns=period_ns, planar=planar, at_line=at_line)
