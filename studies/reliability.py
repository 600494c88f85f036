"""Reliability of a shadow's probabilities: stated against true shares, in bins, as a table and a picture."""

from collections.abc import Callable, Iterable, Sequence
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import numpy as np
from matplotlib.figure import Figure
from scipy.stats import binomtest

from studies.twin_runs import LEVELS, AlarmRecord, SuspicionRecord


class Claim(NamedTuple):
    """Claim of a shadow: its probability, whether it is an alarm or a suspicion, and whether it is right."""

    probability: float
    alarm: bool
    right: bool


class Bin(NamedTuple):
    """Claims whose probability lies in a bin.

    Attributes:
        low: Lower end.
        high: Upper end.
        alarms: Number of alarms.
        suspicions: Number of suspicions.
        mean_probability: Mean probability.
        true: Share that is right.
        interval: Wilson's 95 % interval of that.
    """

    low: float
    high: float
    alarms: int
    suspicions: int
    mean_probability: float
    true: float
    interval: tuple[float, float]


def claims(
    alarms: Sequence[AlarmRecord],
    suspected: Iterable[SuspicionRecord],
    right: Callable[[str, int, Sequence[float]], bool] = lambda fault, time_ns, readings: False,
) -> list[Claim]:
    """Return the claims of a run.

    An alarm claims one name when it is raised. A suspicion claims that one of its names is right, and counts
    once in each bin that its probability enters.

    Args:
        alarms: Alarms.
        suspected: Suspicions.
        right: Function that takes a name, a time [ns] and readings, and returns whether the name is right.
    """
    all_claims = [
        Claim(alarm.sureness, True, right(alarm.fault, alarm.raised_ns, alarm.readings)) for alarm in alarms
    ]
    for suspicion in suspected:
        is_right = any(right(fault, suspicion.time_ns, suspicion.readings) for fault in suspicion.faults)
        all_claims.append(Claim(suspicion.probability, False, is_right))
    return all_claims


def bin_claims(all_claims: Sequence[Claim]) -> list[Bin]:
    """Sort claims into bins; return the bins that are not empty."""
    bins: list[Bin] = []
    for low, high in pairwise(LEVELS):
        members = [
            claim
            for claim in all_claims
            if low <= claim.probability < high or claim.probability == high == LEVELS[-1]
        ]
        if members:
            right, alarms = (sum(getattr(claim, name) for claim in members) for name in ("right", "alarm"))
            interval = binomtest(right, len(members)).proportion_ci(method="wilson")
            mean_probability = float(np.mean([claim.probability for claim in members]))
            ends = float(interval.low), float(interval.high)
            bins.append(
                Bin(low, high, alarms, len(members) - alarms, mean_probability, right / len(members), ends)
            )
    return bins


def draw(bins: Sequence[Bin], target: Path) -> None:
    """Draw the shares of right claims over their probabilities."""
    figure = Figure(figsize=(5.2, 5), layout="constrained")
    panel = figure.subplots()
    probabilities, shares = (
        np.array([group.mean_probability for group in bins]),
        np.array([group.true for group in bins]),
    )
    ends = np.array([group.interval for group in bins]).T
    panel.plot((0, 1), (0, 1), "--", color="#9a9a9a", lw=1.2, label="as often as is said")
    panel.errorbar(
        probabilities,
        shares,
        np.abs(ends - shares),
        fmt="o",
        ms=4,
        color="#1b4965",
        capsize=3,
        label="with 95 % interval",
    )
    for number, group in enumerate(reversed(bins)):
        count = str(group.alarms + group.suspicions)
        # The last bins are so narrow that their numbers stand on both sides.
        place = (4, -11) if number % 2 == 0 else (-4 - 5 * len(count), -11)
        panel.annotate(
            count, (group.mean_probability, group.true), place, textcoords="offset points", fontsize=8
        )
    panel.set(
        xlabel="probability that the shadow says",
        ylabel="share that is right",
        xlim=(0, 1.02),
        ylim=(-0.02, 1.02),
    )
    panel.spines[["top", "right"]].set_visible(False)
    panel.legend(loc="upper left", frameon=False, fontsize=8.5)
    figure.savefig(target, dpi=110)
