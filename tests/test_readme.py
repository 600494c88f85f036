"""The README: its commands and programs run as they stand."""

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from typer.testing import CliRunner

from khep_twin.cli.app import app
from tools import tutorial

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text()


def blocks(language: str) -> list[str]:
    return re.findall(rf"```{language}\n(.*?)```", README, re.DOTALL)


def test_it_is_read_in_a_few_minutes() -> None:
    assert len(README.splitlines()) <= 150


def test_about_ten_lines_drive_a_twin_and_name_the_port_of_a_robot() -> None:
    drives, _ = blocks("python")
    assert len([line for line in drives.splitlines() if line]) <= 10
    assert "/dev/ttyUSB0" in drives
    exec(compile(drives, "README.md", "exec"), {})


def test_about_ten_lines_learn() -> None:
    pytest.importorskip("gymnasium", reason="gymnasium, the extra [rl], is not installed")
    _, learns = blocks("python")
    assert len([line for line in learns.splitlines() if line]) <= 10
    names: dict[str, Any] = {}
    exec(compile(learns, "README.md", "exec"), names)
    assert names["observation"].shape == (10,)
    assert len(names["results"].metrics["obstacle_avoidance"]) == 10


def test_every_page_is_linked() -> None:
    pages = {f"docs/{page.name}" for page in (ROOT / "docs").glob("*.md")}
    assert pages - set(re.findall(r"\]\(([^)#]+)", README)) <= {"docs/simulation.md"}


def test_the_two_commands_are_the_makefiles() -> None:
    commands = [line.split("#")[0].strip() for line in blocks("sh")[0].splitlines()]
    assert commands == ["make run", "make test"]


@pytest.mark.long
def test_the_picture_is_the_one_that_make_run_leaves(tmp_path: Path) -> None:
    if not tutorial.same_numbers():
        pytest.skip(f"another machine than the picture's; here it is {tutorial.made_with()}")
    result = CliRunner().invoke(app, tutorial.make_run(tmp_path))
    assert result.exit_code == 0, result.output
    with (
        Image.open(tmp_path / "run.png") as new_image,
        Image.open(tutorial.PICTURES / "run.png") as page_image,
    ):
        assert new_image.size == page_image.size
        pixels = [np.asarray(picture.convert("RGB"), np.int16) for picture in (new_image, page_image)]
    other = np.abs(pixels[0] - pixels[1]).max(axis=2) > 40
    # A tenth of the way, two lines wide, are some 800 pixels.
    assert other.sum() < 100, "another path than the README's picture shows; `tools tutorial` draws it anew"
