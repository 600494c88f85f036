"""Trials of sound robots: false alarms, states, and the share of true poses inside the shadow's region."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from khep_twin.clock import NS_PER_S
from khep_twin.log.shadow_channels import PoseState
from khep_twin.shadow.shadow import ShadowSettings
from studies.twin_runs import AlarmRecord, Floats, Recording, ShadowRun, SuspicionRecord, alternate, follow

ALL = ("workshop", "obstacles", "looping-maze", "default", "homing", "light-seeking", "t-maze", "two-lamps")
"""Playpens of one robot without movable objects, which a shadow supports."""

KHEPERA4 = "arena4", "arena4-room"
"""Playpens of a Khepera IV, whose hosts ask N, G and R; trials have them by their options alone."""

ASTRAY_MM = 100.0
"""Error of a pose from which on it does not count as followed, even if the shadow states so."""

STARTS = "known start", "default start"
"""A start anywhere, which the shadow knows, and the start of the playpen or one of its spots."""

IN_REACH = 100
"""Counts from which something is in reach."""

BLIND_S = 30.0
"""Longest time without anything in reach for which the shadow should follow a robot [s]."""

NEVER_BLIND = f"in reach each {BLIND_S:g} s"
"""Row of those that are never blind for longer."""

_ELLIPSE = 5.991
"""Squared Mahalanobis distance within which 95 % of a Gaussian in two dimensions lie."""

_INTERVAL = 1.96
"""Standard deviations within which 95 % of a Gaussian lie."""


@dataclass(frozen=True)
class Healthy:
    """A sound robot, followed.

    Attributes:
        recording: Recording.
        state_s: Time in each state [s].
        errors_mm: Errors of position while it is followed (n,) [mm].
        inside: Whether position and heading lie in the region, while it is not lost (m, 2).
        blind_s: Longest time without anything in reach [s].
        astray_s: Longest time in state `followed` with an error above ASTRAY_MM [s].
        alarms: Alarms, all of them false.
        suspected: Suspicions.
        cpu_s: CPU time [s].
    """

    recording: Recording
    state_s: dict[str, float]
    errors_mm: Floats
    inside: NDArray[np.bool_]
    blind_s: float
    astray_s: float
    alarms: list[AlarmRecord]
    suspected: list[SuspicionRecord]
    cpu_s: float

    @property
    def rows(self) -> set[str]:
        """Return the rows of the table that it belongs to."""
        recording = self.recording
        reach_rows = {NEVER_BLIND} if self.blind_s <= BLIND_S else set[str]()
        return {recording.playpen, recording.host, STARTS[recording.default_start], "all", *reach_rows}

    @property
    def text(self) -> str:
        """Return its parameters and alarms as text."""
        recording, start = self.recording, STARTS[self.recording.default_start]
        alarms = ", ".join(f"{alarm.fault} at {alarm.raised_ns / NS_PER_S:.1f} s" for alarm in self.alarms)
        return (
            f"{recording.playpen}, {recording.host}, seed {recording.seed}, {start}: "
            f"{_quantile(self.errors_mm, 0.5)} mm, "
            f"blind {self.blind_s:.0f} s, astray {self.astray_s:.0f} s; {alarms or 'no alarm'}"
        )


def healthy_recordings(
    playpens: Sequence[str], hosts: Sequence[str], first: int, runs: int, seconds: float, times: str
) -> Iterator[Recording]:
    """Yield recordings of playpens with hosts in turn; half of them start at the playpen's start."""
    for i in range(runs):
        number = i // len(playpens)
        playpen, host = alternate(playpens, i), alternate(hosts, i % len(playpens) + number)
        is_default_start = (number + number // len(hosts) * (len(hosts) + 1)) % 2 == 1
        yield Recording(
            "healthy",
            playpen,
            first + i,
            seconds,
            host,
            asks_counters=playpen in KHEPERA4,
            times=times,
            default_start=is_default_start,
        )


def run_healthy(recording: Recording, folder: Path, settings: ShadowSettings) -> Healthy:
    """Make and follow a recording of a sound robot."""
    path = recording.path(folder)
    run = follow(path, recording.playpen, settings, start_known=not recording.default_start)
    lasts_s = np.diff(run.times_ns, append=run.times_ns[-1:]) / NS_PER_S
    errors_mm, is_followed = run.errors(run.poses)[:, 0], run.states == PoseState.FOLLOWED
    return Healthy(
        recording,
        {str(state): float(lasts_s[run.states == state].sum()) for state in PoseState},
        errors_mm[is_followed],
        inside(run)[run.states != PoseState.LOST],
        _longest(lasts_s, run.readings < IN_REACH),
        _longest(lasts_s, is_followed & (errors_mm > ASTRAY_MM)),
        run.alarms,
        run.suspected,
        float(run.cpu_s.sum()),
    )


def inside(run: ShadowRun) -> NDArray[np.bool_]:
    """Return whether the true position lies in the 95 % ellipse, the heading in its interval (n, 2)."""
    off = run.poses - run.actual
    off[:, 2] = (off[:, 2] + np.pi) % (2 * np.pi) - np.pi
    # A particle filter's covariance may be singular; a thousandth of a millimetre does not matter.
    plane = run.covariances[:, :2, :2] + 1e-12 * np.eye(2)
    distance = np.einsum("ni,nij,nj->n", off[:, :2], np.linalg.inv(plane), off[:, :2])
    heading = np.abs(off[:, 2]) <= _INTERVAL * np.sqrt(run.covariances[:, 2, 2])
    return np.stack([distance <= _ELLIPSE, heading], axis=1)


HEALTHY_COLUMNS = (
    *("hours", "alarms", "per hour", "followed", "unsure", "lost", "median", "95 %"),
    *("position inside", "heading inside", "astray", "CPU s per s", "names"),
)
"""Columns of the table of sound robots."""


def healthy_cells(runs: Sequence[Healthy]) -> list[str]:
    """Return the cells of a row about some of them."""
    state_s = {str(state): sum(run.state_s[state] for run in runs) for state in PoseState}
    total_s, names = sum(state_s.values()), [alarm.fault for run in runs for alarm in run.alarms]
    errors = np.concatenate([run.errors_mm for run in runs])
    within = np.concatenate([run.inside for run in runs])
    counts = sorted(((names.count(name), name) for name in set(names)), reverse=True)
    return [
        f"{total_s / 3600:.2f}",
        str(len(names)),
        f"{len(names) / total_s * 3600:.1f}",
        *(f"{100 * state_s[state] / total_s:.1f} %" for state in PoseState),
        _quantile(errors, 0.5),
        _quantile(errors, 0.95),
        *(f"{100 * share:.1f} %" for share in within.mean(axis=0)),
        f"{max(run.astray_s for run in runs):.0f} s",
        f"{sum(run.cpu_s for run in runs) / total_s:.2f}",
        ", ".join(f"{number} {name}" for number, name in counts),
    ]


def _longest(lasts_s: Floats, chosen: NDArray[np.bool_]) -> float:
    """Return the longest time for which updates are chosen without a break [s]."""
    longest = present = 0.0
    for lasts, is_chosen in zip(lasts_s.tolist(), chosen.tolist(), strict=True):
        present = present + lasts if is_chosen else 0.0
        longest = max(longest, present)
    return longest


def _quantile(errors: Floats, part: float) -> str:
    return f"{np.quantile(errors, part):.1f}" if len(errors) else ""
