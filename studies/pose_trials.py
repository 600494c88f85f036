"""Trials of the shadow's poses: sound stand-in robots with a known or unknown start."""

from pathlib import Path
from typing import NamedTuple

import numpy as np

from khep_twin.clock import NS_PER_S
from khep_twin.shadow.shadow import ShadowSettings
from studies.trial_tables import Options, head, note, row
from studies.twin_runs import Floats, Recording, follow

_KHEPERA, _KHEPERA4 = ("obstacles", "looping-maze", "workshop"), ("arena4", "arena4-room")
POSE = (
    *((playpen, asks) for asks in ("N", "N, H") for playpen in _KHEPERA),
    *((playpen, asks) for asks in ("N, R", "N, G", "N, G, R") for playpen in _KHEPERA4),
)
"""Playpens, and the requests of the host besides D; R is that of a Khepera IV for counters."""

UNKNOWN = "workshop", *_KHEPERA4

NEAR_MM = 30.0
"""Error up to which an initially unknown pose counts as found."""


class Errors(NamedTuple):
    """Errors of a run: distance [mm] and heading [degrees] of the estimate and of dead reckoning (n, 2)."""

    estimate: Floats
    reckoned: Floats
    alarms: list[str]


def pose(options: Options) -> None:
    """Print errors of poses whose start is known within 10 mm and 5 degrees."""
    head("playpen", "asks", "runs", "median", "95 %", "heading 95 %", "reckoned", "95 %", "heading 95 %")
    for playpen, asks in POSE:
        if playpen not in options.playpens:
            continue
        tasks = [
            (options.folder, playpen, seed, options.seconds, asks, options.settings)
            for seed in _seeds(options)
        ]
        runs: list[Errors] = list(options.run(pose_errors, tasks))
        estimate = np.concatenate([run.estimate for run in runs])
        reckoned = np.concatenate([run.reckoned for run in runs])
        row(playpen, f"{asks}, D", len(runs), *_quantiles(estimate), *_quantiles(reckoned))
        if options.detail:
            for task, run in zip(tasks, runs, strict=True):
                row("", f"seed {task[2]}", "", *_quantiles(run.estimate), *_quantiles(run.reckoned))
                note(run.alarms)
    print("\nErrors of position in mm, of heading in degrees, over all replies to N of all runs.\n")


def pose_errors(
    folder: Path, playpen: str, seed: int, seconds: float, asks: str, settings: ShadowSettings
) -> Errors:
    """Return the errors of one run."""
    name = {"N": "sound", "N, H": "counters"}.get(asks, asks.replace(", ", ""))
    recording = Recording(
        name, playpen, seed, seconds, asks_counters=asks[-1] in "HR", asks_echoes="G" in asks
    )
    path = recording.path(folder)
    run = follow(path, playpen, settings)
    alarm_texts = [f"{alarm.fault} at {alarm.raised_ns / NS_PER_S:.1f} s" for alarm in run.alarms]
    return Errors(run.errors(run.poses), run.errors(run.reckoned), alarm_texts)


def unknown(options: Options) -> None:
    """Print how many poses are found whose start is unknown."""
    head("playpen", "runs", "within 30 mm at 30 s", "at 60 s", "median error at 60 s")
    settings = options.settings
    lost = ShadowSettings(seed=settings.seed, particles=settings.particles, known=False)
    for playpen in (name for name in UNKNOWN if name in options.playpens):
        tasks = [(options.folder, playpen, seed, lost) for seed in _seeds(options)]
        errors: list[tuple[float, float]] = list(options.run(unknown_errors, tasks))
        errors_30_s, errors_60_s = np.array(errors).T
        row(
            playpen,
            len(errors),
            int((errors_30_s < NEAR_MM).sum()),
            int((errors_60_s < NEAR_MM).sum()),
            f"{np.median(errors_60_s):.0f} mm",
        )
        if options.detail:
            note(f"seed {task[2]}: {off:.0f} mm" for task, off in zip(tasks, errors_60_s, strict=True))
    print()


def unknown_errors(folder: Path, playpen: str, seed: int, settings: ShadowSettings) -> tuple[float, float]:
    """Return the errors of position after 30 and 60 s of a run [mm]."""
    recording = Recording("sound", playpen, seed, 60, asks_counters=playpen in _KHEPERA4)
    run = follow(recording.path(folder), playpen, settings)
    errors = run.errors(run.poses)[:, 0]
    half = int(np.searchsorted(run.times_ns, 30 * NS_PER_S)) - 1
    return float(errors[half]), float(errors[-1])


def _quantiles(errors: Floats) -> tuple[str, str, str]:
    median, high = np.quantile(errors[:, 0], (0.5, 0.95))
    return f"{median:.1f}", f"{high:.1f}", f"{np.quantile(errors[:, 1], 0.95):.1f}"


def _seeds(options: Options) -> range:
    return range(options.first, options.first + options.runs)
