"""A robot learns to avoid obstacles: proximal policy optimisation, three minutes on one core.

    .venv/bin/pip install stable-baselines3                             with PyTorch, a large download
    .venv/bin/python examples/03_learn_to_avoid.py out/ppo.png          trains and plots; see also `--help`

The reward of a control period is Floreano and Mondada's, for forward motion: fast, straight and away from
obstacles, 0 to 1. Each episode has another start and randomly varied sensors. stable-baselines3's PPO learns
with its defaults; it is evaluated in new episodes, next to the robot's own Braitenberg vehicle. The path of
one episode is drawn into out/ppo_way.png, and out/ppo.zip keeps the policy of the first seed.
"""

import argparse
import sys
import time
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from khep_twin.board.kernel import DEMO_DIVISOR, DEMO_SPEED_PULSES, DEMO_WEIGHTS
from khep_twin.drawing.map import DrawnPath, save
from khep_twin.drawing.map import draw as drawing
from khep_twin.envs.task_setup import TaskSetup
from khep_twin.errors import pip_install

try:
    import gymnasium
    import torch
    from stable_baselines3 import PPO
    from stable_baselines3.common.callbacks import BaseCallback
except ImportError as error:
    needed = pip_install("gymnasium", "stable-baselines3")
    sys.exit(f"{error.name} is not installed; to install what this example needs: {needed}")

import khep_twin.envs.gymnasium  # noqa: F401  (registers the environments)

NAME = "khep_twin/ObstacleAvoidance-v0"
UNSEEN = 1_000_000
"""First seed of the evaluation; training draws its seeds from its own."""
EPISODES, EPISODES_WHILE_LEARNING = 20, 5
TOP_SPEED_PULSES = 20
"""Speed of the action 1 [pulses/10 ms]."""


def vehicle(speed_pulses):
    """Return the robot's own Braitenberg vehicle with this speed on a free way."""

    def drive(seen):
        counts = (seen[:8] + 1) / 2 * 1023
        return (np.array(DEMO_WEIGHTS).T @ counts / DEMO_DIVISOR + speed_pulses) / TOP_SPEED_PULSES

    return drive


def policy(learner):
    """Return the actions of a learner, without exploration."""
    return lambda seen: learner.predict(seen, deterministic=True)[0]


def evaluate(drive, episodes):
    """Return the mean rewards of a period in new episodes of a minute (episodes,), and the first path."""
    environment, rewards, path = gymnasium.make(NAME, vary=True), [], []
    for episode in range(episodes):
        seen, info = environment.reset(seed=UNSEEN + episode)
        over, earned = False, []
        while not over:
            if not episode:
                path.append((info["time"], 1000 * info["x"], 1000 * info["y"]))
            action = np.clip(drive(seen), -1, 1).astype(np.float32)
            seen, reward, terminated, truncated, info = environment.step(action)
            earned.append(reward)
            over = terminated or truncated
        rewards.append(np.mean(earned))
    return np.array(rewards), np.array(path)


class Curve(BaseCallback):
    """Learning curve: time of one core [s] and mean reward in new episodes, at every `every` seconds.

    The time is that of the process without the evaluations, so that other programs do not count.
    """

    def __init__(self, seconds, every=15):
        super().__init__()
        self.points, self.seconds, self.every = [], seconds, every
        self.begun, self.evaluating = time.process_time(), 0.0

    def spent(self):
        """Return the time of the process since learning began [s]."""
        return time.process_time() - self.begun - self.evaluating

    def _on_step(self):
        return self.spent() < self.seconds

    def _on_rollout_start(self):
        if self.every * len(self.points) <= self.spent() < self.seconds:
            self.keep()

    def keep(self):
        """Evaluate the policy."""
        spent, begun = self.spent(), time.process_time()
        reward = evaluate(policy(self.model), EPISODES_WHILE_LEARNING)[0].mean()
        self.points.append((spent, reward))
        self.evaluating += time.process_time() - begun
        print(f"{spent:5.0f} s of one core, {self.num_timesteps:7} steps: reward {reward:.3f}", flush=True)


def learn(seed, seconds):
    """Return a trained learner and its curve."""
    environment = gymnasium.make(NAME, vary=True)
    learner = PPO("MlpPolicy", environment, seed=seed, device="cpu")
    curve = Curve(seconds)
    learner.learn(10**9, callback=curve)
    curve.keep()
    return learner, np.array(curve.points)


def draw(curves, rewards, file):
    """Draw the learning curves, and beside them the rewards of the last evaluation."""
    figure = Figure(figsize=(9, 3.6), layout="constrained")
    left, right = figure.subplots(1, 2, width_ratios=(3, 2), sharey=True)
    for seed, curve in curves.items():
        left.plot(*curve.T, ".-", lw=1.5, label=f"PPO's defaults, seed {seed}")
    for (name, values), style in zip(rewards.items(), ("--", ":"), strict=False):
        left.axhline(values.mean(), color="0.3", ls=style, lw=1.2, label=name.replace("\n", " "))
    left.set(xlabel="time of one core [s]", ylabel="mean reward of a period", ylim=(0, 1))
    left.set_title(f"while it learns: {EPISODES_WHILE_LEARNING} new episodes")
    left.legend(frameon=False, loc="lower right", fontsize=8)
    right.boxplot(list(rewards.values()), tick_labels=list(rewards), widths=0.5)
    right.tick_params(axis="x", labelsize=8)
    right.set_title(f"{EPISODES} new episodes of 60 s")
    figure.savefig(file, dpi=160)


def draw_path(path, file):
    """Draw the path of the first of the new episodes."""
    seed = gymnasium.make(NAME).reset(seed=UNSEEN)[1]["seed"]
    playpen = TaskSetup("ObstacleAvoidance").started(seed)
    save(drawing(playpen, [DrawnPath("khepera0", path[:, 0], path[:, 1:])]), file)


def measure(name, drive):
    """Evaluate a driver at length; return the rewards and a path."""
    rewards, path = evaluate(drive, EPISODES)
    told = name.replace("\n", " ")
    print(
        f"{told:20} reward {rewards.mean():.3f} (sd {rewards.std():.3f}) in {EPISODES} new episodes",
        flush=True,
    )
    return rewards, path


options = argparse.ArgumentParser(description="A robot learns to avoid obstacles.")
options.add_argument("picture", type=Path)
options.add_argument("--seconds", type=float, default=180, help="time of one core for each seed")
options.add_argument("--seeds", type=int, nargs="+", default=[1])
given = options.parse_args()
given.picture.parent.mkdir(parents=True, exist_ok=True)

torch.set_num_threads(1)
curves, rewards = {}, {}
for name, speed in (("ROM's\nvehicle", DEMO_SPEED_PULSES), ("the same,\nfull speed", TOP_SPEED_PULSES)):
    rewards[name], _ = measure(name, vehicle(speed))
for seed in given.seeds:
    learner, curves[seed] = learn(seed, given.seconds)
    name = f"PPO\nseed {seed}"
    rewards[name], path = measure(name, policy(learner))
    if seed == given.seeds[0]:
        learner.save(given.picture.with_suffix(".zip"))
        draw_path(path, given.picture.with_name(given.picture.stem + "_way.png"))
draw(curves, rewards, given.picture)
