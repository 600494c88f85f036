"""Speed of the vectorized environments: `python -m benchmarks.environments`, in MuJoCo and in the plane.

The floor is a batch of as many episodes with a policy in Python that does almost nothing, with control
periods of 50 ms as in the environments: physics, sensors and firmware without observations and rewards.
"""

import importlib.util
import sys

import numpy as np

from benchmarks.scale import POLICY, batch_row
from benchmarks.table import LEGEND, Row, Table, measure, text, timed
from khep_twin.envs.task_setup import PERIOD_NS
from khep_twin.episodes.episode_setup import EpisodeSetup
from khep_twin.playpen import Playpen

NAME, PLAYPEN, PLAYPEN_4 = "khep_twin/ObstacleAvoidance-v0", "obstacles", "arena4"
EPISODES = 64
"""Environments that are stepped together, as many as a batch calls its policy with."""
ABSENT = "without the environments: gymnasium, the extra [rl], is not installed"


def environments_row(
    name: str, seconds: float, count: int, planar: bool, mode: str | None = None, playpen: str = PLAYPEN
) -> Row:
    """Return a row of some environments with one thread, with their creation and their start.

    Args:
        name: Name in the table.
        seconds: Duration of each episode [s].
        count: Number of environments.
        planar: Whether they are in the plane.
        mode: Vectorization mode of Gymnasium; None for that of the environments.
        playpen: Their playpen.
    """
    import gymnasium

    import khep_twin.envs.gymnasium  # noqa: F401  (registers the environments)

    options = {"threads": 1} if mode is None else {}
    n_steps = round(seconds * 1e9) // PERIOD_NS

    def run() -> None:
        environments = gymnasium.make_vec(
            NAME,
            num_envs=count,
            vectorization_mode=mode,
            playpen=playpen,
            planar=planar,
            compiled=True,
            seconds=seconds,
            **options,
        )
        environments.reset(seed=1)
        actions = np.full((count, 2), 0.5, np.float32)
        for _ in range(n_steps):
            environments.step(actions)
        environments.close()

    return Row(name, count * seconds, timed(run), lambda rate: f"{rate * 1e9 / PERIOD_NS:.0f} steps per s")


def tables(part: float, rounds: int) -> list[Table]:
    """Measure the environments in MuJoCo and in the plane.

    Args:
        part: Fraction of the usual length.
        rounds: Number of counted rounds.
    """
    results: list[Table] = []
    for planar, seconds in ((False, 4 * part), (True, 60 * part)):
        setup = EpisodeSetup(Playpen.load(PLAYPEN), period_ns=PERIOD_NS, planar=planar)
        rows = [batch_row("batch, Python policy (floor)", setup, EPISODES, seconds, 1, POLICY)]
        present = importlib.util.find_spec("gymnasium") is not None
        if present:
            rows += [
                environments_row(f"make_vec, {EPISODES} environments", seconds, EPISODES, planar),
                environments_row("make_vec, 8 environments", seconds, 8, planar),
                environments_row('the same, "sync"', seconds, 8, planar, "sync"),
                environments_row(
                    f"Khepera IV, {EPISODES} environments", seconds, EPISODES, planar, playpen=PLAYPEN_4
                ),
            ]
        where = "the plane" if planar else "MuJoCo"
        title = f"environments in {where}, 1 thread"
        results.append(measure(title, rows, rounds, remarks=[] if present else [ABSENT]))
    return results


def main() -> None:
    print(text(tables(1.0, 5)), LEGEND, sep="\n\n")


if __name__ == "__main__":
    sys.exit(main())
