"""Trials of the shadow: it follows stand-in robots by their serial lines alone.

    python -m studies twin-trials                        # all of them: hours
    python -m studies twin-trials pose --runs 4 --seconds 120
    python -m studies twin-trials alarms --fault "dead motor" --runs 6 --detail
    python -m studies twin-trials bounds --fault "weak motor" --runs 6 --detail
    python -m studies twin-trials healthy --hours 20 --jobs 2

    python -m studies twin-trials pose --playpen arena4 --playpen arena4-room

The robots are varied robots of the same model, simulated in MuJoCo, Kheperas with a line at 9600 baud. Their
hosts ask N and set speeds; those of a Khepera IV also ask its counters and its distances by ultrasound. The
same options give the same tables, except for CPU times.
"""

import sys
from collections import Counter
from collections.abc import Callable, Generator, Iterable
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from itertools import starmap
from multiprocessing import get_context
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from khep_twin.clock import NS_PER_S
from khep_twin.errors import KhepTwinError
from khep_twin.shadow.shadow import ShadowSettings
from stand_ins.hosts import HOSTS, hosts_of
from stand_ins.line_times import TIMES
from studies.fault_bounds import bounds
from studies.fault_recordings import FAULTS
from studies.fault_trials import FADES_NS, run_trial
from studies.healthy_trials import (
    ALL,
    HEALTHY_COLUMNS,
    KHEPERA4,
    NEVER_BLIND,
    STARTS,
    Healthy,
    healthy_cells,
    healthy_recordings,
    run_healthy,
)
from studies.pose_trials import pose, unknown
from studies.reliability import bin_claims, claims, draw
from studies.trial_tables import Map, Options, count_text, head, note, noticeable, row
from studies.twin_runs import Recording, follow
from tools.command_table import command_line


def alarms(options: Options) -> None:
    """Print how many faults are named."""
    head(
        "fault",
        "runs",
        "named in 3 s",
        "or alike",
        "median delay",
        "ended in 5 s",
        "ended",
        "median, longest",
        "wrong names",
    )
    for fault in options.faults:
        seed_outcomes = list(noticeable(run_trial, fault, options))
        if not seed_outcomes:
            row(fault, 0, *[""] * 7)
            continue
        outcomes = [outcome for _, outcome in seed_outcomes]
        ends = [outcome for outcome in outcomes if outcome.has_end]
        times = [outcome.end_s for outcome in ends if not np.isnan(outcome.end_s)]
        delays = [outcome.delay_s for outcome in outcomes if not np.isnan(outcome.delay_s)]
        row(
            fault,
            len(seed_outcomes),
            sum(outcome.named for outcome in outcomes),
            sum(outcome.paired for outcome in outcomes),
            f"{np.median(delays):.1f} s" if delays else "",
            f"{sum(end_s <= FADES_NS / NS_PER_S for end_s in times)} of {len(ends)}" if ends else "",
            len(times) if ends else "",
            f"{np.median(times):.1f}, {max(times):.1f} s" if times else "",
            count_text(Counter(name for outcome in outcomes for name in outcome.wrong)),
        )
        if options.detail:
            note(
                f"{'' if outcome.named else 'NOT NAMED '}seed {seed}, {outcome.text} "
                f"(busiest {outcome.busiest_s:.2f})"
                for seed, outcome in seed_outcomes
            )
    print("\nRuns are those with a noticeable fault; delays and ends count from the first reply with them.\n")


def healthy(options: Options) -> None:
    """Print alarms, states, errors and regions of sound robots."""
    runs: list[Healthy] = []
    for run in _healthy(options):
        runs.append(run)
        if options.detail:
            note([run.text])
    head("", *HEALTHY_COLUMNS)
    hosts = options.hosts or hosts_of(options.first)
    for name in (*options.playpens, *hosts, *STARTS, NEVER_BLIND, "all"):
        if part := [run for run in runs if name in run.rows]:
            row(name, *healthy_cells(part))
    print(
        "\nErrors of position in mm while it is followed; regions are those of 95 %, while it is not lost.\n"
    )


def _healthy(options: Options) -> Iterable[Healthy]:
    runs = max(round(options.hours * 3600 / options.seconds), 1)
    hosts = options.hosts or hosts_of(options.first)
    tasks = [
        (recording, options.folder, options.settings)
        for recording in healthy_recordings(
            options.playpens, hosts, options.first, runs, options.seconds, options.times
        )
    ]
    return options.run(run_healthy, tasks)


def reliability(options: Options) -> None:
    """Print the share of right claims by their probability, over sound and faulty robots."""
    all_claims = [claim for run in _healthy(options) for claim in claims(run.alarms, run.suspected)]
    for fault in options.faults:
        all_claims += [
            claim for _, outcome in noticeable(run_trial, fault, options) for claim in outcome.claims
        ]
    head("probability", "alarms", "suspicions", "stated, mean", "right", "95 % interval")
    for group in bin_claims(all_claims):
        shares = (f"{100 * share:.1f} %" for share in (group.mean_probability, group.true, *group.interval))
        said_share, true, low, high = shares
        row(
            f"{100 * group.low:g} to {100 * group.high:g} %",
            group.alarms,
            group.suspicions,
            said_share,
            true,
            f"{low} to {high}",
        )
    print("\nA suspicion counts once in each bin that its probability enters.\n")
    if options.picture is not None:
        draw(bin_claims(all_claims), options.picture)


def stalls(options: Options) -> None:
    """Print the same of robots whose line stalls for 0.3 s in each ten seconds."""
    healthy(options._replace(times="stalls"))


def cost(options: Options) -> None:
    """Print the CPU time of each playpen."""
    head("playpen", "CPU s per s", "busiest 10 s", "after a lift, busiest 10 s", "busiest 1 s")
    for playpen in ALL:
        sound = Recording("sound", playpen, options.first, 60).path(options.folder)
        lifted = "brown-out@20", "weak:left:0.12@22"
        ill = Recording("ill", playpen, options.first, 60, faults=lifted).path(options.folder)
        follow(sound, playpen, options.settings)  # Compiled code is loaded.
        well, diagnosed = (follow(path, playpen, options.settings).cpu_s for path in (sound, ill))
        busy = np.convolve(diagnosed, np.full(10, 0.1), "valid").max()
        row(
            playpen,
            f"{well.mean():.3f}",
            f"{np.convolve(well, np.full(10, 0.1), 'valid').max():.3f}",
            f"{busy:.3f}",
            f"{diagnosed.max():.2f}",
        )
    print(f"\n{options.settings.particles} particles; shares of one core at real time.\n")


SECTIONS: dict[str, Callable[[Options], None]] = {
    "pose": pose,
    "unknown": unknown,
    "alarms": alarms,
    "bounds": bounds,
    "healthy": healthy,
    "stalls": stalls,
    "reliability": reliability,
    "cost": cost,
}


@contextmanager
def _jobs(count: int) -> Generator[Map]:
    """Yield a map over this number of processes."""
    if count == 1:
        yield starmap
        return
    with ProcessPoolExecutor(count, get_context("spawn")) as pool:
        yield lambda function, tasks: pool.map(function, *zip(*tasks, strict=True))


def main() -> None:
    """Run the requested trials."""
    parser = command_line(__doc__)
    parser.add_argument("trials", nargs="?", choices=SECTIONS, help="which trials; all without it")
    parser.add_argument("--runs", type=int, default=20, help="number of runs of each kind")
    parser.add_argument("--seconds", type=float, default=300.0, help="length of a run of a sound robot [s]")
    parser.add_argument("--hours", type=float, default=2.0, help="simulated hours of healthy robots")
    parser.add_argument("--fault", action="append", choices=FAULTS, help="for alarms, bounds; all without")
    parser.add_argument(
        "--playpen", action="append", choices=(*ALL, *KHEPERA4), help="one; all of a Khepera without"
    )
    parser.add_argument(
        "--host", action="append", choices=HOSTS, help="a host; all that a seed may have without"
    )
    parser.add_argument("--times", choices=TIMES, default="exact", help="times of the line")
    parser.add_argument("--first", type=int, default=0, help="seed of the first run")
    parser.add_argument("--particles", type=int, default=1000, help="number of particles")
    parser.add_argument("--jobs", type=int, default=1, help="number of processes")
    parser.add_argument("--keep", type=Path, help="folder of recordings, which are reused if they are there")
    parser.add_argument("--detail", action="store_true", help="also print a line for each run")
    parser.add_argument(
        "--picture", type=Path, help="picture of the reliability to draw, FILE.svg or FILE.png"
    )
    options = parser.parse_args()
    with TemporaryDirectory() as scratch, _jobs(options.jobs) as run:
        folder: Path = options.keep or Path(scratch)
        folder.mkdir(parents=True, exist_ok=True)
        settings = ShadowSettings(particles=options.particles)
        trial_options = Options(
            folder,
            options.runs,
            options.seconds,
            options.hours,
            options.first,
            options.fault or list(FAULTS),
            options.playpen or ALL,
            options.host or (),
            options.times,
            settings,
            options.detail,
            options.picture,
            run,
        )
        try:
            for section in [options.trials] if options.trials else SECTIONS:
                print(f"## {section}\n")
                SECTIONS[section](trial_options)
        except (KhepTwinError, OSError) as error:
            sys.exit(str(error))
