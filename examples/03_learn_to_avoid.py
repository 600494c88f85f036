"""A robot learns to avoid obstacles: proximal policy optimisation, a minute on one core.

    .venv/bin/pip install stable-baselines3                             with PyTorch, a large download
    .venv/bin/python examples/03_learn_to_avoid.py out/ppo.png          trains and plots; see also `--help`

The reward of a control period is Floreano and Mondada's, for forward motion: fast, straight and away from
obstacles, 0 to 1. Each episode has another start and randomly varied sensors. stable-baselines3's PPO learns
in 64 environments in the plane, which are stepped together, and is evaluated in new episodes in MuJoCo, next
to the ROM's Braitenberg vehicle. The path of one episode is drawn into out/ppo_way.png, and out/ppo.zip
keeps the policy of the first seed, with which `khep_twin.TaskController` drives a robot.
"""

import argparse
import sys
import time
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

import khep_twin
from khep_twin.board import DEMO_DIVISOR, DEMO_SPEED_PULSES, DEMO_WEIGHTS
from khep_twin.drawing import DrawnPath, save
from khep_twin.drawing import draw as drawing
from khep_twin.envs import TaskSetup
from khep_twin.errors import pip_install

try:
    import torch
    from stable_baselines3 import PPO
    from stable_baselines3.common.callbacks import BaseCallback
    from stable_baselines3.common.vec_env import VecEnv
except ImportError as error:
    needed = pip_install("gymnasium", "stable-baselines3")
    sys.exit(f"{error.name} is not installed; to install what this example needs: {needed}")

TASK = "ObstacleAvoidance"
ENVIRONMENTS = 64
"""Environments that are stepped together in training."""
EVALUATION_SEED = 1_000_000
"""First seed of the evaluation; training draws from other seeds."""
EPISODES, EPISODES_WHILE_LEARNING = 20, 5
TOP_SPEED_PULSES = 20
"""Speed of the action 1 [pulses/10 ms]."""


def make(task, count, planar, **options):
    """Return some environments, stepped together."""
    name = f"khep_twin/{task}-v0"
    return khep_twin.make_vec(name, num_envs=count, vary=True, planar=planar, threads=1, **options)


class Environments(VecEnv):
    """Environments of Gymnasium's vectorized kind, as stable-baselines3 expects them."""

    def __init__(self, task, planar):
        self.inner = make(task, ENVIRONMENTS, planar, autoreset_mode="SameStep")
        super().__init__(ENVIRONMENTS, self.inner.single_observation_space, self.inner.single_action_space)

    def reset(self):
        """Start an episode in each."""
        return self.inner.reset(seed=self._seeds)[0]

    def step_async(self, actions):
        """Take the actions of the next step."""
        self.actions = actions

    def step_wait(self):
        """Advance all by a control period."""
        observations, rewards, terminated, truncated, info = self.inner.step(self.actions)
        dones = terminated | truncated
        infos = [{} for _ in dones]
        for index in np.flatnonzero(dones):
            last = info["final_obs"][index]
            infos[index] = {"terminal_observation": last, "TimeLimit.truncated": not terminated[index]}
        return observations, rewards, dones, infos

    def close(self):
        """Close all."""
        self.inner.close()

    def get_attr(self, name, indices=None):
        """Return an attribute, which all have in common."""
        return [getattr(self.inner, name)] * self.num_envs

    def set_attr(self, name, value, indices=None):
        """Raise an error; PPO needs none of this."""
        raise NotImplementedError

    env_method = set_attr

    def env_is_wrapped(self, wrapper, indices=None):
        """Return False for each environment: it has no wrapper."""
        return [False] * self.num_envs


def vehicle(speed_pulses):
    """Return the ROM's Braitenberg vehicle with this speed without obstacles."""

    def drive(observations):
        counts = (observations[:, :8] + 1) / 2 * 1023
        return (counts @ np.array(DEMO_WEIGHTS) / DEMO_DIVISOR + speed_pulses) / TOP_SPEED_PULSES

    return drive


def policy(learner):
    """Return the actions of a learner, without exploration."""
    return lambda observations: learner.predict(observations, deterministic=True)[0]


def evaluate(drive, episodes, task=TASK, planar=False):
    """Return the mean rewards of a period in new episodes of a minute (episodes,), and the first path."""
    environments = make(task, episodes, planar)
    observations, info = environments.reset(seed=EVALUATION_SEED)
    is_over, step_rewards, path = False, [], []
    while not is_over:
        path.append((info["time"][0], 1000 * info["x"][0], 1000 * info["y"][0]))
        action = np.clip(drive(observations), -1, 1).astype(np.float32)
        observations, rewards, _, truncated, info = environments.step(action)
        step_rewards.append(rewards)
        is_over = truncated.all()
    environments.close()
    return np.mean(step_rewards, axis=0), np.array(path)


class Curve(BaseCallback):
    """Learning curve: time of one core [s] and mean reward in new episodes, every `every` seconds.

    The time is that of the process without the evaluations, so that other programs do not count.
    """

    def __init__(self, seconds, every):
        super().__init__()
        self.points, self.seconds, self.every = [], seconds, every
        self.start_s, self.evaluating = time.process_time(), 0.0

    def elapsed_s(self):
        """Return the time of the process since the start of learning [s]."""
        return time.process_time() - self.start_s - self.evaluating

    def _on_step(self):
        return self.elapsed_s() < self.seconds

    def _on_rollout_start(self):
        if self.every * len(self.points) <= self.elapsed_s() < self.seconds:
            self.add_point()

    def add_point(self):
        """Evaluate the policy, and add a point to the curve."""
        elapsed_s, evaluation_start_s = self.elapsed_s(), time.process_time()
        reward = evaluate(policy(self.model), EPISODES_WHILE_LEARNING)[0].mean()
        self.points.append((elapsed_s, reward))
        self.evaluating += time.process_time() - evaluation_start_s
        print(
            f"{elapsed_s:5.0f} s of one core, {self.num_timesteps:7} steps: reward {reward:.3f}", flush=True
        )


def learn(seed, seconds, task=TASK, planar=True, every=5):
    """Return a trained learner and its curve; with `every` of None, without a curve."""
    curve = Curve(seconds, np.inf if every is None else every)
    learner = PPO(
        "MlpPolicy",
        Environments(task, planar),
        learning_rate=lambda _: 1e-3 * max(1 - curve.elapsed_s() / seconds, 0.0),
        n_steps=64,
        batch_size=256,
        seed=seed,
        device="cpu",
    )
    learner.learn(10**9, callback=curve)
    if every is not None:
        curve.add_point()
    return learner, np.array(curve.points)


def draw(curves, rewards, file):
    """Draw the learning curves and the rewards of the last evaluation."""
    figure = Figure(figsize=(9, 3.6), layout="constrained")
    left, right = figure.subplots(1, 2, width_ratios=(3, 2), sharey=True)
    for seed, curve in curves.items():
        left.plot(*curve.T, ".-", lw=1.5, label=f"PPO in the plane, seed {seed}")
    for (name, values), style in zip(rewards.items(), ("--", ":"), strict=False):
        left.axhline(values.mean(), color="0.3", ls=style, lw=1.2, label=name.replace("\n", " "))
    left.set(xlabel="time of one core [s]", ylabel="mean reward of a period", ylim=(0, 1))
    left.set_title(f"while it learns: {EPISODES_WHILE_LEARNING} new episodes in MuJoCo")
    left.legend(frameon=False, loc="lower right", fontsize=8)
    right.boxplot(list(rewards.values()), tick_labels=list(rewards), widths=0.5)
    right.tick_params(axis="x", labelsize=8)
    right.set_title(f"{EPISODES} new episodes of 60 s in MuJoCo")
    figure.savefig(file, dpi=160)


def draw_path(path, file):
    """Draw the path of the first of the new episodes."""
    seed = int(make(TASK, 1, True).reset(seed=EVALUATION_SEED)[1]["seed"][0])
    playpen = TaskSetup(TASK).start_playpen(seed)
    save(drawing(playpen, [DrawnPath("khepera0", path[:, 0], path[:, 1:])]), file)


def measure(name, drive):
    """Evaluate a driver in many episodes; return the rewards and a path."""
    rewards, path = evaluate(drive, EPISODES)
    label = name.replace("\n", " ")
    print(
        f"{label:20} reward {rewards.mean():.3f} (sd {rewards.std():.3f}) in {EPISODES} new episodes",
        flush=True,
    )
    return rewards, path


def main():
    """Train and draw."""
    parser = argparse.ArgumentParser(description="A robot learns to avoid obstacles.")
    parser.add_argument("picture", type=Path)
    parser.add_argument("--seconds", type=float, default=30, help="time of one core for each seed")
    parser.add_argument("--seeds", type=int, nargs="+", default=[1])
    options = parser.parse_args()
    options.picture.parent.mkdir(parents=True, exist_ok=True)
    torch.set_num_threads(1)
    curves, rewards = {}, {}
    for name, speed in (("ROM's\nvehicle", DEMO_SPEED_PULSES), ("the same,\nfull speed", TOP_SPEED_PULSES)):
        rewards[name], _ = measure(name, vehicle(speed))
    for seed in options.seeds:
        learner, curves[seed] = learn(seed, options.seconds)
        name = f"PPO\nseed {seed}"
        rewards[name], path = measure(name, policy(learner))
        if seed == options.seeds[0]:
            # The schedule of the learning rate belongs to this run.
            learner.save(options.picture.with_suffix(".zip"), exclude=["learning_rate", "lr_schedule"])
            draw_path(path, options.picture.with_name(options.picture.stem + "_way.png"))
    draw(curves, rewards, options.picture)


if __name__ == "__main__":
    main()
