"""Trials of the shadow's alarms: stand-in robots with one fault each, and whether it is named.

Trials in which the fault is not noticeable (`stand_ins.Truth`) are left out. A fault is named correctly if an
alarm with a right name is raised after its start and at most 3 s after it is noticeable.
"""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from khep_twin.clock import NS_PER_S
from khep_twin.log.shadow_channels import FAULT_SEPARATOR
from khep_twin.shadow.shadow import ShadowSettings
from stand_ins.recordings import Truth
from studies.fault_recordings import STANDING, record_trial
from studies.reliability import Claim, claims
from studies.twin_runs import AlarmRecord, SuspicionRecord, follow

SOON_NS = 3 * NS_PER_S
"""Longest time from a noticeable fault to its alarm [ns]."""

FADES_NS = 5 * NS_PER_S
"""Time after the noticeable end of a fault in which an alarm still counts as right [ns]."""

SIMILAR_FAULTS = ("weak motor", "slipping wheel", STANDING), ("missing", "moved")
"""Faults with similar replies for a while."""


class Outcome(NamedTuple):
    """Outcome of a trial.

    Attributes:
        named: Whether the fault was named correctly in time.
        paired: Whether its name or a similar one was raised in time.
        delay_s: Time of that after the fault was noticeable [s]; NaN without a right name.
        wrong: Other names.
        end_s: Time for which a right name outlasted the first reply that showed the fault's end [s]; NaN if
            the name did not end, none was given, or no reply showed it.
        has_end: Whether the fault was named, and its end is noticeable.
        busiest_s: CPU time of the busiest second [s].
        text: Fault, names and times, for a person.
        claims: Alarms and suspicions, and whether they are right.
    """

    named: bool
    paired: bool
    delay_s: float
    wrong: tuple[str, ...]
    end_s: float
    has_end: bool
    busiest_s: float
    text: str
    claims: list[Claim]


def run_trial(
    fault: str, seed: int, folder: Path, settings: ShadowSettings, hosts: Sequence[str], times: str
) -> Outcome | None:
    """Make and follow a trial; return None if its fault is not noticeable.

    Args:
        fault: One of FAULTS.
        seed: Seed of the trial.
        folder: Folder of recordings.
        settings: Settings of the shadow.
        hosts: Hosts that alternate; without any, those of the seed.
        times: Times of the line.
    """
    recorded = record_trial(fault, seed, folder, hosts, times)
    if recorded is None:
        return None
    followed = follow(recorded.path, recorded.room, settings)
    outcome = judge(
        recorded.trial.names, recorded.truth, recorded.over_ns, followed.alarms, followed.suspected
    )
    return outcome._replace(busiest_s=float(followed.cpu_s.max()))


def judge(
    names: tuple[str, ...],
    truth: Truth,
    over_ns: int,
    alarms: list[AlarmRecord],
    suspected: Sequence[SuspicionRecord] = (),
) -> Outcome:
    """Judge the alarms of a trial.

    Args:
        names: Right names.
        truth: Truth of the recording; the fault is its first hidden change.
        over_ns: Arrival of the first reply that its end changes noticeably [ns]; -1 if none is: then a name
            that was right once stays right.
        alarms: Alarms of the shadow.
        suspected: Its suspicions.
    """
    onset_ns, noticeable_ns = int(truth.changed_ns[0]), int(truth.noticeable_ns[0])
    right = [
        alarm
        for alarm in alarms
        if alarm.raised_ns >= onset_ns and _is_right(alarm.fault, alarm.readings, names)
    ]
    similar = add_similar_names(names)
    paired = [
        alarm
        for alarm in alarms
        if alarm.raised_ns >= onset_ns
        and (_pair_has(alarm.fault, names) or similar >= {*alarm.fault.split(FAULT_SEPARATOR)})
    ]
    alike_ns = [alarm.raised_ns for alarm in [*right, *paired]]
    delay_s = (right[0].raised_ns - noticeable_ns) / NS_PER_S if right else math.nan
    last_ns = max((alarm.ended_ns for alarm in right), default=-1)
    lasting = any(alarm.ended_ns < 0 for alarm in right)
    has_end = bool(right) and over_ns >= 0
    end_s = math.nan if lasting or not has_end else max(last_ns - over_ns, 0) / NS_PER_S
    lines = [
        f"{alarm.fault} {alarm.raised_ns / NS_PER_S:.1f} to "
        + (f"{alarm.ended_ns / NS_PER_S:.1f}" if alarm.ended_ns >= 0 else "the end")
        for alarm in alarms
    ]
    text = f"{truth.hidden[0]} at {onset_ns / NS_PER_S:.1f}, seen {noticeable_ns / NS_PER_S:.1f}"
    text += f", over {over_ns / NS_PER_S:.1f}: " if over_ns >= 0 else ": "
    return Outcome(
        bool(right) and right[0].raised_ns <= noticeable_ns + SOON_NS,
        any(onset_ns <= raised_ns <= noticeable_ns + SOON_NS for raised_ns in alike_ns),
        delay_s,
        tuple(
            alarm.fault
            for alarm in alarms
            if alarm not in right and not (alarm in paired and FAULT_SEPARATOR in alarm.fault)
        ),
        end_s,
        has_end,
        0.0,
        text + ("; ".join(lines) or "no alarm"),
        claims(
            alarms,
            suspected,
            lambda fault, time_ns, readings: (
                onset_ns <= time_ns
                and (over_ns < 0 or time_ns <= over_ns + FADES_NS)
                and (_is_right(fault, readings, names) or _pair_has(fault, names))
            ),
        ),
    )


def add_similar_names(names: Sequence[str]) -> set[str]:
    """Return names with those of similar faults of the same wheel or object."""
    matches = {
        (kinds, name.removeprefix(kind))
        for name in names
        for kinds in SIMILAR_FAULTS
        for kind in kinds
        if name.startswith(kind)
    }
    return {*names, *(kind + rest for kinds, rest in matches for kind in kinds)}


def _pair_has(fault: str, names: Sequence[str]) -> bool:
    """Return whether an alarm of several names has a right one."""
    return FAULT_SEPARATOR in fault and any(
        FAULT_SEPARATOR + name + FAULT_SEPARATOR in FAULT_SEPARATOR + fault + FAULT_SEPARATOR
        for name in names
    )


def _is_right(fault: str, readings: Sequence[float], names: tuple[str, ...]) -> bool:
    """Return whether a fault has a right name; a sensor that is stuck at 0 equals a dead one."""
    return fault in names and (fault == names[0] or readings[int(fault[-1])] == 0)
