"""Trajectories of many episodes, for the experiments of this folder."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from khep_twin import EpisodeSetup, Start, rollout
from khep_twin.episodes import Driver


def trajectories(
    setup: EpisodeSetup,
    driver: Driver,
    genes: NDArray[np.float64],
    starts: Sequence[Start],
    seconds: float,
    *,
    sample_s: float = 0.1,
    first_seed: int = 0,
) -> NDArray[np.float64]:
    """Run an episode from each start; return the poses x, y [mm] and heading [rad] (n, samples, 3).

    Args:
        setup: Setup of the episodes.
        driver: Controller of all episodes.
        genes: Genes of all episodes (n_genes,), or of each (n, n_genes).
        starts: Start of each episode (n, 3).
        seconds: Duration of each episode [s].
        sample_s: Time between two poses [s], whole control periods.
        first_seed: Seed of the first episode; each further one has the next.
    """
    episode_genes = np.broadcast_to(genes, (len(starts), np.shape(genes)[-1]))
    seeds = range(first_seed, first_seed + len(starts))
    results = rollout(setup, driver, seeds, seconds, genes=episode_genes, starts=starts, paths_every=sample_s)
    return results.paths * (1000, 1000, 1)
