"""The check mutants: faults in one line, the tests that see them, and those that none sees."""

import argparse
import ast
import subprocess
from pathlib import Path

import pytest

from checks.mutants.command import draw, run
from checks.mutants.mutation import mutants_of

SOURCE = """
def largest(one: int, other: int, limit: int = 1 - 1) -> int:
    total = one + other
    if total > limit:
        return total
    return one if one in (1, 2) else 0


def text(word: str) -> str:
    return f"{1 + 1}" + word
"""

AREA = """
def add(one, other):
    print(one + other)


def is_small(one):
    print(one < 3)
"""

TESTS = """
from khep_twin.area import add


def test_a_sum(capsys):
    add(3, 4)
    assert capsys.readouterr().out == "7\\n"
"""


def test_each_kind_of_fault_is_made_and_can_be_parsed() -> None:
    mutants = mutants_of("area.py", SOURCE)
    changes = {mutant.diff(SOURCE).splitlines()[1].removeprefix("+").strip() for mutant in mutants}
    assert changes == {
        "total = (one - other)",
        "if (total <= limit):",
        "if (not total > limit):",
        "return (None)",
        "return one if (one not in (1, 2)) else 0",
        "return one if (not one in (1, 2)) else 0",
    }
    for mutant in mutants:
        ast.parse(mutant.source(SOURCE))


def make_tree(tree: Path, **sources: str) -> Path:
    """Return a project with these modules."""
    (tree / "khep_twin").mkdir(parents=True)
    (tree / "tests").mkdir()
    for name, source in sources.items():
        (tree / f"khep_twin/{name}.py").write_text(source)
    (tree / "tests/test_area.py").write_text(TESTS)
    (tree / "pyproject.toml").write_text('[tool.pytest.ini_options]\nmarkers = ["long: a whole"]\n')
    subprocess.run(["git", "init", "-q"], cwd=tree, check=True)
    return tree


def test_a_seed_draws_the_same_mutants_and_another_seed_others(tmp_path: Path) -> None:
    tree = make_tree(tmp_path, one=SOURCE, other=SOURCE)
    first, same, other = (draw(tree, seed, 4) for seed in (1, 1, 2))
    assert first == same != other
    assert len(set(first)) == 4
    assert len(draw(tree, 1, 1000)) == 2 * len(mutants_of("one.py", SOURCE))


@pytest.mark.long
def test_survivors_are_shown_by_line_and_diff(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    tree = make_tree(tmp_path / "tree", __init__="", area=AREA)
    options = argparse.Namespace(seed=1, count=1000, jobs=1, record=False)
    assert run(options, tree, tmp_path / "recording") == 1
    assert capsys.readouterr().out.splitlines() == [
        "khep_twin/area.py:7: comparison turned, 1 tests, which do not reach it",
        "-    print(one < 3)",
        "+    print((one >= 3))",
        "seed 1: 1 of 2 mutants killed",
    ]
    assert (tree / "khep_twin/area.py").read_text() == AREA
