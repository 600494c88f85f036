"""Hosts at a served pseudo-terminal, simulated."""

import pytest

from checks.simulate.serving import MUTANTS, SCENARIOS
from checks.simulate.simulation import simulate


@pytest.mark.share(2)
@pytest.mark.parametrize("seed", [4, 6])
def test_hosts_of_a_terminal_get_what_is_true_and_leave_the_motors_stopped(seed: int) -> None:
    first, second = (simulate("serve", SCENARIOS["serve"], seed, 60.0) for _ in range(2))
    assert first.violation is None
    assert first.faults
    assert first.counts["replies"] > 0
    assert first == second


def test_a_link_that_is_left_is_found() -> None:
    mutant = MUTANTS["a server leaves its link"]
    with mutant.broken():
        outcome = simulate("serve", SCENARIOS["serve"], 0, 100.0, ["server-stop/server/77"])
    assert outcome.invariant == mutant.invariant
