"""The step responses of docs/protocol.md, measured again: a robot of 70 g on the floor, default gains."""

import re
from pathlib import Path

import numpy as np
import pytest
from scenes import arena, robot

from khep_twin import playpen as playpens
from khep_twin.board.kernel import LEFT, Wheel
from khep_twin.units import TICK_NS
from khep_twin.world import World

TABLE = (Path(__file__).parents[2] / "docs" / "protocol.md").read_text()
FIELD = playpens.parse(arena(4000, 1000) + robot(200, 500), "field.toml")


def response(command: str, register: Wheel, ticks: int) -> np.ndarray:
    """A register of the left wheel after each control tick behind a command."""
    world = World(FIELD, noise=False, unpaced=True)
    world.robots[0].send(command.encode() + b"\n")
    values = []
    for tick in range(1, ticks + 1):
        world.advance_to(tick * TICK_NS)
        values.append(world.robots[0].registers[LEFT + register])
    return np.array(values)


def rows(letter: str) -> dict[int, list[int]]:
    """Rows of the table about a command: its argument, then numbers."""
    matches = re.findall(rf"^\| `{letter},(\d+),\d+` \|(.*)\|$", TABLE, re.MULTILINE)
    return {int(step): [int(cell) for cell in register_view.split("|")] for step, register_view in matches}


def settled(values: np.ndarray, goal: int, band: float) -> int:
    """First tick behind which the values stay within a band around the goal."""
    outside = np.flatnonzero(np.abs(values - goal) > band)
    return int(outside[-1]) + 2 if len(outside) else 1


@pytest.mark.parametrize(("speed", "row"), rows("D").items())
def test_the_speed_steps_are_those_of_the_documentation(speed: int, row: list[int]) -> None:
    speeds = response(f"D,{speed},{speed}", Wheel.SPEED, 150)
    rise = int(np.argmax(speeds >= 0.9 * speed)) + 1
    overshoot = int(speeds.max()) - speed
    settling = settled(speeds, speed, max(1, 0.05 * speed))
    assert [10 * rise, overshoot, 10 * settling] == row


@pytest.mark.share(2)
@pytest.mark.parametrize(("target", "row"), rows("C").items())
def test_the_moves_are_those_of_the_documentation(target: int, row: list[int]) -> None:
    command = f"C,{target},{target}"
    positions = response(command, Wheel.POSITION, 600)
    arrived = int(np.argmax(response(command, Wheel.ON_TARGET, 600))) + 1
    peak = int(response(command, Wheel.PROFILE_SPEED, 600).max()) / 256
    assert [10 * arrived, int(positions.max()) - target, round(peak)] == row
    assert abs(int(positions[-1]) - target) <= 2


def test_the_documentation_has_rows_to_compare() -> None:
    assert len(rows("D")) >= 4
    assert len(rows("C")) >= 4
