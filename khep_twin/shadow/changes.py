"""Changes that a filter considers, beside no change: each fault that may begin, each that may end.

Every change has its own particles, at least its quota. At each mixing some particles without a change undergo
it, with the probability that it happens in that time; the weights tell whether it did.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from khep_twin.shadow.hypotheses import QUOTA, Hypothesis
from khep_twin.shadow.particles import Particles, drawn

Floats = NDArray[np.float64]

ENDS = 3.0
"""Logarithm of the odds against a fault that ends, in a second (assumed)."""

UNDONE = 0.005
"""Rate at which a change turns out not to have happened, lest what nothing tells becomes probable [1/s]."""


_NOTHING = 1e-200
"""Weight below which no particle is drawn."""


class FaultChange(NamedTuple):
    """A fault that begins or ends.

    Attributes:
        hypothesis: Fault.
        begins: Whether it begins.
        unseen_s: Time before it was considered, for which it may have happened unseen [s].
    """

    hypothesis: Hypothesis
    begins: bool
    unseen_s: float = 0.0

    @property
    def key(self) -> tuple[str, bool]:
        """Name of the fault, and whether it begins."""
        return self.hypothesis.name, self.begins

    @property
    def rate(self) -> float:
        """Probability in a second that it happens by itself."""
        if self.hypothesis.is_found:
            return 0.0
        return math.exp(-(self.hypothesis.rare if self.begins else ENDS))

    def happen(self, particles: Particles, rng: np.random.Generator) -> None:
        """Let it happen to particles."""
        if self.begins:
            self.hypothesis.begin(particles, rng)
        else:
            self.hypothesis.end(particles)

    def undo(self, particles: Particles, rng: np.random.Generator) -> None:
        """Undo it."""
        self._replace(begins=not self.begins).happen(particles, rng)


def quotas(changes: Sequence[FaultChange]) -> list[int]:
    """Return the least numbers of particles without a change and with each one (1 + n_changes,)."""
    return [QUOTA * bool(changes), *(change.hypothesis.quota for change in changes)]


def mixed(
    particles: Particles,
    changes: Sequence[FaultChange],
    count: int,
    passed_s: float,
    time_ns: int,
    rng: np.random.Generator,
) -> Particles:
    """Return particles drawn by their weights, for each change apart; some undergo it now, or not any more.

    The changes are 1, 2, ... of these particles; they are `count`, besides the quota of each change.
    """
    weights = np.exp(particles.logs - particles.logs.max())
    weights /= weights.sum()
    # In the order of what each has: those drawn of one change follow each other.
    order = np.argsort(particles.changes, kind="stable")
    sources: NDArray[np.intp] = order[weights[order] > 0]
    had, weights = particles.changes[sources], weights[sources]
    least, rates = quotas(changes), [UNDONE, *(change.rate for change in changes)]
    unseen_s = [0.0, *(change.unseen_s for change in changes)]
    may_turn = np.array([True, *(not change.hypothesis.is_found for change in changes)])
    numbers: list[NDArray[np.int64]] = []
    rows: list[NDArray[np.intp]] = []
    logs: list[Floats] = []
    for number, rate in enumerate(rates):
        staying = math.exp(-(sum(rates) - rate) * passed_s)
        has = had == number
        for_s = passed_s if has.any() else passed_s + unseen_s[number]
        shares: Floats = weights * np.where(has, staying, rate * for_s * may_turn[had])
        whole = float(shares.sum())
        if whole < _NOTHING:
            continue
        size = round(count * float(weights[has].sum())) + least[number]
        picked: NDArray[np.intp] = sources[drawn(shares, size, rng.random())]
        rows.append(picked)
        numbers.append(np.full(size, number))
        logs.append(np.full(size, math.log(whole / size), np.float64))
    indices = np.concatenate(rows)
    made = particles.taken(indices)
    made.logs = np.concatenate(logs)
    before = particles.changes[indices]
    made.changes = np.concatenate(numbers)
    turns = np.diff(before, prepend=-1, append=-1) | np.diff(made.changes, prepend=-1, append=-1)
    edges = np.flatnonzero(turns)
    for start, stop in zip(edges[:-1].tolist(), edges[1:].tolist(), strict=True):
        old, new = int(before[start]), int(made.changes[start])
        part = made.taken(slice(start, stop))
        for number, change in enumerate(changes, 1):
            if old == new and (number == new) == change.begins:
                change.hypothesis.refine(part, rng)  # All of these have that fault.
        if old != new:
            part.since_ns[:] = time_ns
            if old:
                changes[old - 1].undo(part, rng)
            if new:
                changes[new - 1].happen(part, rng)
    return made
