"""Comparisons of the noise of proximity."""

from functools import partial
from pathlib import Path

import numpy as np

from studies.fidelity_comparison import Comparison, Outcome
from studies.noise_fits import ORDERS, differences, sampled, twin

_SAMPLES = "samples of one Khepera, CNR Rome"


def noise(folder: Path, target: str) -> Outcome:
    """Compare the differences of three orders along the bearings with those of a twin in the same light."""
    robot, own = sampled()[target], twin(target)
    levels = [(differences(robot, order), differences(own, order)) for order in ORDERS]
    apart = [model / level - 1 for level, model in levels]
    told = ", ".join(f"{model:.0f} for {level:.0f}" for level, model in levels)
    return Outcome(float(np.abs(apart).max()) * 100, note=f"orders 2, 4, 6: {told} counts")


COMPARISONS = tuple(
    Comparison(
        f"noise before a {target}, largest of three orders",
        _SAMPLES,
        "fitted: white noise, flicker of the lamp, error of the bearings",
        "%",
        partial(noise, target=target),
    )
    for target in ("wall", "cylinder")
)
"""Comparisons of noise, in the page's order."""
