"""Registers of turrets in a snapshot: each within its range, and any within them runs."""

import numpy as np
import pytest

from khep_twin.board.turrets import installed_turrets
from khep_twin.errors import SnapshotError
from khep_twin.playpen import Playpen
from khep_twin.simulation.world_state import WorldState
from khep_twin.world import World

TURRETS = "gripper", "k213", "radio"


@pytest.fixture(scope="module", name="worlds")
def _worlds() -> dict[str, World]:
    scene = Playpen.load("default")
    worlds: dict[str, World] = {}
    for name in TURRETS:
        robot = scene.robots[0].model_copy(update={"turrets": (name,)})
        worlds[name] = World(scene.model_copy(update={"robots": (robot,)}), compiled=False)
    return worlds


def changed(state: WorldState, name: str, registers: tuple[int, ...]) -> WorldState:
    """Return a state with other registers of a turret."""
    robot = state.robots[0]
    firmware = robot.firmware._replace(turrets={name: registers})
    return state._replace(robots=(robot._replace(firmware=firmware),))


@pytest.mark.parametrize("name", TURRETS)
def test_registers_of_a_turret_outside_their_ranges_are_refused(worlds: dict[str, World], name: str) -> None:
    world, ranges = worlds[name], installed_turrets()[name].ranges
    world.reset(seed=1)
    state = world.state()
    registers = state.robots[0].firmware.turrets[name]
    assert sorted(ranges) == list(range(len(registers)))
    for register, (low, high) in ranges.items():
        for value in (low - 1, high + 1):
            damaged = (*registers[:register], value, *registers[register + 1 :])
            with pytest.raises(SnapshotError) as refused:
                world.set_state(changed(state, name, damaged))
            expected = f"registers of {name}[{register}] = {value}; expected {low} to {high}"
            assert expected in str(refused.value)


@pytest.mark.parametrize("name", TURRETS)
def test_a_turret_runs_from_any_registers_within_their_ranges(worlds: dict[str, World], name: str) -> None:
    world, ranges, rng = worlds[name], installed_turrets()[name].ranges, np.random.default_rng(3)
    world.reset(seed=1)
    state = world.state()
    limits = np.array([ranges[register] for register in sorted(ranges)])
    drawn = [rng.integers(limits[:, 0], limits[:, 1], endpoint=True) for _ in range(4)]
    for registers in (limits[:, 0], limits[:, 1], *drawn):
        world.set_state(changed(state, name, tuple(registers.tolist())))
        world.advance(0.05)
        after = world.state().robots[0].firmware.turrets[name]
        assert all(
            ranges[register][0] <= value <= ranges[register][1] for register, value in enumerate(after)
        )
        world.restore(world.snapshot())
