"""Bounds of the shadow's alarms: how far the explanations of a fault are apart in what is seen of it in time.

The evidence of an oracle's explanations (`fault_oracle`) 3 s after the first noticeable reply, with what was
known before, tells how probable the right name is for one that knows everything else, as far as twins drive
as the robot does. Where that is not sure, no alarm is right and sure in time but by luck.
"""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from khep_twin.clock import NS_PER_S
from khep_twin.shadow.sensor_model import log_sum_exp
from khep_twin.shadow.shadow import ShadowSettings
from studies.fault_oracle import Explanation, Oracle
from studies.fault_recordings import made
from studies.fault_trials import SOON_NS, looking_alike
from studies.trial_tables import Options, head, note, noticeable, row

BOUNDED = (
    "dead motor",
    "blocked wheel",
    "weak motor",
    "slipping wheel",
    "thing gone",
    "thing moved",
    "thing added",
    "robot lifted",
)
"""Faults that twins explain: those of wheels, of things and of the pose."""

SURE = 0.95
"""Probability from which on an oracle is sure."""


class Bound(NamedTuple):
    """What an oracle could tell of a trial.

    Attributes:
        gap: Evidence for the right name beyond that for the best other one.
        right: Probability of the right name.
        alike: Probability of that and those that look alike.
        text: Fault, its name and the best other explanations, and the host's speeds, for a person.
    """

    gap: float
    right: float
    alike: float
    text: str


def bounds(options: Options) -> None:
    """Print how many faults an oracle could name."""
    head("fault", "runs", "gap, median", "lowest", "right name sure", "or alike")
    for fault in options.faults:
        if fault not in BOUNDED:
            continue
        found = list(noticeable(run_bound, fault, options))
        gaps = [each.gap for _, each in found]
        row(
            fault,
            len(found),
            f"{np.median(gaps):.1f}" if gaps else "",
            f"{min(gaps):.1f}" if gaps else "",
            sum(each.right >= SURE for _, each in found),
            sum(each.alike >= SURE for _, each in found),
        )
        if options.detail:
            note(
                f"{'' if each.right >= SURE else 'OPEN '}seed {seed}, gap {each.gap:.1f}: {each.text}"
                for seed, each in found
            )
    print(
        f"\nGaps are log-likelihoods {SOON_NS / NS_PER_S:g} s after the first noticeable reply; sure is "
        f"{100 * SURE:g} %, for a filter that knows everything else.\n"
    )


def run_bound(
    fault: str, seed: int, folder: Path, settings: ShadowSettings, hosts: Sequence[str], times: str
) -> Bound | None:
    """Make a trial and return its bound; None if its fault is not noticeable; see `run_trial`."""
    trial = made(fault, seed, folder, hosts, times)
    if trial is None:
        return None
    seen_ns, ended_ns = int(trial.truth.noticeable_ns[0]), trial.ended_ns
    until_ns = seen_ns + SOON_NS if ended_ns < 0 else min(seen_ns + SOON_NS, ended_ns)
    oracle = Oracle(trial, settings, until_ns)
    found, names = oracle.explanations(), trial.trial.names
    chances = posterior(found)
    seen_s, after_s = ((each - trial.truth.changed_ns[0]) / NS_PER_S for each in (seen_ns, until_ns))
    return Bound(
        gap(found, names[0]),
        chances.get(names[0], 0.0),
        sum(chances.get(name, 0.0) for name in looking_alike(names)),
        f"{names[0]} ({trial.truth.hidden[0]}), seen after {seen_s:.1f} s, after {after_s:.1f} s "
        f"{_told(found, names[0])}; D {oracle.speeds}",
    )


def posterior(found: Sequence[Explanation]) -> dict[str, float]:
    """Return the probabilities of explanations, which exclude each other, by name."""
    logs = np.array([each.prior + each.evidence for each in found])
    return dict(zip([each.name for each in found], np.exp(logs - log_sum_exp(logs)).tolist(), strict=True))


def gap(found: Sequence[Explanation], name: str) -> float:
    """Return the evidence for a name beyond that for the best other one."""
    evidences = {each.name: each.evidence for each in found}
    right = evidences.pop(name, -math.inf)
    return right - max(evidences.values(), default=-math.inf)


def _told(found: Sequence[Explanation], name: str) -> str:
    """Tell a name and the best other explanations, by the evidence and by the probability, with both."""
    chances = posterior(found)
    others = [each for each in found if each.name != name]
    best = max(others, key=lambda each: each.evidence), max(others, key=lambda each: chances[each.name])
    told = [each for each in found if each.name == name or each in best]
    told.sort(key=lambda each: -each.evidence)
    return ", ".join(f"{each.name} {each.evidence:.1f} ({100 * chances[each.name]:.1f} %)" for each in told)
