"""Trajectories of many episodes, for the experiments of this folder."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from khep_twin import Episode, EpisodeOptions, EpisodeSetup, Start
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
    episode, count = Episode(setup, driver, compiled=True), round(seconds / sample_s)
    each = np.broadcast_to(genes, (len(starts), np.shape(genes)[-1]))
    poses = np.empty((len(starts), count + 1, 3))
    for index, start in enumerate(starts):
        episode.begin(first_seed + index, EpisodeOptions(start=start, genes=each[index]))
        poses[index, 0] = episode.pose
        for sample in range(1, count + 1):
            episode.run(sample_s)
            poses[index, sample] = episode.pose
    poses[..., :2] *= 1000
    return poses
