"""Determinism of an environment over 100,000 steps.

One environment runs with the same actions in two processes, and four together by one thread and by two: each
pair must give the same observations and rewards bit for bit.
"""

import hashlib
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor

import gymnasium
import numpy as np

import khep_twin.envs.gymnasium  # noqa: F401
from tools.command_table import command_line

STEPS = 100_000
N_ENVIRONMENTS = 4


def single(task: str, seed: int) -> str:
    """Return a hash of all results of one environment."""
    environment = gymnasium.make(f"khep_twin/{task}-v0", vary=True)
    rng, digest = np.random.default_rng(seed), hashlib.sha256()
    digest.update(environment.reset(seed=seed)[0].tobytes())
    for _ in range(STEPS):
        observation, reward, ended, late, _ = environment.step(rng.uniform(-0.25, 1, 2).astype(np.float32))
        digest.update(observation.tobytes() + np.float64(reward).tobytes())
        if ended or late:
            digest.update(environment.reset()[0].tobytes())
    return digest.hexdigest()


def together(task: str, seed: int, threads: int) -> str:
    """Return a hash of all results of MANY environments, STEPS in total."""
    environments = gymnasium.make_vec(
        f"khep_twin/{task}-v0", num_envs=N_ENVIRONMENTS, vary=True, threads=threads
    )
    rng, digest = np.random.default_rng(seed), hashlib.sha256()
    digest.update(environments.reset(seed=seed)[0].tobytes())
    for _ in range(STEPS // N_ENVIRONMENTS):
        observations, rewards, *_ = environments.step(
            rng.uniform(-0.25, 1, (N_ENVIRONMENTS, 2)).astype(np.float32)
        )
        digest.update(observations.tobytes() + rewards.tobytes())
    environments.close()
    return digest.hexdigest()


RUNS = (0, 0, 1, 2)
"""Threads of the runs, each in a separate process; 0: one environment alone."""


def run(threads: int) -> str:
    """Return the hash of a run in another process."""
    command = [sys.executable, "-m", "checks", "determinism", "--threads", str(threads)]
    digest = subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()
    print(f"{STEPS} steps, {f'together by {threads} threads' if threads else 'single'}: {digest}", flush=True)
    return digest


def main() -> int:
    """Compare the runs; return 0 if they are the same."""
    parser = command_line(__doc__)
    parser.add_argument("--threads", type=int, help="only the hash by so many threads; 0: of one environment")
    threads = parser.parse_args().threads
    if threads is not None:
        print(together("ObstacleAvoidance", 1, threads) if threads else single("Homing", 1))
        return 0
    with ThreadPoolExecutor(2) as pool:
        first_single, second_single, by_one_thread, by_two_threads = pool.map(run, RUNS)
    same = first_single == second_single and by_one_thread == by_two_threads
    print("the same" if same else "NOT the same")
    return 0 if same else 1
