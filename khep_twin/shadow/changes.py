"""Changes that a filter considers, beside no change: each fault that may start, each that may end.

The particles of every change are resampled separately, to at least its quota. In each resampling, particles
without a change undergo it with its probability since the last resampling; the weights then decide.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from khep_twin.shadow.hypotheses import QUOTA, Hypothesis
from khep_twin.shadow.particles import Floats, Particles, resample_indices

END_LOG_ODDS = 3.0
"""Logarithm of the odds against the end of a fault, in a second (assumed)."""

UNDO_RATE = 0.005
"""Rate at which changes are undone, so that none becomes probable without evidence [1/s]."""

_MIN_WEIGHT = 1e-200
"""Total weight below which no particle is drawn."""


class FaultChange(NamedTuple):
    """A fault that starts or ends.

    Attributes:
        hypothesis: Fault.
        starts: Whether it starts.
        unseen_s: Time before it was first considered in which it may have happened [s].
    """

    hypothesis: Hypothesis
    starts: bool
    unseen_s: float = 0.0

    @property
    def key(self) -> tuple[str, bool]:
        """Name of the fault, and whether it starts."""
        return self.hypothesis.name, self.starts

    @property
    def rate(self) -> float:
        """Probability per second that the change happens outside a search [1/s]."""
        if self.hypothesis.needs_search:
            return 0.0
        return math.exp(-(self.hypothesis.log_odds_against if self.starts else END_LOG_ODDS))

    def apply(self, particles: Particles, rng: np.random.Generator) -> None:
        """Start or end the fault in particles."""
        if self.starts:
            self.hypothesis.begin(particles, rng)
        else:
            self.hypothesis.end(particles)

    def undo(self, particles: Particles, rng: np.random.Generator) -> None:
        """Reverse the change in particles."""
        self._replace(starts=not self.starts).apply(particles, rng)


def quotas(changes: Sequence[FaultChange]) -> list[int]:
    """Return the least numbers of particles without a change and with each one (1 + n_changes,)."""
    return [QUOTA * bool(changes), *(change.hypothesis.quota for change in changes)]


def resample_changes(
    particles: Particles,
    changes: Sequence[FaultChange],
    count: int,
    elapsed_s: float,
    time_ns: int,
    rng: np.random.Generator,
) -> Particles:
    """Return particles resampled separately for each change, some of which undergo or undo it now.

    The changes have the numbers 1, 2, ... in `Particles.changes`, and their quotas besides `count` particles.
    `elapsed_s` is the time since the last resampling [s], `time_ns` the present time [ns].
    """
    weights = np.exp(particles.log_weights - particles.log_weights.max())
    weights /= weights.sum()
    # In the order of changes, so that those drawn from one change are contiguous.
    sorted_indices = np.argsort(particles.changes, kind="stable")
    sources: NDArray[np.intp] = sorted_indices[weights[sorted_indices] > 0]
    old_changes, weights = particles.changes[sources], weights[sources]
    min_sizes, rates = quotas(changes), [UNDO_RATE, *(change.rate for change in changes)]
    unseen_s = [0.0, *(change.unseen_s for change in changes)]
    may_change = np.array([True, *(not change.hypothesis.needs_search for change in changes)])
    change_parts: list[NDArray[np.int64]] = []
    index_parts: list[NDArray[np.intp]] = []
    log_weight_parts: list[Floats] = []
    for number, rate in enumerate(rates):
        p_stay = math.exp(-(sum(rates) - rate) * elapsed_s)
        is_same = old_changes == number
        exposure_s = elapsed_s if is_same.any() else elapsed_s + unseen_s[number]
        shares: Floats = weights * np.where(is_same, p_stay, rate * exposure_s * may_change[old_changes])
        total = float(shares.sum())
        if total < _MIN_WEIGHT:
            continue
        size = round(count * float(weights[is_same].sum())) + min_sizes[number]
        chosen_indices: NDArray[np.intp] = sources[resample_indices(shares, size, rng.random())]
        index_parts.append(chosen_indices)
        change_parts.append(np.full(size, number))
        log_weight_parts.append(np.full(size, math.log(total / size), np.float64))
    indices = np.concatenate(index_parts)
    mixture = particles.select(indices)
    mixture.log_weights = np.concatenate(log_weight_parts)
    previous = particles.changes[indices]
    mixture.changes = np.concatenate(change_parts)
    is_bound = np.diff(previous, prepend=-1, append=-1) | np.diff(mixture.changes, prepend=-1, append=-1)
    block_bounds = np.flatnonzero(is_bound)
    for start, stop in zip(block_bounds[:-1].tolist(), block_bounds[1:].tolist(), strict=True):
        old, new = int(previous[start]), int(mixture.changes[start])
        block = mixture.select(slice(start, stop))
        for number, change in enumerate(changes, 1):
            if old == new and (number == new) == change.starts:
                change.hypothesis.jitter(block, rng)  # All particles of the block have the fault.
        if old != new:
            block.since_ns[:] = time_ns
            if old:
                changes[old - 1].undo(block, rng)
            if new:
                changes[new - 1].apply(block, rng)
    return mixture
