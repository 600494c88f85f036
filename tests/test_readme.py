"""What the README shows works as it stands."""

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from typer.testing import CliRunner

from khep_twin import playpen
from khep_twin.cli.app import app
from khep_twin.host import Khepera
from tools import tutorial

README = (Path(__file__).parents[1] / "README.md").read_text()


def blocks(language: str) -> list[str]:
    return re.findall(rf"```{language}\n(.*?)```", README, re.DOTALL)


def test_the_ten_lines_drive_a_twin_and_are_the_same_for_a_robot() -> None:
    twin, robot, *_ = blocks("python")
    assert twin.replace("khep://obstacles?seed=1", "/dev/ttyUSB0") == robot
    assert len(twin.splitlines()) <= 10
    exec(compile(twin, "README.md", "exec"), {})


def test_the_gripper_grips() -> None:
    names: dict[str, Any] = {}
    exec(compile(blocks("python")[2], "README.md", "exec"), names)
    assert names["robot"].port.twin.world.data.body("cylinder0").xpos[2] > 0.06


def test_the_vision_turret_finds_the_lamp() -> None:
    names: dict[str, Any] = {}
    exec(compile(blocks("python")[3], "README.md", "exec"), names)
    twin = names["robot"].port.twin
    x, y, heading = twin.robot.pose
    lamp = twin.world.playpen.lamps[0]
    bearing = np.arctan2(lamp.y_mm / 1e3 - y, lamp.x_mm / 1e3 - x) - heading
    assert abs(np.degrees(bearing)) < 8


def test_the_controller_runs() -> None:
    names: dict[str, object] = {}
    exec(compile(blocks("python")[4], "README.md", "exec"), names)
    controller = names["controller"]
    assert callable(controller)
    with Khepera("khep://default") as robot:
        controller(robot)


def test_the_playpen_is_right() -> None:
    assert playpen.parse(blocks("toml")[0], "README.md").name == "mine"


def test_the_two_commands_are_the_makefiles() -> None:
    commands = [line.split("#")[0].strip() for line in blocks("sh")[0].splitlines()]
    assert commands == ["make run", "make test"]


def test_the_picture_is_the_one_that_make_run_leaves(tmp_path: Path) -> None:
    if not tutorial.same_numbers():
        pytest.skip(f"another machine than the picture's; here it is {tutorial.made_with()}")
    done = CliRunner().invoke(app, tutorial.make_run(tmp_path))
    assert done.exit_code == 0, done.output
    with Image.open(tmp_path / "run.png") as made, Image.open(tutorial.PICTURES / "run.png") as shown:
        assert made.size == shown.size
        pixels = [np.asarray(picture.convert("RGB"), np.int16) for picture in (made, shown)]
    other = np.abs(pixels[0] - pixels[1]).max(axis=2) > 40
    # A tenth of the way, two lines wide, are some 800 pixels.
    assert other.sum() < 100, "another path than the README's picture shows; `tools tutorial` draws it anew"


def test_the_environment_of_the_readme_takes_a_step() -> None:
    pytest.importorskip("gymnasium", reason="gymnasium, the extra [rl], is not installed")
    names: dict[str, Any] = {}
    exec(compile(blocks("python")[5], "README.md", "exec"), names)
    assert names["observation"].shape == (10,)
