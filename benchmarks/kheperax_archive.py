"""MAP-Elites of qdax on the standard task of Kheperax 0.2.0, in a separate process and environment.

One line of input, JSON: `seed`, `batch`, `iterations`, `cells` along a side and `sigma`, the standard
deviation of the mutation. One line of output, JSON:
`fitness` and `descriptors` of the elites, `wall` and `cpu` [s] of all evaluations but not of compiling,
which is `compiling` [s of processor time], and `versions`.

The task and the search are those of Kheperax's `examples/main/me_training.py`: 250 steps, one hidden
layer of 8 neurons, three lasers that read -1 with nothing in reach, two bumpers, mutation by a normal
distribution, there of 0.2. The fitness is scaled: 0 is full speed all the time, 1 a robot at rest.
"""

import json
import resource
import sys
import time
from functools import partial
from importlib.metadata import version
from typing import Any

STEPS, HIDDEN = 250, (8,)
"""Steps of an episode and neurons of the hidden layers, as in Kheperax's example."""


def main() -> None:
    request = json.loads(sys.stdin.readline())
    print(json.dumps(archive(**request)))


def archive(seed: int, batch: int, iterations: int, cells: int, sigma: float) -> dict[str, Any]:
    """Fill an archive; return its elites, times and versions."""
    import jax
    import jax.numpy as jnp

    jax.tree_leaves = jax.tree_util.tree_leaves  # Kheperax calls it, and jax has removed it
    from kheperax.tasks.config import KheperaxConfig
    from kheperax.tasks.main import KheperaxTask
    from qdax.core.containers.mapelites_repertoire import compute_euclidean_centroids
    from qdax.core.emitters.mutation_operators import isoline_variation
    from qdax.core.emitters.standard_emitters import MixingEmitter
    from qdax.core.map_elites import MAPElites
    from qdax.utils.metrics import default_qd_metrics

    config = KheperaxConfig.get_default()
    config.episode_length, config.mlp_policy_hidden_layer_sizes = STEPS, HIDDEN
    config.robot = config.robot.replace(lasers_return_minus_one_if_out_of_range=True)
    lowest_reward = -STEPS * 2 * config.action_scale**2
    key, first, second, third = jax.random.split(jax.random.PRNGKey(seed), 4)
    env, network, scoring = KheperaxTask.create_default_task(config, random_key=first)

    def score(genomes: Any, key: Any) -> tuple[Any, Any, dict[str, Any]]:
        # qdax expects three results, and would keep the transitions.
        fitness, descriptors, *_ = scoring(genomes, key)
        return 1 - fitness / lowest_reward, descriptors, {}

    search = MAPElites(
        scoring_function=score,
        emitter=MixingEmitter(
            mutation_fn=lambda genomes, key: (genomes, key),
            variation_fn=partial(isoline_variation, iso_sigma=sigma, line_sigma=0.0),
            variation_percentage=1.0,
            batch_size=batch,
        ),
        metrics_function=partial(default_qd_metrics, qd_offset=0.0),
    )
    low, high = env.behavior_descriptor_limits
    centroids = compute_euclidean_centroids(grid_shape=(cells, cells), minval=low, maxval=high)
    genomes = jax.vmap(network.init)(
        jax.random.split(second, batch), jnp.zeros((batch, env.observation_size))
    )
    began = cpu_s()
    begin = jax.jit(search.init).lower(genomes, centroids, third).compile()
    repertoire, state, _ = begin(genomes, centroids, third)
    update = jax.jit(search.update).lower(repertoire, state, key).compile()
    compiling = cpu_s() - began

    cpu, wall = cpu_s(), time.perf_counter()
    repertoire, state, _ = begin(genomes, centroids, third)
    for step_key in jax.random.split(key, iterations - 1):
        repertoire, state, _ = update(repertoire, state, step_key)
    jax.block_until_ready(repertoire.fitnesses)
    times = {"wall": time.perf_counter() - wall, "cpu": cpu_s() - cpu, "compiling": compiling}
    filled = repertoire.fitnesses.reshape(-1) > -jnp.inf
    return {
        "fitness": repertoire.fitnesses.reshape(-1)[filled].tolist(),
        "descriptors": repertoire.descriptors[filled].tolist(),
        "versions": {name: version(name) for name in ("kheperax", "qdax", "jax")},
        **times,
    }


def cpu_s() -> float:
    """Return the processor time of all threads of this process [s]."""
    used = resource.getrusage(resource.RUSAGE_SELF)
    return used.ru_utime + used.ru_stime


if __name__ == "__main__":
    sys.exit(main())
