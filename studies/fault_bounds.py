"""Bounds of the shadow's alarms: differences of evidence between the explanations of a fault.

An oracle (`fault_oracle`) knows everything except the fault. Its evidence 3 s after the first noticeable
reply, with the prior odds, yields the probability of the right name, as far as twins drive as the robot
does. If that probability is low, no alarm can be right and certain in time, except by luck.
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
from studies.fault_recordings import record_trial
from studies.fault_trials import SOON_NS, add_similar_names
from studies.trial_tables import Options, head, note, noticeable, row

BOUNDED = (
    "dead motor",
    "blocked wheel",
    "weak motor",
    "slipping wheel",
    "object removed",
    "object moved",
    "object added",
    "robot lifted",
)
"""Faults that twins explain: those of wheels, of objects and of the pose."""

SURE = 0.95
"""Probability from which on an oracle is sure."""


class Bound(NamedTuple):
    """Result of an oracle for one trial.

    Attributes:
        gap: Evidence for the right name less that for the best alternative.
        p_right: Probability of the right name.
        p_alike: Probability of that name and similar ones together.
        text: Fault, its name and the best other explanations, and the host's speeds, for a person.
    """

    gap: float
    p_right: float
    p_alike: float
    text: str


def bounds(options: Options) -> None:
    """Print how many faults an oracle could name."""
    head("fault", "runs", "gap, median", "lowest", "right name sure", "or alike")
    for fault in options.faults:
        if fault not in BOUNDED:
            continue
        seed_bounds = list(noticeable(run_bound, fault, options))
        gaps = [bound.gap for _, bound in seed_bounds]
        row(
            fault,
            len(seed_bounds),
            f"{np.median(gaps):.1f}" if gaps else "",
            f"{min(gaps):.1f}" if gaps else "",
            sum(bound.p_right >= SURE for _, bound in seed_bounds),
            sum(bound.p_alike >= SURE for _, bound in seed_bounds),
        )
        if options.detail:
            note(
                f"{'' if bound.p_right >= SURE else 'OPEN '}seed {seed}, gap {bound.gap:.1f}: {bound.text}"
                for seed, bound in seed_bounds
            )
    print(
        f"\nGaps are log-likelihoods {SOON_NS / NS_PER_S:g} s after the first noticeable reply; sure is "
        f"{100 * SURE:g} %, for a filter that knows everything else.\n"
    )


def run_bound(
    fault: str, seed: int, folder: Path, settings: ShadowSettings, hosts: Sequence[str], times: str
) -> Bound | None:
    """Make a trial and return its bound; None if its fault is not noticeable; see `run_trial`."""
    trial = record_trial(fault, seed, folder, hosts, times)
    if trial is None:
        return None
    noticeable_ns, ended_ns = int(trial.truth.noticeable_ns[0]), trial.ended_ns
    end_ns = noticeable_ns + SOON_NS if ended_ns < 0 else min(noticeable_ns + SOON_NS, ended_ns)
    oracle = Oracle(trial, settings, end_ns)
    explanations, names = oracle.explanations(), trial.trial.names
    probabilities = posterior(explanations)
    noticeable_s, end_s = (
        (time_ns - trial.truth.changed_ns[0]) / NS_PER_S for time_ns in (noticeable_ns, end_ns)
    )
    return Bound(
        gap(explanations, names[0]),
        probabilities.get(names[0], 0.0),
        sum(probabilities.get(name, 0.0) for name in add_similar_names(names)),
        f"{names[0]} ({trial.truth.hidden[0]}), seen after {noticeable_s:.1f} s, after {end_s:.1f} s "
        f"{_describe(explanations, names[0])}; D {oracle.speeds}",
    )


def posterior(explanations: Sequence[Explanation]) -> dict[str, float]:
    """Return the probabilities of explanations, which exclude explanation other, by name."""
    logs = np.array([explanation.prior + explanation.evidence for explanation in explanations])
    return dict(
        zip(
            [explanation.name for explanation in explanations],
            np.exp(logs - log_sum_exp(logs)).tolist(),
            strict=True,
        )
    )


def gap(explanations: Sequence[Explanation], name: str) -> float:
    """Return the evidence for a name less that for the best alternative."""
    evidences = {explanation.name: explanation.evidence for explanation in explanations}
    right = evidences.pop(name, -math.inf)
    return right - max(evidences.values(), default=-math.inf)


def _describe(explanations: Sequence[Explanation], name: str) -> str:
    """Describe a name and the best alternatives by evidence and by probability, with both values."""
    probabilities = posterior(explanations)
    alternatives = [explanation for explanation in explanations if explanation.name != name]
    best = (
        max(alternatives, key=lambda explanation: explanation.evidence),
        max(alternatives, key=lambda explanation: probabilities[explanation.name]),
    )
    selection = [
        explanation for explanation in explanations if explanation.name == name or explanation in best
    ]
    selection.sort(key=lambda explanation: -explanation.evidence)
    return ", ".join(
        f"{explanation.name} {explanation.evidence:.1f} ({100 * probabilities[explanation.name]:.1f} %)"
        for explanation in selection
    )
