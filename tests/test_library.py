"""The shipped playpens: each runs the Braitenberg controller for two minutes, and says what it is."""

import pytest

from khep_twin import playpen as playpens
from khep_twin.host import Khepera
from khep_twin.lab.controllers import BUILT_IN
from khep_twin.lab.experiment import run
from khep_twin.playpen_to_mjcf import to_spec
from khep_twin.ports.protocol_khep import Serial
from khep_twin.ports.twin import TwinOptions, open_twin
from khep_twin.toml_files import folder

NAMES = [
    "default",
    "garbage",
    "gripper",
    "homing",
    "light-seeking",
    "looping-maze",
    "obstacles",
    "t-maze",
    "two-lamps",
    "wall-or-cylinder",
]


def test_these_playpens_ship() -> None:
    assert playpens.names() == NAMES


@pytest.mark.parametrize("name", NAMES)
def test_a_braitenberg_vehicle_drives_two_minutes_without_a_warning(name: str) -> None:
    twin = open_twin(name, TwinOptions(seed=1))
    with Khepera(Serial.of(twin, timeout=1.0)) as robot:
        outcome = run(BUILT_IN["braitenberg"], robot, seconds=120)
        assert outcome.duration >= 120
        assert not twin.world.data.warning.number.any()
        x, y, _ = twin.robot.pose
        arena = twin.world.playpen.arena
        assert 0 < x < arena.width_mm / 1e3
        assert 0 < y < arena.height_mm / 1e3


@pytest.mark.parametrize("name", NAMES)
def test_a_shipped_playpen_says_what_it_is(name: str) -> None:
    text = (folder("playpens") / f"{name}.toml").read_text()
    assert text.startswith("# ")


def test_what_moves_sleeps_until_it_is_pushed() -> None:
    twin = open_twin("garbage", TwinOptions())
    with twin:
        assert to_spec(twin.world.playpen).option.enableflags
