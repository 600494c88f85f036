"""The Khepera Toolbox's example programs in Python, on a twin in this process."""

import runpy
from pathlib import Path

import pytest

from khep_twin.host import Khepera
from khep_twin.toolbox import serial_commands

EXAMPLES = Path(__file__).parents[2] / "examples" / "toolbox"


class Interrupted(Khepera):
    """A robot whose user presses Ctrl-C after a number of speed commands."""

    def __init__(self, url: str, cycles: int) -> None:
        super().__init__(url)
        self.cycles_left = cycles

    def set_speed(self, left: int, right: int) -> None:
        """Set the speed, or raise the interrupt."""
        self.cycles_left -= 1
        if self.cycles_left == 0:
            raise KeyboardInterrupt
        super().set_speed(left, right)


@pytest.fixture
def robot(no_screen: None) -> Interrupted:
    return Interrupted("khep://obstacles?seed=1", 500)


@pytest.mark.parametrize("name", ["brait", "brait_khepbase"])
def test_the_braitenberg_vehicle_wanders_until_it_is_interrupted(name: str, robot: Interrupted) -> None:
    serial_commands.ports({2: robot})
    if name == "brait_khepbase":
        robot.cycles_left = 20
    start = robot.port.twin.robot.pose
    with pytest.raises(KeyboardInterrupt):
        runpy.run_path(str(EXAMPLES / f"{name}.py"))
    x, y, heading = robot.port.twin.robot.pose
    assert robot.cycles_left == 0
    assert abs(x - start[0]) + abs(y - start[1]) > 0.05
    if name == "brait":
        assert abs(heading - start[2]) > 0.1
        assert not Path("khepbase.png").exists()
    else:
        assert Path("khepbase.png").exists()


def test_the_simulators_example_goes_ahead_and_turns_at_the_wall() -> None:
    names = runpy.run_path(str(EXAMPLES / "simsamp1.py"), run_name="__main__")
    btmap1 = names["btmap1"]
    _, y, heading = btmap1.twin.robot.pose
    assert btmap1.time == 50
    # 1000 cycles of 50 ms at 8 mm/s from the middle: it reached the upper wall and turned.
    assert y > 0.40
    assert abs(heading - 1.5708) > 0.2


def test_the_simulators_second_example_shows_khepbase(no_screen: None) -> None:
    names = runpy.run_path(str(EXAMPLES / "simsamp2.py"))
    names["simsamp2"](2, 20, 1, 0)
    assert names["btmap1"].time == 1
    assert Path("khepbase.png").exists()
