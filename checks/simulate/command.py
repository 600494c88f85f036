"""Seeded simulation of the whole system.

    python -m checks simulate run --hours 10             all scenarios in turn, seeds from 0
    python -m checks simulate run serve --hours 1 --first 500
    python -m checks simulate one serve 17               one seed, as a violation names it
    python -m checks simulate mutants                    every mutant until it is caught, and shrunk
    python -m checks simulate coverage                   lines of ports, log and host that are run

A violation is shrunk to the fewest faults, printed as a command, and kept in out/simulate for
tests/checks/regressions. The exit status is 1 if there was one, or if a mutant was not caught.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator
from itertools import count, islice
from pathlib import Path

from checks.simulate.case import SECONDS, Case
from checks.simulate.catalogue import mutants, scenarios
from checks.simulate.many import catch_mutant, in_processes, run_timed
from checks.simulate.shrink import shrink_case
from tools.command_table import command_line

CASES_FOLDER = Path("out/simulate")
"""Folder of the cases that violate an invariant."""

MOST_FAULTS = 5
"""Most faults of a shrunk mutant."""

SECONDS_COVERED = 120.0
"""Simulated time of a seed where lines are counted [s]."""

HOURS_COVERED = 2.0
"""Simulated time in which lines are counted [h]: six or seven seeds of each scenario."""

PACKAGES = ("ports", "log", "host")
"""Packages whose lines are counted."""

LEAST_COVERED = 85
"""Least share of their lines that the scenarios must run [%]."""

LEFT_OUT = "khep_twin/log/viewer"
"""Folder whose lines are not counted: rerun's threads and sockets stay outside the simulated kernel."""


def main() -> int:
    """Run the command; return the exit status."""
    parser = command_line(__doc__)
    parsers = parser.add_subparsers(required=True)
    for name, function in {"run": run, "one": one, "mutants": run_mutants, "coverage": coverage}.items():
        sub = parsers.add_parser(name, help=function.__doc__)
        sub.set_defaults(function=function)
        if name == "one":
            sub.add_argument("scenario", choices=scenarios())
            sub.add_argument("seed", type=int)
            sub.add_argument("--mutant", default="", choices=mutants(), help="broken build to run")
            sub.add_argument("--faults", help="names of the faults that happen, with commas between; all")
        else:
            choices = mutants() if name == "mutants" else scenarios()
            sub.add_argument(
                "names", nargs="*", choices=[*choices, []], metavar="NAME", help=", ".join(choices)
            )
            sub.add_argument("--first", type=int, default=0, help="first seed")
        if name in ("run", "coverage"):
            usual = HOURS_COVERED if name == "coverage" else 1.0
            sub.add_argument("--hours", type=float, default=usual, help="simulated time [h]")
        if name in ("run", "mutants"):
            sub.add_argument(
                "--jobs", type=int, default=os.cpu_count(), help="number of processes; 0: this one"
            )
        if name == "run":
            sub.add_argument("--no-shrink", dest="shrink", action="store_false", help="name violations only")
        default_s = {"mutants": None, "coverage": SECONDS_COVERED}.get(name, SECONDS)
        sub.add_argument("--seconds", type=float, default=default_s, help="simulated time of a seed [s]")
    options = parser.parse_args()
    return options.function(options)


def run(options: argparse.Namespace) -> int:
    """Run scenarios under seed after seed."""
    start_s = time.monotonic()
    hours, spent_s = Counter[str](), Counter[str]()
    counts, seeds = Counter[str](), Counter[str]()
    failures: list[Case] = []
    for case, outcome, case_s in in_processes(run_timed, _cases(options), options.jobs):
        hours[case.scenario] += outcome.simulated_ns / 3.6e12
        spent_s[case.scenario] += case_s
        seeds[case.scenario] += 1
        counts.update({f"{case.scenario} {name}": number for name, number in outcome.counts.items()})
        if outcome.violation is not None:
            print(f"{case.scenario} seed {case.seed}: {outcome.violation}", flush=True)
            failures.append(_save_case(shrink_case(case, outcome)) if options.shrink else case)
        _tell(
            f"{hours.total():.1f} of {options.hours:g} h, {seeds.total()} seeds, {len(failures)} violations"
        )
    for name in seeds:
        speed = f"{3600 * hours[name] / spent_s[name]:.0f} simulated s per s of processor time"
        print(f"{name}: {hours[name]:.1f} h, {seeds[name]} seeds, {speed}")
    for name, number in sorted(counts.items()):
        print(f"  {name}: {number}")
    print(
        f"{hours.total():.1f} simulated hours in {time.monotonic() - start_s:.0f} s, "
        f"{len(failures)} violations"
    )
    return 1 if failures else 0


def one(options: argparse.Namespace) -> int:
    """Run one seed and print its outcome."""
    faults = None if options.faults is None else tuple(filter(None, options.faults.split(",")))
    case = Case(options.scenario, options.seed, options.seconds, options.mutant, faults)
    outcome = case.run()
    for fault in outcome.faults:
        print(fault)
    print(json.dumps(outcome.counts))
    print(outcome.violation or f"no violation in {outcome.simulated_ns / 1e9:.0f} simulated seconds")
    return 1 if outcome.violation else 0


def run_mutants(options: argparse.Namespace) -> int:
    """Run mutants until they are caught, and shrink the cases that catch them."""
    names = options.names or [*mutants()]
    missed = 0
    searches = [(name, options.first, options.seconds) for name in names]
    for name, case, simulated_s in in_processes(catch_mutant, searches, options.jobs):
        n_faults = None if case is None else len(case.faults or ())
        if case is None or n_faults is None or n_faults > MOST_FAULTS:
            missed += 1
        if case is None:
            print(f"{name}: not caught in {simulated_s:.0f} s", flush=True)
        else:
            _save_case(case)
            print(
                f"{name}: {case.invariant}, seed {case.seed}, {simulated_s:.0f} s, {n_faults} faults",
                flush=True,
            )
    print(f"{len(names) - missed} of {len(names)} mutants caught, with {MOST_FAULTS} faults or fewer")
    return 1 if missed else 0


def coverage(options: argparse.Namespace) -> int:
    """Print the share of the lines of the ports, the log and the host library that scenarios run."""
    with tempfile.TemporaryDirectory() as folder:
        counted = f"{folder}/counted"
        measure = [sys.executable, "-m", "coverage"]
        ran = subprocess.run(
            [
                *(*measure, "run", f"--data-file={counted}", "--concurrency=greenlet"),
                "--source=" + ",".join(f"khep_twin.{name}" for name in PACKAGES),
                *("-m", "checks", "simulate", "run", *options.names, "--jobs", "0"),
                *("--hours", str(options.hours), "--first", str(options.first)),
                *("--seconds", str(options.seconds)),
            ],
            check=False,
        )
        print(f"{LEFT_OUT} is not counted: rerun's threads and sockets cannot be simulated")
        report_options = ["--show-missing", f"--omit=*/{LEFT_OUT}/*", f"--fail-under={LEAST_COVERED}"]
        report = subprocess.run([*measure, "report", f"--data-file={counted}", *report_options], check=False)
        return ran.returncode or report.returncode


def _cases(options: argparse.Namespace) -> Iterator[Case]:
    """Yield cases, a seed of each scenario in turn, for so many simulated hours."""
    n_cases = max(round(options.hours * 3600 / options.seconds), 1)
    names = options.names or [*scenarios()]
    seeds = count(options.first)
    turns = (Case(name, seed, options.seconds) for seed in seeds for name in names)
    return islice(turns, n_cases)


def _save_case(case: Case) -> Case:
    """Keep a case that fails, and print the command for it."""
    CASES_FOLDER.mkdir(parents=True, exist_ok=True)
    path = CASES_FOLDER / f"{case.mutant or case.scenario}-{case.invariant}-{case.seed}.toml"
    case.write(path)
    print(f"  {case.command()}", flush=True)
    return case


def _tell(text: str) -> None:
    if sys.stderr.isatty():
        print(f"\r{text}", end="", file=sys.stderr, flush=True)
