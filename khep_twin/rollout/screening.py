"""Screening: a whole population judged in a plane, and the best of it again in MuJoCo.

    screened = screen(playpen.load("looping-maze"), network, genes, range(3), 20.0, elite=20)
    best = genes[screened.elite[0]]

Every genome lives once with each seed, and is judged by the mean of what these lives measured. A genome with
a life that failed comes last.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from khep_twin import units
from khep_twin.playpen import Playpen
from khep_twin.rollout.batch import rollout
from khep_twin.rollout.life import NUMBERS
from khep_twin.rollout.minds import Driver, Floats
from khep_twin.rollout.mujoco_room import Start


@dataclass(frozen=True, slots=True)
class Screening:
    """What became of n genomes.

    Attributes:
        planar: what each measured in the plane (n,); not a number where a life failed.
        ranked: all genomes, best first in the plane (n,).
        elite: the first of these, best first in MuJoCo (k,).
        judged: what they measured in MuJoCo, in the elite's order (k,).
    """

    planar: Floats
    ranked: NDArray[np.int64]
    elite: NDArray[np.int64]
    judged: Floats


def screen(
    playpen: Playpen,
    driver: Driver,
    genes: Floats,
    seeds: Sequence[int] | range,
    seconds: float,
    *,
    elite: int = 20,
    number: str = "obstacle_avoidance",
    starts: Sequence[Start] | None = None,
    step_ns: int = units.STEP_NS,
    **options: Any,
) -> Screening:
    """Judges a population.

    Args:
        playpen: with one robot.
        driver: what drives all of them.
        genes: of each genome (n, n_genes).
        seeds: each genome lives once with each of them.
        seconds: how long each life lasts [s].
        elite: so many of the best are judged again in MuJoCo; all of them, where they are fewer.
        number: by which they are judged, the more the better (`life.NUMBERS`).
        starts: where a life with each seed begins; without, as in the playpen.
        step_ns: of MuJoCo's physics [ns].
        options: `noise`, `spread`, `home`, `period_ns`, `threads` and `compiled`, as for `batch.rollout`.

    Raises:
        ValueError: there is no such number, no home for it, no seed or no elite, or starts or genes do not
            fit.
    """
    if number not in NUMBERS:
        raise ValueError(f"number = {number!r}: there is none; right is one of {', '.join(NUMBERS)}")
    if not len(seeds) or not len(genes) or elite < 1:
        raise ValueError(
            f"{len(genes)} genomes, {len(seeds)} seeds and an elite of {elite}; right are 1 or more of each"
        )
    if number == "homing" and options.get("home") is None:
        raise ValueError("number = 'homing': there is no home; right is home=(x, y, radius [mm], charge [s])")
    if np.ndim(genes) != 2:
        raise ValueError(f"genes are of shape {np.shape(genes)}; right is a row for each genome")
    if starts is not None and len(starts) != len(seeds):
        raise ValueError(f"{len(starts)} starts for {len(seeds)} seeds; right are as many")

    def judge(which: NDArray[np.int64], **how: Any) -> Floats:
        found = rollout(
            playpen,
            driver,
            [seed for _ in which for seed in seeds],
            seconds,
            genes=np.repeat(np.asarray(genes, np.float64)[which], len(seeds), axis=0),
            starts=None if starts is None else [start for _ in which for start in starts],
            **how,
            **options,
        )
        return found.numbers[number].reshape(len(which), len(seeds)).mean(axis=1)

    planar = judge(np.arange(len(genes)), planar=True)
    ranked = best_first(planar)
    again = ranked[:elite]
    judged = judge(again, step_ns=step_ns)
    order = best_first(judged)
    return Screening(planar, ranked, again[order], judged[order])


def best_first(numbers: Floats) -> NDArray[np.int64]:
    """Places of numbers, the largest first, equal ones as they come, what is no number last (n,)."""
    return np.argsort(-np.where(np.isnan(numbers), -np.inf, numbers), kind="stable")
