"""The catalogue: every broken build can be made from the present code."""

from checks.simulate.catalogue import mutants, scenarios


def test_each_mutant_breaks_what_is_there() -> None:
    for name, mutant in mutants().items():
        assert mutant.scenario in scenarios(), name
        with mutant.broken():  # raises an error for a function that is gone
            pass
