"""`python -m studies line`: fitness of networks in rollouts with and without a line, and over khep://.

Random networks, and the best of evolutions in the plane with the line, each with a seed of its own. The first
table has mean fitness and Spearman's rank correlation with that over `khep://`, the second what genomes that
were evolved in the plane, without the line and with it, have there and over the line.
"""

import sys
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.stats import spearmanr

from khep_twin import EpisodeSetup, Khepera, Network, NetworkController, Playpen, rollout
from khep_twin.lab.experiment import run
from khep_twin.lab.experiment.measures import HostMetrics
from khep_twin.ports.protocol_khep import Serial
from khep_twin.ports.twin import TwinOptions, open_twin
from khep_twin.randomness import stream

MODES = {9600: 1, 38400: 3}
PLAYPENS = ("obstacles", "looping-maze")
NETWORK = Network(hidden=(5,), recurrent=True)
SECONDS, N_RANDOM, N_EVOLVED = 30.0, 100, 20
POPULATION, GENERATIONS, EVOLVED_SECONDS = 60, 15, 20.0
FITNESS = "obstacle_avoidance"

Floats = NDArray[np.float64]


class Trial(NamedTuple):
    """Networks and the seeds of their runs.

    Attributes:
        playpen: Playpen.
        genes: Genes of each (n, n_genes).
        seeds: Seed of each (n,).
    """

    playpen: Playpen
    genes: Floats
    seeds: list[int]

    def rollout_fitness(self, line: int | None, planar: bool) -> Floats:
        """Return the fitness of each network in a rollout (n,)."""
        setup = EpisodeSetup(self.playpen, planar=planar, at_line=line is not None)
        return rollout(setup, NETWORK, self.seeds, SECONDS, genes=self.genes, line=line).metrics[FITNESS]

    def khep_fitness(self, baud: int) -> Floats:
        """Return the fitness of each network over khep:// (n,)."""
        found: list[float] = []
        for genes, seed in zip(self.genes.tolist(), self.seeds, strict=True):
            twin = open_twin(self.playpen, TwinOptions(seed=seed, mode=MODES[baud]))
            twin.world.compile()
            heard = HostMetrics()
            with Khepera(Serial.of(twin, timeout=1.0)) as robot:
                robot.listen(heard)
                controller = NetworkController(replace(NETWORK, genes=genes))
                run(controller, robot, seconds=SECONDS, after_cycle=heard.end_cycle)
            found.append(heard.metrics()["fitness"])
        return np.array(found)


def evolved(playpen: Playpen, line: int | None, seed: int) -> Floats:
    """Return the best genes of an evolution in the plane (n_genes,)."""
    rng, setup = stream(seed, "evolution"), EpisodeSetup(playpen, planar=True, at_line=line is not None)
    genes: Floats = rng.normal(size=(POPULATION, NETWORK.n_genes))
    for generation in range(GENERATIONS):
        seeds = [1000 * seed + generation] * POPULATION
        scores = rollout(setup, NETWORK, seeds, EVOLVED_SECONDS, genes=genes, line=line).metrics[FITNESS]
        parents = genes[np.argsort(-np.nan_to_num(scores))[: POPULATION // 4]]
        genes = np.concatenate([parents, *(parents + rng.normal(0, 0.3, parents.shape) for _ in range(3))])
    best: Floats = genes[0]
    return best


def main() -> int:
    """Print the tables."""
    print("| playpen, networks, baud | khep:// | with the line | plane, with the line | without a line |")
    print("|---|---|---|---|---|")
    kept: list[str] = []
    for name in PLAYPENS:
        playpen = Playpen.load(name)
        random = stream(7, name).normal(size=(N_RANDOM, NETWORK.n_genes))
        for baud in MODES:
            bred = {
                line: np.array([evolved(playpen, line, n) for n in range(N_EVOLVED)]) for line in (None, baud)
            }
            for kind, genes in (("random", random), ("evolved", bred[baud])):
                trial = Trial(playpen, genes, list(range(500, 500 + len(genes))))
                true = trial.khep_fitness(baud)
                cells = [f"{true.mean():.4f}"]
                for line, planar in ((baud, False), (baud, True), (None, False)):
                    got = trial.rollout_fitness(line, planar)
                    off, rank = got.mean() / true.mean() - 1, spearmanr(got, true)[0]
                    cells.append(f"{got.mean():.4f} ({off:+.1%}), {rank:.3f}")
                print(f"| {name}, {len(genes)} {kind}, {baud} | " + " | ".join(cells) + " |", flush=True)
            ends: list[float] = []
            for line in bred:
                trial = Trial(playpen, bred[line], list(range(500, 500 + N_EVOLVED)))
                ends += [float(trial.rollout_fitness(line, True).mean()), float(trial.khep_fitness(baud).mean())]
            kept.append(f"| {name}, {baud} | " + " | ".join(f"{end:.3f}" for end in ends) + " |")
    print("\n| playpen, baud | evolved without | then over khep:// | evolved with | then over khep:// |")
    print("|---|---|---|---|---|", *kept, sep="\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
