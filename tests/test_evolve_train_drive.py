"""docs/evolve_train_drive.md: its programs for stable-baselines3 use this package as it is.

stable-baselines3 needs PyTorch, which the tests do without; here a model that learns nothing takes its place.
"""

import re
import sys
from pathlib import Path
from types import ModuleType
from typing import Any, Self

import gymnasium
import numpy as np
import pytest

from khep_twin import Khepera, Network, TaskController
from khep_twin.episodes import networks

PAGE = Path(__file__).parents[1] / "docs" / "evolve_train_drive.md"
PROGRAMS = dict(re.findall(r"<!-- file: (\w+\.py) -->\n\n```python\n(.*?)```", PAGE.read_text(), re.DOTALL))


class Model:
    """A model that drives straight on."""

    def __init__(self, policy: str, environments: list[gymnasium.Env[Any, Any]], **options: object) -> None:
        self.environments = environments
        self.observation_space = environments[0].observation_space
        self.action_space = environments[0].action_space

    def learn(self, steps: int) -> None:
        for environment in self.environments:
            environment.reset(seed=1)
            environment.step(self.action_space.sample())

    def save(self, path: str) -> None:
        Path(path).touch()

    @classmethod
    def load(cls, path: str, device: str) -> Self:
        assert Path(path).exists()
        return cls("", make_vec_env("khep_twin/ObstacleAvoidance-v0", 1))

    def predict(self, observation: object, *, deterministic: bool) -> tuple[Any, None]:
        return np.full(2, 0.5), None


def make_vec_env(
    name: str, count: int, seed: int | None = None, env_kwargs: dict[str, Any] | None = None
) -> list[gymnasium.Env[Any, Any]]:
    return [gymnasium.make(name, **(env_kwargs or {})) for _ in range(count)]


def test_what_is_trained_keeps_its_period_on_the_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    common = "stable_baselines3.common"
    for name in ("torch", "stable_baselines3", common, f"{common}.env_util"):
        monkeypatch.setitem(sys.modules, name, ModuleType(name))
    for module, name, stand_in in (
        ("torch", "set_num_threads", lambda count: None),
        ("stable_baselines3", "PPO", Model),
        (f"{common}.env_util", "make_vec_env", make_vec_env),
    ):
        monkeypatch.setattr(sys.modules[module], name, stand_in, raising=False)
    monkeypatch.chdir(tmp_path)
    names: dict[str, Any] = {}
    for name in ("learn.py", "avoid.py"):
        exec(compile(PROGRAMS[name], name, "exec"), names)
    controller = names["controller"]
    assert isinstance(controller, TaskController)
    with Khepera("khep://obstacles?mode=3", baudrate=38400) as robot:
        controller.start(robot)
        start_s = robot.time
        controller.cycle(robot)
        assert robot.time - start_s == pytest.approx(0.05)


def test_the_actor_of_a_policy_is_a_network() -> None:
    names: dict[str, Any] = {}
    exec(compile(PROGRAMS["network_of.py"], "network_of.py", "exec"), names)
    rng, sizes = np.random.default_rng(1), (8, 5, 4, 2)
    layers = [
        (rng.normal(size=size), rng.normal(size=size[0])) for size in zip(sizes[1:], sizes, strict=False)
    ]
    network = names["network_of"](layers, period_ns=50_000_000)
    assert isinstance(network, Network)
    assert network.sizes == sizes
    inputs = rng.uniform(size=8)
    values = [*inputs, *[0.0] * 11]
    first = networks.forward(network.sizes, False, network.genes, [], values)
    expected = 2 * inputs - 1  # the observation
    for weights, biases in layers:
        expected = np.tanh(weights @ expected + biases)
    assert values[first:] == pytest.approx(expected)
