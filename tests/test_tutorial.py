"""docs/tutorial.md: the tutorial, followed literally, has the results that it shows."""

from pathlib import Path

import pytest
from PIL import Image

from tools import tutorial

PAGE = tutorial.PAGE.read_text()
BLOCKS = tutorial.blocks(PAGE)
PICTURES = tutorial.pictures(PAGE)


@pytest.mark.parametrize(
    "n_pictures", [1, pytest.param(len(PICTURES), marks=pytest.mark.long)], ids=["beginning", "whole"]
)
def test_a_reader_who_follows_the_tutorial_sees_what_it_shows(
    n_pictures: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PYTHONPATH", str(Path(__file__).parents[1]))  # for served twins
    pictures = PICTURES[:n_pictures]
    part = PAGE if pictures == PICTURES else PAGE.partition(f"pictures/tutorial_{pictures[-1]}")[0]
    with tutorial.reader(tmp_path, exact=tutorial.same_numbers()) as person:
        for block in BLOCKS[1 : len(tutorial.blocks(part))]:  # the first one has brought the reader here
            person.follow(block)
    for name in set(pictures) - set(person.undrawn):
        with (
            Image.open(tmp_path / name) as new_image,
            Image.open(tutorial.PICTURES / f"tutorial_{name}") as page_image,
        ):
            assert page_image.size == (
                tutorial.WIDTH,
                round(new_image.height * tutorial.WIDTH / new_image.width),
            ), name
    if person.undrawn:
        pytest.skip(f"{', '.join(person.undrawn)}: not drawn, as there is no Vulkan here")


def test_the_tutorial_begins_with_the_readmes_command() -> None:
    assert BLOCKS[0].text.splitlines() == [
        "make run",
        ". .venv/bin/activate",
        f"mkdir -p {tutorial.LAB}",
        f"cd {tutorial.LAB}",
    ]
    assert "make run " in (tutorial.PAGE.parents[1] / "README.md").read_text()


def test_pictures_of_the_tutorial_are_few_and_small() -> None:
    pictures = {path.name for path in tutorial.PICTURES.glob("tutorial_*.png")}
    assert pictures == {f"tutorial_{name}" for name in tutorial.pictures(PAGE)}
    assert all((tutorial.PICTURES / name).stat().st_size < 250_000 for name in pictures)


def test_pictures_of_the_docs_are_in_full_colour() -> None:
    for path in tutorial.PICTURES.glob("*.png"):
        with Image.open(path) as picture:
            assert picture.mode in ("RGB", "RGBA"), path.name


def test_what_is_shown_is_compared_but_for_its_numbers() -> None:
    assert tutorial.likeness("run   1  20 cycles in 3.71 s\n") == tutorial.likeness("run 1  9 cycles in 4 s")
    assert tutorial.likeness("left=-3, mean 1e-05") == tutorial.likeness("left=4, mean 0.2")
    assert tutorial.likeness("picture  a.png") != tutorial.likeness("picture  b.png")


def test_numbers_are_compared_where_they_were_made(tmp_path: Path) -> None:
    assert PAGE.count("<!-- Numbers made with: ") == 1
    assert "mujoco" in tutorial.made_with()
    for exact in (False, True):
        with tutorial.reader(tmp_path, exact) as person:
            person.follow(tutorial.Block(1, "python", "2\n"))
            person.follow(tutorial.Block(4, "text", "2\n"))
            if exact:
                with pytest.raises(AssertionError, match="line 8"):
                    person.follow(tutorial.Block(8, "text", "3\n"))
            else:
                person.follow(tutorial.Block(8, "text", "3\n"))


def test_what_is_shown_is_put_into_its_block() -> None:
    page = "a\n```text\n1\n2\n```\nb\n```text\n3\n```\n"
    first, second = tutorial.blocks(page)
    assert tutorial.replace_block(page, first, "4\n5\n") == page.replace("1\n2", "4\n5")
    assert tutorial.replace_block(page, second, "6\n") == page.replace("3", "6")


def test_another_output_than_the_page_shows_is_found(tmp_path: Path) -> None:
    with tutorial.reader(tmp_path) as person:
        person.follow(tutorial.Block(1, "python", "'one'\n2\n"))
        person.follow(tutorial.Block(4, "text", "'one'\n3\n"))
        with pytest.raises(AssertionError, match="line 9"):
            person.follow(tutorial.Block(9, "text", "'two'\n2\n"))
