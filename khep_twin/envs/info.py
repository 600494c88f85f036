"""Contents of `info`, in Gymnasium's form: ground truth, draws, details of a step, and the end.

    always          x, y [m], heading [rad], time [s], seed
    at the start    drawn: values that a `Randomization` has drawn
    with details    reward_parts: parts of the reward by name; contact: whether the robot touches anything
    at the end      with details, too:
                    metrics: those of `khep_twin.episodes.metrics`
                    episode: return "r", length "l" in steps and simulated time "t" [s]

Details are there on request: Gymnasium's `RecordEpisodeStatistics`, whose keys "episode" has, refuses an
environment that has it already, and Minari's `DataCollector` infos whose keys differ from step to step.
"""

import math
from typing import Any

from khep_twin.envs.task_batch import TaskBatch

Info = dict[str, Any]
"""Gymnasium's type of metadata, options and ground truth."""


def ground_truth(batch: TaskBatch, robot: int = 0, row: int = 0) -> Info:
    """Return the ground truth of a robot."""
    x, y, heading = batch.poses[row, robot].tolist()
    return {
        "x": x,
        "y": y,
        "heading": heading,
        "time": float(batch.times[row]),
        "seed": int(batch.seeds[row]),
    }


def of_start(batch: TaskBatch, row: int = 0) -> Info:
    """Return the values drawn for an episode; none without a randomization."""
    drawn = batch.drawn(row)
    return {"drawn": drawn} if drawn else {}


def of_step(batch: TaskBatch, robot: int = 0, row: int = 0) -> Info:
    """Return the details of the last step; nothing unless they are asked for."""
    if not batch.setup.details:
        return {}
    parts = {name: float(part[row, robot]) for name, part in batch.parts.items()}
    return ({"reward_parts": parts} if parts else {}) | {"contact": bool(batch.touches[row, robot])}


def of_end(batch: TaskBatch, robot: int = 0, row: int = 0) -> Info:
    """Return metrics and return of a robot in an episode that is over; nothing unless asked for."""
    if not batch.setup.details:
        return {}
    metrics = batch.episodes[row].metrics(robot)
    length, time_s = int(batch.periods[row]), float(batch.times[row])
    return {
        "metrics": {name: value for name, value in metrics.items() if not math.isnan(value)},
        "episode": {"r": float(batch.returns[row, robot]), "l": length, "t": time_s},
    }
