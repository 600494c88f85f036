"""Shrinking: the fewest faults with which a case still violates its invariant."""

from collections.abc import Callable, Sequence
from dataclasses import replace

from checks.simulate.case import Case
from checks.simulate.simulation import Outcome

_MARGIN_S = 60.0
"""Simulated time that a case with fewer faults may take longer to fail [s] (assumed)."""


def shrink_case(case: Case, outcome: Outcome) -> Case:
    """Return a case with the fewest faults that still violates the same invariant.

    Args:
        case: Case that fails.
        outcome: Outcome of it.
    """
    short = replace(case, seconds=min(case.seconds, outcome.simulated_ns / 1e9 + _MARGIN_S))

    def fails(faults: Sequence[str]) -> bool:
        return short.run(allowed=faults).invariant == outcome.invariant

    if not fails(outcome.faults):
        # It needs its whole length, as where only the end is checked.
        short = case
    faults = fewest(outcome.faults, fails)
    return replace(short, faults=tuple(faults), invariant=outcome.invariant)


def fewest(faults: Sequence[str], fails: Callable[[Sequence[str]], bool]) -> list[str]:
    """Return a part of the faults that still fails, and of which none can be left out (Zeller 2002).

    Args:
        faults: Faults that fail together.
        fails: Function that returns whether some of them fail.
    """
    if not faults or fails([]):
        return []
    left = list(faults)
    # The last ones before the failure are most often those that matter.
    n_last = 1
    while n_last < len(left):
        if fails(left[-n_last:]):
            left = left[-n_last:]
            break
        n_last *= 2
    n_parts = 2
    while len(left) > 1:
        size = -(-len(left) // n_parts)
        for start in range(0, len(left), size):
            if fails(rest := left[:start] + left[start + size :]):
                left, n_parts = rest, max(n_parts - 1, 2)
                break
        else:
            if n_parts >= len(left):
                break
            n_parts = min(2 * n_parts, len(left))
    return left
