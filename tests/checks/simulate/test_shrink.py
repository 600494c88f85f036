"""Shrinking of the faults of a failing case."""

from collections.abc import Sequence

from checks.simulate.shrink import fewest

FAULTS = [f"fault/{number}" for number in range(100)]


def test_a_failure_without_any_fault_needs_none() -> None:
    assert fewest(FAULTS, lambda _: True) == []


def test_faults_that_matter_together_are_found() -> None:
    needed_faults = {FAULTS[3], FAULTS[57], FAULTS[99]}
    assert set(fewest(FAULTS, needed_faults.issubset)) == needed_faults


def test_none_of_those_left_can_be_left_out() -> None:
    def fails(faults: Sequence[str]) -> bool:
        return len(faults) >= 4

    assert len(fewest(FAULTS, fails)) == 4


def test_few_runs_are_needed_where_the_last_fault_matters() -> None:
    n_runs = 0

    def fails(faults: Sequence[str]) -> bool:
        nonlocal n_runs
        n_runs += 1
        return FAULTS[-1] in faults

    assert fewest(FAULTS, fails) == [FAULTS[-1]]
    assert n_runs < 5
