"""Contents of `info`, in Gymnasium's form.

    always          x, y [m], heading [rad], time [s], seed: the ground truth
    at the start    drawn: values drawn by a `Randomization`
    with details    reward_parts: parts of the reward by name; contact: whether the robot touches anything
                    at the end also:
                    metrics: those of `khep_twin.episodes.metrics`
                    episode: return "r", length "l" in steps and simulated time "t" [s]

Details are optional, as some wrappers refuse them: Gymnasium's `RecordEpisodeStatistics` refuses the key
"episode", which it adds itself, and Minari's `DataCollector` refuses infos whose keys change between steps.
"""

import math
from typing import Any

from khep_twin.envs.task_batch import TaskBatch

Info = dict[str, Any]
"""Gymnasium's type of metadata, options and ground truth."""


def ground_truth(batch: TaskBatch, robot: int = 0, row: int = 0) -> Info:
    """Return the ground truth of a robot in episode `row` of a batch."""
    x, y, heading = batch.poses[row, robot].tolist()
    time_s, seed = float(batch.times[row]), int(batch.seeds[row])
    return {"x": x, "y": y, "heading": heading, "time": time_s, "seed": seed}


def start_info(batch: TaskBatch, row: int = 0) -> Info:
    """Return the values drawn for an episode; empty without a randomization."""
    drawn = batch.drawn(row)
    return {"drawn": drawn} if drawn else {}


def step_info(batch: TaskBatch, robot: int = 0, row: int = 0) -> Info:
    """Return the details of the last step; empty without `details`."""
    if not batch.setup.details:
        return {}
    parts = {name: float(part[row, robot]) for name, part in batch.parts.items()}
    return ({"reward_parts": parts} if parts else {}) | {"contact": bool(batch.contacts[row, robot])}


def end_info(batch: TaskBatch, robot: int = 0, row: int = 0) -> Info:
    """Return a robot's metrics and return in a finished episode; empty without `details`."""
    if not batch.setup.details:
        return {}
    metrics = batch.episodes[row].metrics(robot)
    length, time_s = int(batch.periods[row]), float(batch.times[row])
    return {
        "metrics": {name: value for name, value in metrics.items() if not math.isnan(value)},
        "episode": {"r": float(batch.returns[row, robot]), "l": length, "t": time_s},
    }
