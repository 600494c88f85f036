"""Hosts at network ports and in lock-step with a twin, simulated."""

import pytest

from checks.simulate.networking import MUTANTS, SCENARIOS
from checks.simulate.simulation import simulate


@pytest.mark.share(6)
@pytest.mark.parametrize("name", SCENARIOS)
@pytest.mark.parametrize("seed", [2, 4])
def test_hosts_get_what_is_true_or_an_error_and_leave_the_motors_stopped(name: str, seed: int) -> None:
    outcome = simulate(name, SCENARIOS[name], seed, 20.0)
    assert outcome.violation is None
    assert outcome.counts["values"] > 0
    assert outcome.counts["speeds"] > 0


@pytest.mark.share(4)
@pytest.mark.parametrize(("name", "seed"), [("rfc2217", 11), ("tcp", 11), ("lockstep", 1)])
def test_a_seed_repeats_every_turn_of_its_processes(name: str, seed: int) -> None:
    first, second = (simulate(name, SCENARIOS[name], seed, 15.0) for _ in range(2))
    assert first == second
    assert first.faults


@pytest.mark.share(3)
@pytest.mark.parametrize(
    ("name", "seed"),
    [
        ("leaving does not stop the motors", 0),
        ("counters are ahead of the wheels", 0),
        ("a speed sets one wheel", 0),
        ("negotiation is not answered", 0),
        ("left and right are swapped", 0),
        ("an error does not name its port", 7),
    ],
)
def test_a_broken_build_is_caught(name: str, seed: int) -> None:
    mutant = MUTANTS[name]
    with mutant.broken():
        outcome = simulate(mutant.scenario, SCENARIOS[mutant.scenario], seed, 30.0)
    assert outcome.invariant == mutant.invariant
