"""Episodes of a Gymnasium environment under a policy, for a dataset.

    environment = gymnasium.make("khep_twin/ObstacleAvoidance-v0", vary=True)
    episodes = rollouts(environment, policy, seeds=range(100))
    write_dataset(Path("out/datasets"), "khepera/policy-v0", episodes, environment.spec)

`minari.DataCollector` does the same with JAX.
"""

# Gymnasium is only partly typed.
# pyright: reportMissingTypeStubs=false, reportUnknownMemberType=false

from collections.abc import Callable, Iterable, Iterator
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from khep_twin.envs.gymnasium import Info
from khep_twin.envs.tasks import Observation
from khep_twin.errors import MissingExtraError
from khep_twin.lab.dataset.episodes import OfflineEpisode

try:
    from gymnasium import Env
except ModuleNotFoundError as error:
    raise MissingExtraError("gymnasium", "rl") from error

Policy = Callable[[Observation], ArrayLike]
"""Function that returns the action (2,) for an observation (m,)."""


def rollouts(
    environment: Env[Observation, NDArray[np.float32]], policy: Policy, seeds: Iterable[int]
) -> Iterator[OfflineEpisode]:
    """Run and yield an episode of each seed.

    Args:
        environment: Environment of one robot.
        policy: Function that returns the action for an observation.
        seeds: Seed of each episode's reset.
    """
    for seed in seeds:
        observation, info = environment.reset(seed=seed)
        observations, infos, steps = [observation], [info], list[tuple[Any, float, bool, bool]]()
        while not steps or not (steps[-1][2] or steps[-1][3]):
            action = np.asarray(policy(observation), np.float32)
            observation, reward, terminated, truncated, info = environment.step(action)
            observations.append(observation)
            infos.append(info)
            steps.append((action, float(reward), terminated, truncated))
        actions, rewards, terminations, truncations = zip(*steps, strict=True)
        yield OfflineEpisode(
            np.stack(observations),
            np.stack(actions),
            np.array(rewards),
            np.array(terminations),
            np.array(truncations),
            _columns(infos),
            {},
            seed,
        )


def _columns(infos: list[Info]) -> dict[str, NDArray[np.float64]]:
    """Return the infos of an episode by name, without the seed."""
    return {name: np.array([info[name] for info in infos]) for name in infos[0] if name != "seed"}
