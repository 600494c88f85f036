"""Simulated sweeps: no error in the product, and each mutant is caught."""

import pytest

from checks.simulate.mutants import Mutant
from checks.simulate.simulation import simulate
from checks.simulate.sweeping import MUTANTS, SCENARIOS, _prepared

CAUGHT = {
    "sweep-late-result-added": (0, 30),
    "sweep-task-of-a-dead-worker-dropped": (1, 70),
    "sweep-torn-part-taken-as-whole": (1, 120),
    "sweep-resumed-from-nothing": (0, 60),
    "sweep-without-a-lock": (0, 350),
    "sweep-leaves-a-part-on-a-full-disk": (0, 160),
    "sweep-table-written-in-place": (5, 240),
}
"""Seed that catches each broken build, and simulated time [s] until then."""


@pytest.mark.share(2)
@pytest.mark.parametrize("seed", [0, 5])
def test_whatever_happens_to_sweeps_each_result_is_there_once(seed: int) -> None:
    outcome = simulate("sweep", SCENARIOS["sweep"], seed, 60)
    assert outcome.violation is None
    assert outcome.counts["tables"] > 5


def test_a_seed_is_the_same_sweeps_again() -> None:
    assert simulate("sweep", SCENARIOS["sweep"], 3, 40) == simulate("sweep", SCENARIOS["sweep"], 3, 40)


def test_a_study_outlives_a_simulation_that_ended_before_it_was_needed() -> None:
    """The first simulation of a process once took the files of all studies with it."""
    _prepared.cache_clear()
    assert simulate("sweep", SCENARIOS["sweep"], 0, 0.1).violation is None
    assert simulate("sweep", SCENARIOS["sweep"], 0, 20).violation is None


@pytest.mark.share(3)
@pytest.mark.parametrize(("name", "mutant"), MUTANTS.items())
def test_a_broken_sweep_is_caught(name: str, mutant: Mutant) -> None:
    seed, seconds = CAUGHT[name]
    with mutant.broken():
        assert simulate("sweep", SCENARIOS["sweep"], seed, seconds).invariant == mutant.invariant
