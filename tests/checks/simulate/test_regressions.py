"""Cases in which the simulation once found a violation, or finds one in a broken build."""

from pathlib import Path

import pytest

from checks.simulate.case import Case

CASES = sorted(Path(__file__).parent.parent.joinpath("regressions").glob("*.toml"))

BROKEN = [path for path in CASES if Case.read(path).mutant]


@pytest.mark.share(18)
@pytest.mark.parametrize("path", CASES, ids=lambda path: path.stem)
def test_the_product_as_it_is_keeps_the_invariant(path: Path) -> None:
    assert Case.read(path).sound().run().violation is None


@pytest.mark.share(6)
@pytest.mark.parametrize("path", BROKEN, ids=lambda path: path.stem)
def test_the_broken_build_is_caught_with_few_faults(path: Path) -> None:
    case = Case.read(path)
    assert len(case.faults or ()) <= 5
    assert case.run().invariant == case.invariant
