"""Screening: evaluation of a whole population in a plane, and of its best again in MuJoCo.

    screened = screen(playpen.load("looping-maze"), network, genes, range(3), 20.0, elite=20)
    best = genes[screened.elite[0]]

Every genome runs one episode with each seed, and is ranked by their mean metric. A genome with a failed
episode is ranked last.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from khep_twin import units
from khep_twin.episodes.batch import rollout
from khep_twin.episodes.controllers import Driver, Floats
from khep_twin.episodes.episode import METRICS
from khep_twin.playpen import Playpen
from khep_twin.playpen.starts import Start


@dataclass(frozen=True, slots=True)
class Screening:
    """Results of n genomes.

    Attributes:
        planar: Mean metric of each genome in the plane (n,); NaN where an episode failed.
        ranked: Indices of all genomes, best first in the plane (n,).
        elite: First k of these, best first in MuJoCo (k,).
        judged: Mean metrics in MuJoCo, in the elite's order (k,).
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
    """Evaluate a population.

    Args:
        playpen: Playpen with one robot.
        driver: Controller of all genomes.
        genes: Genes of each genome (n, n_genes).
        seeds: Seeds of each genome's episodes.
        seconds: Duration of each episode [s].
        elite: Number of the best that are evaluated again in MuJoCo; all, if there are fewer.
        number: Metric to rank by, larger is better (`episode.METRICS`).
        starts: Start pose for each seed; by default the playpen's.
        step_ns: Step of MuJoCo's physics [ns].
        options: `noise`, `vary`, `home`, `period_ns`, `threads` and `compiled`, as for `batch.rollout`.

    Raises:
        ValueError: The metric is unknown, its home is missing, there is no seed or no elite, or starts or
            genes do not fit.
    """
    if number not in METRICS:
        raise ValueError(f"number = {number!r}; expected one of {', '.join(METRICS)}")
    if not len(seeds) or not len(genes) or elite < 1:
        raise ValueError(
            f"{len(genes)} genomes, {len(seeds)} seeds and an elite of {elite}; expected 1 or more of each"
        )
    if number == "homing" and options.get("home") is None:
        raise ValueError("number = 'homing' without a home; expected home=(x, y, radius [mm], charge [s])")
    if np.ndim(genes) != 2:
        raise ValueError(f"genes of shape {np.shape(genes)}; expected a row for each genome")
    if starts is not None and len(starts) != len(seeds):
        raise ValueError(f"{len(starts)} starts for {len(seeds)} seeds; expected {len(seeds)}")

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
        return found.metrics[number].reshape(len(which), len(seeds)).mean(axis=1)

    planar = judge(np.arange(len(genes)), planar=True)
    ranked = best_first(planar)
    again = ranked[:elite]
    judged = judge(again, step_ns=step_ns)
    order = best_first(judged)
    return Screening(planar, ranked, again[order], judged[order])


def best_first(metrics: Floats) -> NDArray[np.int64]:
    """Return the indices that sort numbers, largest first, equal ones in their order, NaN last (n,)."""
    return np.argsort(-np.where(np.isnan(metrics), -np.inf, metrics), kind="stable")
