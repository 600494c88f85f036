"""Whether an environment is the same for 100,000 steps: `make determinism`; about five minutes.

Two of them in this process and one in another take the same actions, single and together, and must give the
same observations and rewards bit for bit.
"""

import hashlib
import subprocess
import sys

import gymnasium
import numpy as np

import khep_twin.scale.gymnasium_environment  # noqa: F401

STEPS = 100_000
MANY = 4


def single(task: str, seed: int) -> str:
    """A hash of all that one environment gives."""
    environment = gymnasium.make(f"khep_twin/{task}-v0", spread=True)
    chance, digest = np.random.default_rng(seed), hashlib.sha256()
    digest.update(environment.reset(seed=seed)[0].tobytes())
    for _ in range(STEPS):
        observation, reward, ended, late, _ = environment.step(chance.uniform(-5, 20, 2).astype(np.float32))
        digest.update(observation.tobytes() + np.float64(reward).tobytes())
        if ended or late:
            digest.update(environment.reset()[0].tobytes())
    return digest.hexdigest()


def together(task: str, seed: int, threads: int) -> str:
    """A hash of all that MANY give, STEPS in all."""
    environments = gymnasium.make_vec(f"khep_twin/{task}-v0", num_envs=MANY, spread=True, threads=threads)
    chance, digest = np.random.default_rng(seed), hashlib.sha256()
    digest.update(environments.reset(seed=seed)[0].tobytes())
    for _ in range(STEPS // MANY):
        observations, rewards, *_ = environments.step(chance.uniform(-5, 20, (MANY, 2)).astype(np.float32))
        digest.update(observations.tobytes() + rewards.tobytes())
    environments.close()
    return digest.hexdigest()


def main() -> int:
    """Compares them; 0 if they are the same."""
    if len(sys.argv) > 1:
        print(single("Homing", 1))
        return 0
    other = subprocess.run([sys.executable, __file__, "other"], capture_output=True, text=True, check=True)
    ones = [single("Homing", 1), single("Homing", 1), other.stdout.strip()]
    many = [together("ObstacleAvoidance", 1, threads) for threads in (1, 2)]
    same = len(set(ones)) == len(set(many)) == 1
    print(f"{STEPS} steps, here twice and in another process: {' '.join(digest[:12] for digest in ones)}")
    print(f"{STEPS} steps of {MANY}, by 1 and 2 threads: {' '.join(digest[:12] for digest in many)}")
    print("the same" if same else "NOT the same")
    return 0 if same else 1


if __name__ == "__main__":
    sys.exit(main())
