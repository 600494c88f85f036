"""Snapshots of a Khepera IV and its neighbours: a damaged one is refused in one line with place and value."""

import zlib

import numpy as np
import pytest

from khep_twin.errors import DivergedError, SnapshotError
from khep_twin.log.recorded import BranchPoint
from khep_twin.playpen import Playpen
from khep_twin.playpen.changes import set_values
from khep_twin.ports.resume import transfer_world
from khep_twin.simulation.world_state import WorldState
from khep_twin.world import World

NAN, INF = np.float64("nan").tobytes(), np.float64("inf").tobytes()
KHEPERA4, KHEPERA = 0, 2


@pytest.fixture(scope="module", name="world")
def _world() -> World:
    world = World("arena4-two", seed=2, compiled=False)
    world.robots[0].send(b"D,150,120\r\n")
    world.advance(0.3175)
    return world


@pytest.fixture(scope="module", name="state")
def _state(world: World) -> WorldState:
    return world.state()


def changed(state: WorldState, index: int, **fields: object) -> WorldState:
    """Return a state with other fields of a robot."""
    robots = list(state.robots)
    robots[index] = robots[index]._replace(**fields)
    return state._replace(robots=tuple(robots))


def with_array(state: WorldState, index: int, name: str, data: bytes) -> WorldState:
    """Return a state with another array of a robot."""
    return changed(state, index, arrays={**state.robots[index].arrays, name: data})


def refusal(world: World, state: WorldState) -> str:
    """Return the message of a state that a world refuses."""
    with pytest.raises(SnapshotError) as refused:
        world.set_state(state)
    message = str(refused.value)
    assert "\n" not in message
    return message


@pytest.mark.parametrize("index", [KHEPERA4, KHEPERA])
def test_an_array_of_another_length_is_refused_wherever_numbers_are_missing(
    world: World, state: WorldState, index: int
) -> None:
    for name, data in state.robots[index].arrays.items():
        starts = sorted({0, 8, len(data) // 16 * 8, max(len(data) - 8, 0)} & set(range(0, len(data), 8)))
        damaged = [data[:start] + data[start + 8 :] for start in starts] + [data + bytes(8), data + b"\0"]
        for content in damaged:
            message = refusal(world, with_array(state, index, name, content))
            assert f"robot {index}: " in message
            assert "expected" in message
            assert name in message, message


@pytest.mark.parametrize("index", [KHEPERA4, KHEPERA])
def test_numbers_of_the_wrong_kind_are_refused_with_their_place(
    world: World, state: WorldState, index: int
) -> None:
    floats = "gauge", "inertial.velocity", "positions", "voltage"
    for name, data in state.robots[index].arrays.items():
        wrong = (NAN, INF) if name in floats else ((2**62).to_bytes(8, "little"),)
        step = max(len(data) // 400, 1) * 8
        for start in range(0, len(data), step):
            for number in wrong:
                content = data[:start] + number + data[start + 8 :]
                assert f"{name}[{start // 8}], " in refusal(world, with_array(state, index, name, content))


def test_an_array_too_many_or_too_few_and_another_version_are_refused(
    world: World, state: WorldState
) -> None:
    for index in (KHEPERA4, KHEPERA):
        robot = state.robots[index]
        first = next(iter(robot.arrays))
        without = {name: data for name, data in robot.arrays.items() if name != first}
        for arrays in (without, {**robot.arrays, "more": b""}, {}):
            message = refusal(world, changed(state, index, arrays=arrays))
            assert f"robot {index}: arrays " in message
            assert (
                f"expected {', '.join(sorted(name for name in robot.arrays if name != 'positions'))}"
                in message
            )
        assert "version 7; expected" in refusal(world, changed(state, index, version=7))


def test_numbers_that_contradict_each_other_are_refused(world: World, state: WorldState) -> None:
    arrays = state.robots[KHEPERA4].arrays
    future = (1 << 20).to_bytes(8, "little")
    assert "inertial.n_rates = 1048576; expected at most 30" in refusal(
        world, with_array(state, KHEPERA4, "inertial.n_rates", future)
    )
    assert "robot 0: powered = 0; expected 1" in refusal(
        world, with_array(state, KHEPERA4, "dspic.powered", bytes(8))
    )
    assert "positions = 0 numbers; expected" in refusal(world, with_array(state, KHEPERA4, "positions", b""))
    none = with_array(state, KHEPERA4, "burst", b"\xff" * 8)
    assert "positions = " in refusal(world, none)
    assert len(arrays["positions"]) == 8 * len(world.data.qpos)


def test_a_state_of_another_robot_model_is_refused(world: World, state: WorldState) -> None:
    for one, other in ((KHEPERA4, KHEPERA), (KHEPERA, KHEPERA4)):
        fields = state.robots[other]._asdict()
        expected = f"robot {one}: state of model {fields['model']!r}, version {fields['version']}; "
        assert expected in refusal(world, changed(state, one, **fields))
        assert f"robot {one}: " in refusal(world, changed(state, one, firmware=fields["firmware"]))
    assert "states of 5 LEDs; expected 3" in refusal(world, changed(state, KHEPERA4, leds=(0,) * 5))
    faults = state.robots[KHEPERA].faults._replace(active=("dead:left",))
    assert "fault 'dead:left'" in refusal(world, changed(state, KHEPERA, faults=faults))


def test_a_program_that_a_khepera_lacks_is_refused(world: World, state: WorldState) -> None:
    firmware = state.robots[KHEPERA].firmware._replace(running="x\n")
    assert "ROM function 'x\\n'" in refusal(world, changed(state, KHEPERA, firmware=firmware))


def test_a_physical_state_with_a_number_that_is_none_or_within_a_step_is_refused(
    world: World, state: WorldState
) -> None:
    integration = state.physics.integration
    for start in (0, 80, len(integration) - 8):
        content = integration[:start] + NAN + integration[start + 8 :]
        message = refusal(world, state._replace(physics=state.physics._replace(integration=content)))
        assert f"physics.integration[{start // 8}] = nan; expected a finite number" in message
    torn = state.physics._replace(sensors=state.physics.sensors + b"\0")
    assert "expected a multiple of 8" in refusal(world, state._replace(physics=torn))
    assert "phase 1 of a step" in refusal(
        world, state._replace(simulation=state.simulation._replace(phase=1))
    )


@pytest.mark.share(2)
@pytest.mark.parametrize("count", [60, 400])
def test_a_damaged_text_is_refused_in_one_line_or_the_run_continues(world: World, count: int) -> None:
    world.reset(seed=3)
    world.advance(0.3)
    snapshot = world.snapshot()
    rng = np.random.default_rng(6)
    text = zlib.decompress(snapshot[26:])
    refused: list[str] = []
    for _ in range(count):
        damaged = bytearray(text)
        damaged[int(rng.integers(len(text)))] = int(rng.choice(list(b'0123456789-[]",AZaz_')))
        try:
            world.restore(snapshot[:26] + zlib.compress(bytes(damaged)))
            world.advance(0.02)
            world.state()
        except (SnapshotError, DivergedError) as error:
            refused.append(str(error))
    assert len(refused) > count // 6
    assert all(len(line.splitlines()) == 1 for line in refused)


def test_an_ultrasonic_burst_under_way_is_taken_to_an_edited_scene() -> None:
    old_playpen = Playpen.load("arena4")
    change = BranchPoint(1, edits=("block.1.movable=true",))
    old = World(old_playpen, compiled=False)
    old.advance(0.11)
    new = World(set_values(old_playpen, change.edits), compiled=False)
    transfer_world(new, old, old_playpen, change)
    assert len(new.data.qpos) != len(old.data.qpos)
    new.advance(0.1)
    assert new.robots[0].readings()["ultrasonic"] != old.robots[0].readings()["ambient"]
