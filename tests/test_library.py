"""The shipped playpens: each runs the Braitenberg controller for a while, and has a description."""

import pytest

from khep_twin import playpen as playpens
from khep_twin.files.toml_files import folder
from khep_twin.host import Khepera
from khep_twin.lab.experiment.controllers import BUILT_IN
from khep_twin.lab.experiment.experiment import run
from khep_twin.playpen import Playpen
from khep_twin.ports.protocol_khep import Serial
from khep_twin.ports.twin import TwinOptions, open_twin
from khep_twin.world import World

NAMES = [
    "deceptive-maze",
    "default",
    "garbage",
    "gripper",
    "homing",
    "landmark",
    "light-seeking",
    "looping-maze",
    "obstacles",
    "stripes",
    "swarm",
    "t-maze",
    "two-lamps",
    "wall-or-cylinder",
    "workshop",
]


ARENAS = [
    *("arena3", "arena3-line"),
    *("arena4", "arena4-line", "arena4-ramps", "arena4-room", "arena4-table", "arena4-two"),
]
"""Playpens of the Khepera III and IV."""


def test_these_playpens_ship() -> None:
    assert playpens.names() == [*ARENAS, *NAMES]


@pytest.mark.share(4)
@pytest.mark.parametrize("seconds", [3, pytest.param(30, marks=pytest.mark.long)])
@pytest.mark.parametrize("name", NAMES)
def test_a_braitenberg_vehicle_drives_without_a_warning(name: str, seconds: int) -> None:
    twin = open_twin(name, TwinOptions(seed=1))
    with Khepera(Serial.of(twin, timeout=1.0)) as robot:
        outcome = run(BUILT_IN["braitenberg"], robot, seconds=seconds)
        assert outcome.duration >= seconds
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
    world = World(Playpen.load("garbage"), noise=False)
    world.advance_to(2_000_000_000)
    # Below 0 is awake: the robot, and it alone.
    assert (world.data.tree_asleep >= 0).tolist() == [True] * 5 + [False]
    # It drives through where the cylinder on its right stands.
    world.robots[0].send(b"C,-340,340\nD,10,10\n")
    awake = set[int]()
    for tick in range(201, 1200):
        world.advance_to(tick * 10_000_000)
        awake |= {tree for tree, asleep in enumerate(world.data.tree_asleep.tolist()) if asleep < 0}
    assert len(awake) > 1
