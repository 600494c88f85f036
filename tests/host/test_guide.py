"""The code blocks of docs/host.md run unchanged."""

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

GUIDE = (Path(__file__).parents[2] / "docs" / "host.md").read_text()
BLOCKS = re.findall(r"```python\n(.*?)```", GUIDE, re.DOTALL)

GRIPPER_BLOCK, VISION_BLOCK = (
    next(block for block in BLOCKS if name in block) for name in ("gripper.close()", "a lamp is ahead")
)
PLAIN_BLOCKS = [block for block in BLOCKS if block not in (GRIPPER_BLOCK, VISION_BLOCK)]


@pytest.mark.parametrize("block", PLAIN_BLOCKS, ids=[str(number) for number in range(len(PLAIN_BLOCKS))])
def test_a_block_of_the_guide_runs(block: str) -> None:
    exec(compile(block, "docs/host.md", "exec"), {})


def test_the_gripper_grips() -> None:
    names: dict[str, Any] = {}
    exec(compile(GRIPPER_BLOCK, "docs/host.md", "exec"), names)
    assert names["robot"].port.twin.world.data.body("cylinder0").xpos[2] > 0.06


def test_the_vision_turret_finds_the_lamp() -> None:
    names: dict[str, Any] = {}
    exec(compile(VISION_BLOCK, "docs/host.md", "exec"), names)
    twin = names["robot"].port.twin
    x, y, heading = twin.robot.pose
    lamp = twin.world.playpen.lamps[0]
    bearing = np.arctan2(lamp.y_mm / 1e3 - y, lamp.x_mm / 1e3 - x) - heading
    assert abs(np.degrees(bearing)) < 8


def test_there_are_blocks() -> None:
    assert len(BLOCKS) == 8
