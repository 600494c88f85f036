"""Snapshots: a restored world continues bit for bit, in any world of its playpen."""

import zlib
from collections.abc import Callable

import numpy as np
import pytest
from notes import Events

from checks.branches import LAMPS, PUSHED, ROBOTS, arena, drive
from khep_twin.board.fault_injection import Fault, parse_fault
from khep_twin.errors import DivergedError, SnapshotError
from khep_twin.playpen import Lighting, Playpen
from khep_twin.simulation.world_state import SimulationState
from khep_twin.world import World


def drawn_faults(seed: int) -> list[Fault]:
    """Return a fault of each kind and some more, all but the brown-out for a random time."""
    rng = np.random.default_rng(seed)
    kinds = "dead:1 stuck:4 weak:left:0.4 dead:right slip:right:0.1 slip:right:0.3 blocked:left".split()
    kinds += ["drop:0.05", "garble:0.02", "late:0.3:30"]
    begin_s, last_s = rng.uniform(0, 2, len(kinds)), rng.uniform(0.1, 2, len(kinds))
    times = (f"@{start:.4f}-{start + length:.4f}" for start, length in zip(begin_s, last_s, strict=True))
    texts = [kind + time for kind, time in zip(kinds, times, strict=True)]
    return [parse_fault(text) for text in (*texts, f"brown-out@{rng.uniform(0.5, 3):.4f}")]


Case = tuple[Callable[[], Playpen], dict[str, object]]

CASES: dict[str, Case] = {
    "one robot": (arena, {}),
    "another robot of the same make": (arena, {"vary": True}),
    "no noise, no line": (arena, {"noise": False, "unpaced": True}),
    "a strict line": (arena, {"strict_line": True}),
    "a lamp that blinks and fades": (lambda: arena(LAMPS), {}),
    "lamps by turns": (lambda: Playpen.load("two-lamps"), {}),
    "lamps at random": (
        lambda: Playpen.load("two-lamps").model_copy(update={"lighting": Lighting(mode="random")}),
        {},
    ),
    "three robots": (lambda: arena(ROBOTS), {"vary": True}),
    "things that are pushed and fall asleep": (lambda: arena(PUSHED), {}),
    "a gripper": (lambda: Playpen.load("gripper"), {}),
    "faults": (
        lambda: arena(ROBOTS),
        {
            "faults": [
                parse_fault(text)
                for text in ("stuck:2@0.4", "dead:left@1.003", "brown-out@1.7", "garble:0.01", "late:0.2:40")
            ]
        },
    ),
    **{
        f"all faults at random times, {seed}": (
            lambda extra_tables="" if seed % 2 else PUSHED: arena(extra_tables),
            {"faults": drawn_faults(seed)},
        )
        for seed in range(6)
    },
    "cells that run out": (lambda: arena(battery_used_min=41.06), {}),
    "half of the noise": (arena, {"noise": 0.5, "unpaced": True}),
}


@pytest.mark.share(5)
@pytest.mark.parametrize("case", CASES)
def test_a_world_goes_on_from_a_snapshot_bit_for_bit(case: str) -> None:
    scene, options = CASES[case]
    rng = np.random.default_rng(zlib.crc32(case.encode()))
    seed, end_ns = int(rng.integers(1000)), 3_500_000_000
    world = World(scene(), seed=seed, compiled=False, **options)  # type: ignore[arg-type]
    drive(world, seed, int(rng.integers(1, end_ns - 1_500_000_000)))
    snapshot = world.snapshot()
    worlds = [world, World(scene(), seed=seed, compiled=True, **options)]  # type: ignore[arg-type]
    drive(worlds[1], seed + 1, 700_000_000)
    outcomes: list[tuple[list[object], bytes]] = []
    for restored in [*worlds, worlds[0]]:
        restored.restore(snapshot)
        assert restored.snapshot() == snapshot
        restored.observers[:] = [events := Events()]
        drive(restored, seed, end_ns)
        outcomes.append((events.samples, restored.snapshot()))
    assert outcomes[0] == outcomes[1] == outcomes[2]
    assert len(outcomes[0][0]) > 100


def test_a_snapshot_has_the_scale_of_the_noise_and_one_without_it_is_of_the_calibrated_noise() -> None:
    world, other = World(arena(), noise=0.5, compiled=False), World(arena(), compiled=False)
    other.restore(world.snapshot())
    assert other.simulation.noise == 0.5
    assert other.snapshot() == world.snapshot()
    for noise in (True, False):
        world.reset(noise=noise)
        state = world.state()
        previous_format = SimulationState(*state.simulation[:-1])
        other.set_state(state._replace(simulation=previous_format))
        assert other.simulation.noise == noise
    with pytest.raises(ValueError, match=r"^noise = -1; expected True"):
        World(arena(), noise=-1)


def test_another_seed_changes_what_follows_and_nothing_else() -> None:
    world = World(arena(), compiled=False)
    world.advance_to(1_000_000_000)
    snapshot = world.snapshot()
    before = world.state()
    world.reseed(1)
    streams = {"simulation": before.simulation, "lamps_stream": before.lamps_stream}
    assert world.state()._replace(**streams) == before
    drawn: list[list[int]] = []
    for seed in (1, 2, 1):
        world.restore(snapshot)
        world.reseed(seed)
        world.advance_to(1_100_000_000)
        drawn.append(world.robots[0].registers.tolist())
    assert drawn[0] == drawn[2] != drawn[1]


def test_a_snapshot_keeps_that_a_run_has_ended() -> None:
    world = World(arena(), compiled=False)
    world.data.qvel[0] = 1e6
    world.data.warning.number[0] = 3
    with pytest.raises(DivergedError, match="failed at") as ended:
        world.advance_to(1_000_000_000)
    other = World(arena(), compiled=False)
    other.restore(world.snapshot())
    with pytest.raises(DivergedError, match="failed at") as again:
        other.advance_to(2_000_000_000)
    assert str(again.value) == str(ended.value)
    assert other.data.warning.number.tolist() == world.data.warning.number.tolist()


def test_a_snapshot_of_another_scene_is_refused_and_changes_nothing() -> None:
    world = World(arena(), compiled=False)
    for other in (World(arena(LAMPS)), World(Playpen.load("default")), World(arena(), vary=True)):
        snapshot = other.snapshot()
        before = world.snapshot()
        if other.scene == world.scene:  # lamps are part of the state
            world.restore(snapshot)
            assert len(world.lamps.names) == len(other.lamps.names)
            continue
        with pytest.raises(SnapshotError, match="of another scene"):
            world.restore(snapshot)
        assert world.snapshot() == before


@pytest.mark.share(2)
@pytest.mark.parametrize("count", [100, 300])
def test_a_damaged_snapshot_gives_one_line(count: int) -> None:
    world = World(arena(PUSHED, turrets=("gripper",)), compiled=False)
    world.advance_to(500_000_000)
    snapshot = world.snapshot()
    rng = np.random.default_rng(5)
    head, text = snapshot[:26], zlib.decompress(snapshot[26:])
    damaged = [
        b"",
        snapshot[:20],
        snapshot[:-5],
        head[:8] + b"\2\0" + snapshot[10:],
        head + zlib.compress(b"[1]"),
    ]
    for _ in range(count):
        place = int(rng.integers(len(text)))
        changed = bytearray(text)
        changed[place] = int(rng.choice(list(b'0123456789-[]",AZaz_')))
        damaged.append(head + zlib.compress(bytes(changed)))
    refused: list[str] = []
    for data in damaged:
        try:
            world.restore(data)
        except SnapshotError as error:
            refused.append(str(error))
        world.restore(snapshot)
        assert world.snapshot() == snapshot
    assert len(refused) > count // 6
    assert all(len(line.splitlines()) == 1 for line in refused)
