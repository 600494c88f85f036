"""docs/turrets.md: the page, followed literally in a copy of the tree, has the results that it shows."""

from pathlib import Path

import pytest
from page_follower import CHECKOUT, ROOT, PageFollower

from khep_twin.board.turrets import installed_turrets

PAGE = (ROOT / "docs" / "turrets.md").read_text()


@CHECKOUT
@pytest.mark.long
def test_the_package_on_the_page_works_and_the_turret_with_a_body_is_added_to_it(tmp_path: Path) -> None:
    follower = PageFollower(PAGE, tmp_path)
    for recipe in ("A turret of your own", "A turret with a body"):
        follower.follow(recipe)
        assert follower.output
    python = [name for name in follower.touched if name.endswith(".py")]
    assert len(python) == 4
    follower.run(f".venv/bin/ruff check --ignore D103 {' '.join(python)}")
    follower.run(f".venv/bin/ruff format --check {' '.join(python)}")


def test_the_page_names_each_turret_of_the_twin() -> None:
    for kind in installed_turrets().values():
        assert f"| `{kind.name}` | {kind.number} |" in PAGE
