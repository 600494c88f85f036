"""A robot learns to avoid obstacles: proximal policy optimisation, in minutes on two cores.

    .venv/bin/pip install stable-baselines3                             with PyTorch, a large download
    .venv/bin/python examples/03_learn_to_avoid.py out/ppo.png          trains and plots; see also `--steps`

The reward of a control period is Floreano and Mondada's, for forward motion: fast, straight and away from
obstacles, 0 to 1. Each episode has another start and randomly varied sensors. The trained policy is evaluated
on new starts, next to a robot that drives straight on and the robot's own Braitenberg vehicle. The path of
one episode is drawn into out/ppo_way.png, and out/ppo.zip keeps the policy.
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
from khep_twin.envs.task_episode import TaskSetup
from khep_twin.errors import pip_install

try:
    import gymnasium
    import torch
    from gymnasium.wrappers import RescaleAction
    from stable_baselines3 import PPO
    from stable_baselines3.common.callbacks import BaseCallback
    from stable_baselines3.common.env_util import make_vec_env
except ImportError as error:
    needed = pip_install("gymnasium", "stable-baselines3")
    sys.exit(f"{error.name} is not installed; to install what this example needs: {needed}")

import khep_twin.envs.gymnasium  # noqa: F401  (registers the environments)

NAME = "khep_twin/ObstacleAvoidance-v0"
EPISODES = 20


def environment(**options):
    """Make the environment; actions from -1 to 1, as PPO expects, stand for -20 to 20 pulses/10 ms."""
    return RescaleAction(gymnasium.make(NAME, vary=True, **options), np.float32(-1), np.float32(1))


def demonstration(seen):
    """Return the speeds of the robot's own Braitenberg vehicle, as parts of 20 pulses/10 ms."""
    return (np.array(DEMO_WEIGHTS).T @ (seen[:8] * 1023) / DEMO_DIVISOR + DEMO_SPEED_PULSES) / 20


def tried(drive):
    """Return the mean rewards of episodes of a minute (EPISODES,), and the share of time near obstacles."""
    robot, rewards, near = environment(seconds=60.0), [], []
    for episode in range(EPISODES):
        seen, _ = robot.reset(seed=1_000_000 + episode)
        over, sums, close = False, [], []
        while not over:
            seen, reward, ended, late, _ = robot.step(np.clip(drive(seen), -1, 1).astype(np.float32))
            sums.append(reward)
            close.append(seen[:8].max() > 0.9)
            over = ended or late
        rewards.append(np.mean(sums))
        near.append(np.mean(close))
    return np.array(rewards), float(np.mean(near))


class Curve(BaseCallback):
    """Learning curve: for each training episode the steps so far and the mean reward of a period."""

    def __init__(self):
        super().__init__()
        self.points = []

    def _on_step(self):
        for info in self.locals["infos"]:
            if "episode" in info:
                self.points.append((self.num_timesteps, info["episode"]["r"] / info["episode"]["l"]))
        return True


def draw(points, rewards, file):
    """Draw the learning curve, and beside it the rewards of the evaluation."""
    steps, means = np.array(points).T
    figure = Figure(figsize=(7.5, 3.4), layout="constrained")
    left, right = figure.subplots(1, 2, width_ratios=(2, 1), sharey=True)
    left.plot(steps / 1000, means, ".", ms=3, color="0.7", label="an episode of 20 s")
    width = min(32, len(means))
    smooth = np.convolve(means, np.ones(width) / width, "valid")
    left.plot(steps[width - 1 :] / 1000, smooth, lw=1.8, color="C0", label=f"mean of {width}")
    left.set(xlabel="steps of 50 ms [thousands]", ylabel="mean reward of a period", title="while it learns")
    left.legend(frameon=False, loc="lower right")
    right.boxplot(list(rewards.values()), tick_labels=list(rewards), widths=0.5)
    right.set_title(f"{EPISODES} new episodes of 60 s")
    right.tick_params(axis="x", labelrotation=20)
    left.set_ylim(-0.02, 1)
    figure.savefig(file, dpi=160)


def draw_path(drive, file):
    """Draw the path of a new episode of a minute."""
    robot = environment(seconds=60.0)
    seen, info = robot.reset(seed=1_000_000)
    start, path, over = info, [], False
    while not over:
        path.append((info["time"], 1000 * info["x"], 1000 * info["y"]))
        seen, _, ended, late, info = robot.step(np.clip(drive(seen), -1, 1).astype(np.float32))
        over = ended or late
    time_s, *xy_mm = np.array(path).T
    playpen = TaskSetup("ObstacleAvoidance").started(start["seed"])
    save(drawing(playpen, [DrawnPath("khepera0", time_s, np.stack(xy_mm, axis=1))]), file)


options = argparse.ArgumentParser(description="A robot learns to avoid obstacles.")
options.add_argument("picture", type=Path)
options.add_argument("--steps", type=int, default=200_000)
options.add_argument("--seed", type=int, default=1)
given = options.parse_args()

torch.set_num_threads(1)
many = make_vec_env(lambda: environment(seconds=20.0), n_envs=8, seed=given.seed)
learner = PPO("MlpPolicy", many, n_steps=512, batch_size=512, gamma=0.98, seed=given.seed, device="cpu")
curve, begun = Curve(), time.perf_counter()
learner.learn(given.steps, callback=curve)
print(f"learnt for {given.steps} steps in {time.perf_counter() - begun:.0f} s")

drivers = {
    "straight on": lambda seen: np.array([0.5, 0.5]),
    "demonstration": demonstration,
    "learnt": lambda seen: learner.predict(seen, deterministic=True)[0],
}
found = {}
for name, driver in drivers.items():
    found[name], touching = tried(driver)
    mean, sd = found[name].mean(), found[name].std()
    print(f"{name:14} reward {mean:.3f} (sd {sd:.3f}), near something {touching:.0%}")
given.picture.parent.mkdir(parents=True, exist_ok=True)
draw(curve.points, found, given.picture)
draw_path(drivers["learnt"], given.picture.with_name(given.picture.stem + "_way.png"))
learner.save(given.picture.with_suffix(".zip"))
