"""CONTRIBUTING.md: its recipes, followed literally in a copy of the tree, have the results on the page."""

import re
from pathlib import Path

import pytest
from page_follower import CHECKOUT, CREATE, ROOT, PageFollower

PAGE = (ROOT / "CONTRIBUTING.md").read_text()
RECIPES = re.findall(r"^## (Add .*)$", PAGE, re.MULTILINE)


def test_there_are_three_recipes_on_a_short_page() -> None:
    assert RECIPES == ["Add a playpen part", "Add a command", "Add a task"]
    assert PAGE.count("\n") < 280


@CHECKOUT
@pytest.mark.long
@pytest.mark.parametrize("recipe", RECIPES)
def test_a_newcomer_who_follows_a_recipe_sees_what_it_shows(recipe: str, tmp_path: Path) -> None:
    follower = PageFollower(PAGE, tmp_path)
    follower.follow(recipe)
    assert follower.output


@CHECKOUT
@pytest.mark.long
def test_all_recipes_together_pass_the_check(tmp_path: Path) -> None:
    follower = PageFollower(PAGE, tmp_path, typing=False)
    for recipe in RECIPES:
        follower.follow(recipe)
    python = sorted({name for name in follower.touched if name.endswith(".py")})
    follower.run(".venv/bin/ruff check -q --fix khep_twin; .venv/bin/ruff format -q khep_twin")
    follower.run(f".venv/bin/ruff check {' '.join(python)}")
    follower.run(f".venv/bin/ruff format --check {' '.join(python)}")
    follower.run(f".venv/bin/pyright {' '.join(name for name in python if name.startswith('khep_twin'))}")


def test_the_page_names_all_targets_of_the_makefile() -> None:
    targets = re.findall(r"^([a-z0-9-]+):.*##", (ROOT / "Makefile").read_text(), re.MULTILINE)
    assert set(re.findall(r"(?:^|`)make ([a-z0-9-]+)", PAGE, re.MULTILINE)) == set(targets) - {"run", "clean"}


def test_the_files_and_pages_on_it_are_there() -> None:
    created = {step["file"] for step in CREATE.finditer(PAGE)}
    named = re.findall(r"`((?:khep_twin|tests|checks|tools|docs)/[^` ]*)`", PAGE) + re.findall(
        r"\]\(([^)#]+)", PAGE
    )
    assert len(named) > 10
    assert not [name for name in named if name not in created and not (ROOT / name).exists()]
