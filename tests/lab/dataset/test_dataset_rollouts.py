"""Rollouts for a dataset: what the environment returned, under a policy."""

import numpy as np
import pytest

from khep_twin.envs.tasks import Observation

SHORT = {"seconds": 0.5, "compiled": False}


def test_a_rollout_has_what_the_environment_returned() -> None:
    pytest.importorskip("gymnasium", reason="gymnasium, the extra [rl], is not installed")
    from khep_twin.envs.gymnasium import KheperaEnvironment
    from khep_twin.lab.dataset.rollouts import rollouts

    def policy(observation: Observation) -> list[float]:
        return [0.5, float(observation[0])]

    first, second = rollouts(KheperaEnvironment("Homing", **SHORT), policy, seeds=[4, 5])
    environment = KheperaEnvironment("Homing", **SHORT)
    observation, info = environment.reset(seed=5)
    for step in range(10):
        assert second.observations[step].tolist() == observation.tolist()
        assert second.infos["heading"][step] == info["heading"]
        action = np.asarray(policy(observation), np.float32)
        assert second.actions[step].tolist() == action.tolist()
        observation, reward, terminated, truncated, info = environment.step(action)
        assert second.rewards[step] == reward
        assert (second.terminations[step], second.truncations[step]) == (terminated, truncated)
    assert second.truncations[-1]
    assert second.seed == 5
    assert second.observations.shape == (11, len(environment.labels))
    assert first.observations.tolist() != second.observations.tolist()
