"""Neural controllers: small networks whose weights are a genome.

    value_j = tanh(bias_j + sum_i weight_ji input_i + sum_k feedback_jk value_k of the last control period)

Only the first layer behind the inputs of a recurrent network has feedback. A genome contains, layer by layer
and neuron by neuron, the bias, the weights in the order of the inputs, and the feedback weights. The
functions use plain numbers and are compiled unchanged.
"""

import math
from collections.abc import Sequence

from khep_twin.compilable import compilable
from khep_twin.sensing.buffers import Vector


def n_genes(sizes: Sequence[int], recurrent: bool) -> int:
    """Return the genome length of a network with these numbers of inputs, neurons per layer and outputs."""
    total = 0
    for layer in range(1, len(sizes)):
        total += sizes[layer] * (sizes[layer - 1] + 1)
    return total + (sizes[1] * sizes[1] if recurrent else 0)


@compilable
def forward(
    sizes: Vector[int], recurrent: bool, genes: Vector[float], memory: Vector[float], neurons: Vector[float]
) -> int:
    """Evaluate a network once.

    Args:
        sizes: Numbers of inputs, neurons of each layer and outputs.
        recurrent: Whether the first layer has feedback.
        genes: Weights of the network (n_genes,).
        memory: Last values of the first layer, changed in place (at least sizes[1],).
        neurons: Inputs, then the values of all neurons, filled in (sum(sizes),).

    Returns:
        Index of the first output in `neurons`.
    """
    gene, input_start, layer_start = 0, 0, sizes[0]
    for layer in range(1, len(sizes)):
        feeds_back = recurrent and layer == 1
        for neuron in range(sizes[layer]):
            total = genes[gene]
            gene += 1
            for i in range(sizes[layer - 1]):
                total += genes[gene] * neurons[input_start + i]
                gene += 1
            if feeds_back:
                for i in range(sizes[layer]):
                    total += genes[gene] * memory[i]
                    gene += 1
            # The hyperbolic tangent, at half the cost of math.tanh.
            neurons[layer_start + neuron] = 1 - 2 / (1 + math.exp(2 * min(total, 20.0)))
        if feeds_back:
            for i in range(sizes[layer]):
                memory[i] = neurons[layer_start + i]
        input_start, layer_start = layer_start, layer_start + sizes[layer]
    return input_start
