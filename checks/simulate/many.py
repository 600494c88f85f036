"""Cases in separate processes."""

import time
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import FIRST_COMPLETED, ProcessPoolExecutor, wait
from itertools import count, islice
from multiprocessing import get_context
from typing import TypeVar

from checks.simulate.case import Case
from checks.simulate.catalogue import mutants
from checks.simulate.shrink import shrink_case
from checks.simulate.simulation import Outcome

MUTANT_S = 3600.0
"""Simulated time within which a mutant must be caught [s]."""

Item, Result = TypeVar("Item"), TypeVar("Result")


def in_processes(function: Callable[[Item], Result], items: Iterable[Item], n_jobs: int) -> Iterator[Result]:
    """Yield the results of a function in other processes, as they come; in this one for 0 jobs."""
    if not n_jobs:
        yield from map(function, items)
        return
    rest = iter(items)
    with ProcessPoolExecutor(n_jobs, get_context("spawn")) as pool:
        waiting = {pool.submit(function, item) for item in islice(rest, 2 * n_jobs)}
        while waiting:
            finished, waiting = wait(waiting, return_when=FIRST_COMPLETED)
            waiting |= {pool.submit(function, item) for item in islice(rest, len(finished))}
            for future in finished:
                yield future.result()


def run_timed(case: Case) -> tuple[Case, Outcome, float]:
    """Run a case; return its outcome and the processor time that it took [s]."""
    start_s = time.process_time()
    return case, case.run(), time.process_time() - start_s


def catch_mutant(search: tuple[str, int, float | None]) -> tuple[str, Case | None, float]:
    """Return the shrunk case that catches a mutant, None if none does, and the simulated time [s]."""
    name, first, seconds = search
    mutant, simulated_s = mutants()[name], 0.0
    for seed in count(first):
        case = Case(mutant.scenario, seed, min(seconds or mutant.seconds, MUTANT_S - simulated_s), name)
        outcome = case.run()
        simulated_s += outcome.simulated_ns / 1e9
        if outcome.invariant == mutant.invariant:
            return name, shrink_case(case, outcome), simulated_s
        if simulated_s >= MUTANT_S - 1:
            return name, None, simulated_s
    raise AssertionError
