"""`python -m studies line`: fitness of networks in rollouts with and without a line, and over khep://.

The networks are random ones, and the best of evolutions in the planar model with the line, with different
seeds. The first table has mean fitness and Spearman's rank correlation with that over `khep://`. The second
has the fitness of genomes that evolved in the planar model, without and with the line, there and over the
line.
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
        fitnesses: list[float] = []
        for genes, seed in zip(self.genes.tolist(), self.seeds, strict=True):
            twin = open_twin(self.playpen, TwinOptions(seed=seed, mode=MODES[baud]))
            twin.world.compile()
            with Khepera(Serial.of(twin, timeout=1.0)) as robot:
                metrics = HostMetrics(robot.model)
                robot.listen(metrics)
                controller = NetworkController(replace(NETWORK, genes=genes))
                run(controller, robot, seconds=SECONDS, after_cycle=metrics.end_cycle)
            fitnesses.append(metrics.metrics()["fitness"])
        return np.array(fitnesses)


def evolve(playpen: Playpen, line: int | None, seed: int) -> Floats:
    """Evolve networks in the planar model; return the best genes (n_genes,)."""
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
    rows: list[str] = []
    for name in PLAYPENS:
        playpen = Playpen.load(name)
        random = stream(7, name).normal(size=(N_RANDOM, NETWORK.n_genes))
        for baud in MODES:
            evolved_genes = {
                line: np.array([evolve(playpen, line, n) for n in range(N_EVOLVED)]) for line in (None, baud)
            }
            for kind, genes in (("random", random), ("evolved", evolved_genes[baud])):
                trial = Trial(playpen, genes, list(range(500, 500 + len(genes))))
                khep_fitness = trial.khep_fitness(baud)
                cells = [f"{khep_fitness.mean():.4f}"]
                for line, planar in ((baud, False), (baud, True), (None, False)):
                    fitness = trial.rollout_fitness(line, planar)
                    off, rank = fitness.mean() / khep_fitness.mean() - 1, spearmanr(fitness, khep_fitness)[0]
                    cells.append(f"{fitness.mean():.4f} ({off:+.1%}), {rank:.3f}")
                print(f"| {name}, {len(genes)} {kind}, {baud} | " + " | ".join(cells) + " |", flush=True)
            means: list[float] = []
            for line in evolved_genes:
                trial = Trial(playpen, evolved_genes[line], list(range(500, 500 + N_EVOLVED)))
                means += [
                    float(trial.rollout_fitness(line, True).mean()),
                    float(trial.khep_fitness(baud).mean()),
                ]
            rows.append(f"| {name}, {baud} | " + " | ".join(f"{mean:.3f}" for mean in means) + " |")
    print("\n| playpen, baud | evolved without | then over khep:// | evolved with | then over khep:// |")
    print("|---|---|---|---|---|", *rows, sep="\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
