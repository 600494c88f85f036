"""A program for the computer of a Khepera III, on its twin."""

from pathlib import Path

import pytest
from test_compiled_programs import machine_of, pytestmark, run_program

from khep_twin.world import World

__all__ = ["pytestmark"]


def test_a_program_finds_the_parts_of_a_khepera_iii_and_leaves_it_driving(
    programs: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    world = World("arena3", compiled=False)
    assert run_program([str(programs / "khepera3")], machine_of(world)) == 0
    assert capfd.readouterr().out.splitlines() == [
        "section Khepera3",
        "pin 40 1, word 0x10 0",
        "29 1",
        "2d -1",
        "31 1",
        "5 bytes: b 3.0",
        "27 bytes: n, ground 1",
        "-14 14",  # hundreds of pulses in 1 s, with the rise of the speed
    ]
    y = world.robots[0].pose[1]
    world.advance(1.0)
    speed = 10_000 / 218_720  # by the manual's 218.72 units per mm/s
    assert world.robots[0].pose[1] - y == pytest.approx(speed, rel=0.01)
