"""Curves of evolution, for the experiments of this folder."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from numpy.typing import ArrayLike

from khep_twin.drawing import save


def draw_curve(fitness: Sequence[ArrayLike], label: str, file: Path) -> None:
    """Draw the best and mean fitness of each generation.

    Args:
        fitness: Fitness of all genomes of each generation (generations, n).
        label: Definition of the fitness, in a few words.
        file: PNG, SVG or PDF file.
    """
    table = np.array(fitness)
    figure = Figure(figsize=(6.4, 3.0), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    axes.plot(table.max(axis=1), label="best", color="#2f7d5b", lw=1.4)
    axes.plot(table.mean(axis=1), label="mean", color="#2b2f36", lw=1.4)
    axes.set(xlabel="generation", ylabel=label)
    axes.set_ylim(bottom=0)
    axes.legend(loc="upper left", frameon=False)
    save(figure, file)
