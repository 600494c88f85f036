"""Simulated pages of the designer: no acknowledged work is lost, and broken builds lose it."""

import pytest

from checks.simulate.mutants import Mutant
from checks.simulate.paging import MUTANTS, SCENARIOS
from checks.simulate.simulation import simulate

CAUGHT = {
    "page-overwrites-a-changed-file": (0, 30),
    "page-two-saves-at-once": (1, 110),
    "page-draft-deleted-before-the-file-is-written": (0, 60),
    "page-edit-acknowledged-before-it-is-kept": (0, 20),
    "page-draft-written-in-place": (0, 60),
    "page-oldest-draft-offered-first": (0, 30),
    "page-part-left-on-a-full-disk": (0, 90),
    "page-twin-left-running": (0, 170),
    "page-refusal-that-is-a-failure": (0, 60),
    "page-refusal-without-a-line": (0, 60),
}
"""Seed that catches each broken build, and simulated time [s] until then."""


@pytest.mark.share(2)
@pytest.mark.parametrize("seed", [0, 4])
def test_whatever_happens_to_pages_no_work_is_lost(seed: int) -> None:
    outcome = simulate("page", SCENARIOS["page"], seed, 60)
    assert outcome.violation is None
    assert outcome.counts["edits"] > 10


def test_a_seed_is_the_same_pages_again() -> None:
    assert simulate("page", SCENARIOS["page"], 3, 30) == simulate("page", SCENARIOS["page"], 3, 30)


@pytest.mark.share(12)
@pytest.mark.parametrize(("name", "mutant"), MUTANTS.items())
def test_a_broken_page_is_caught(name: str, mutant: Mutant) -> None:
    seed, seconds = CAUGHT[name]
    with mutant.broken():
        assert simulate("page", SCENARIOS["page"], seed, seconds).invariant == mutant.invariant
