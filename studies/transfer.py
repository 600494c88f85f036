"""Transfer between the planar model and MuJoCo: `python -m studies transfer --seconds 60 --seeds 1 2 3`.

Proximal policy optimisation, as in `examples/03_learn_to_avoid.py`, learns each task in the planar model or
in MuJoCo for the same time of one core, and is evaluated in both, in new episodes. Needs stable-baselines3.
"""

import importlib
from typing import Any

import numpy as np

from tools.command_table import command_line

TASKS = ("ObstacleAvoidance", "LoopingMaze", "LightSeeking")
PLACES = {"the plane": True, "MuJoCo": False}
HEAD = (
    "| task | trained in | steps | evaluated in the plane | evaluated in MuJoCo |",
    "|---|---|---|---|---|",
)


def row(example: Any, task: str, place: str, seconds: float, seeds: list[int]) -> str:
    """Return a row of the table: rewards of a control period, mean and standard deviation over episodes."""
    steps: list[int] = []
    rewards: dict[str, list[float]] = {name: [] for name in PLACES}
    for seed in seeds:
        learner, _ = example.learn(seed, seconds, task, PLACES[place], every=None)
        steps.append(learner.num_timesteps)
        for name, planar in PLACES.items():
            episode_rewards, _ = example.evaluate(example.policy(learner), example.EPISODES, task, planar)
            rewards[name] += episode_rewards.tolist()
    cells = [f"{np.mean(values):.3f} ({np.std(values):.3f})" for values in rewards.values()]
    return f"| {task} | {place} | {round(float(np.mean(steps)), -3):.0f} | {' | '.join(cells)} |"


def main() -> None:
    parser = command_line(__doc__)
    parser.add_argument("--seconds", type=float, default=60, help="time of one core for each policy")
    parser.add_argument("--seeds", type=int, nargs="+", default=[1, 2, 3])
    parser.add_argument("--tasks", nargs="+", default=list(TASKS))
    options = parser.parse_args()
    example = importlib.import_module("examples.03_learn_to_avoid")
    example.torch.set_num_threads(1)
    print(*HEAD, sep="\n", flush=True)
    for task in options.tasks:
        for place in PLACES:
            print(row(example, task, place, options.seconds, options.seeds), flush=True)
