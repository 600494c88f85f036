"""Reliability of a shadow's probabilities: said against true, in bins, as a table and as a picture."""

from collections.abc import Callable, Iterable, Sequence
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import numpy as np
from matplotlib.figure import Figure
from scipy.stats import binomtest

from studies.twin_runs import LEVELS, Raised, Suspected


class Claim(NamedTuple):
    """What a shadow said: a probability, whether by an alarm or as a suspicion, and whether it is right."""

    said: float
    alarm: bool
    right: bool


class Bin(NamedTuple):
    """Claims whose probability lies in a bin.

    Attributes:
        low: Lower end.
        high: Upper end.
        alarms: Number of alarms.
        suspicions: Number of suspicions.
        said: Mean probability.
        true: Share that is right.
        interval: Wilson's 95 % interval of that.
    """

    low: float
    high: float
    alarms: int
    suspicions: int
    said: float
    true: float
    interval: tuple[float, float]


def claims(
    alarms: Sequence[Raised],
    suspected: Iterable[Suspected],
    right: Callable[[str, int, Sequence[float]], bool] = lambda fault, time_ns, readings: False,
) -> list[Claim]:
    """Return what was said in a run.

    An alarm says one name as it is raised. A suspicion says that it is one of its names, and counts once in
    each bin that its probability enters.

    Args:
        alarms: Alarms.
        suspected: Suspicions.
        right: Function that takes a name, a time [ns] and readings, and returns whether the name is right.
    """
    found = [Claim(alarm.sureness, True, right(alarm.fault, alarm.raised_ns, alarm.readings)) for alarm in alarms]
    for suspicion in suspected:
        is_right = any(right(fault, suspicion.time_ns, suspicion.readings) for fault in suspicion.faults)
        found.append(Claim(suspicion.probability, False, is_right))
    return found


def binned(found: Sequence[Claim]) -> list[Bin]:
    """Return the bins that have claims."""
    bins: list[Bin] = []
    for low, high in pairwise(LEVELS):
        inside = [each for each in found if low <= each.said < high or each.said == high == LEVELS[-1]]
        if inside:
            right, alarms = (sum(getattr(each, name) for each in inside) for name in ("right", "alarm"))
            interval = binomtest(right, len(inside)).proportion_ci(method="wilson")
            said = float(np.mean([each.said for each in inside]))
            ends = float(interval.low), float(interval.high)
            bins.append(Bin(low, high, alarms, len(inside) - alarms, said, right / len(inside), ends))
    return bins


def draw(bins: Sequence[Bin], target: Path) -> None:
    """Draw the shares that are right over the probabilities that were said."""
    figure = Figure(figsize=(5.2, 5), layout="constrained")
    panel = figure.subplots()
    said, true = np.array([group.said for group in bins]), np.array([group.true for group in bins])
    ends = np.array([group.interval for group in bins]).T
    panel.plot((0, 1), (0, 1), "--", color="#9a9a9a", lw=1.2, label="as often as is said")
    panel.errorbar(
        said, true, np.abs(ends - true), fmt="o", ms=4, color="#1b4965", capsize=3, label="with 95 % interval"
    )
    for number, group in enumerate(reversed(bins)):
        count = str(group.alarms + group.suspicions)
        # The last bins are so narrow that their numbers stand on both sides.
        place = (4, -11) if number % 2 == 0 else (-4 - 5 * len(count), -11)
        panel.annotate(count, (group.said, group.true), place, textcoords="offset points", fontsize=8)
    panel.set(
        xlabel="probability that the shadow says",
        ylabel="share that is right",
        xlim=(0, 1.02),
        ylim=(-0.02, 1.02),
    )
    panel.spines[["top", "right"]].set_visible(False)
    panel.legend(loc="upper left", frameon=False, fontsize=8.5)
    figure.savefig(target, dpi=110)
