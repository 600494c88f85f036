"""Evolution of a network by CMA-ES, for the experiments of this folder."""

import argparse
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from khep_twin.errors import pip_install
from khep_twin.files import unusable

try:
    from cmaes import CMA
except ImportError:
    sys.exit(f"cmaes is not installed; to install it: {pip_install('cmaes')}")

Floats = NDArray[np.float64]


def parse_options(
    description: str, *, generations: int, episodes: int, seconds: float, check_starts: int
) -> argparse.Namespace:
    """Return the options of the command line; the arguments are their defaults."""
    parser = argparse.ArgumentParser(description=description)
    parser.add_argument("--generations", type=int, default=generations)
    parser.add_argument("--population", type=int, default=20)
    parser.add_argument("--episodes", type=int, default=episodes, help="episodes of a genome")
    parser.add_argument("--seconds", type=float, default=seconds, help="duration of an episode")
    parser.add_argument(
        "--check-starts", type=int, default=check_starts, help="evaluation episodes in MuJoCo"
    )
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--picture", type=Path, help="draw curve and paths to NAME.png and NAME_way.png")
    options = parser.parse_args()
    if options.picture is not None and (reason := unusable(options.picture)):
        parser.error(f"{options.picture}: cannot be written: {reason}")
    return options


def evolve(
    mean: Floats, sigma: float, options: argparse.Namespace, judge: Callable[[Floats, int], Floats]
) -> tuple[Floats, list[Floats]]:
    """Search the genes of a network, and print the course.

    Args:
        mean: Genes from which the search starts (n_genes,).
        sigma: Standard deviation of the first generation's weights.
        options: Options of the command line.
        judge: Function that returns the fitness of a generation's genomes from them and its number.

    Returns:
        Final mean of the search (n_genes,), and the fitness of each generation's genomes.
    """
    began, curve = time.monotonic(), []
    search = CMA(mean=mean, sigma=sigma, population_size=options.population, seed=options.seed)
    for generation in range(options.generations):
        genomes = np.array([search.ask() for _ in range(options.population)])
        fitness = judge(genomes, generation)
        search.tell([(genome, -value) for genome, value in zip(genomes, fitness, strict=True)])
        curve.append(fitness)
        print(
            f"generation {generation:3}  best {fitness.max():.3f}  mean {fitness.mean():.3f}  "
            f"{time.monotonic() - began:5.0f} s",
            flush=True,
        )
    return search.mean, curve
