"""Snapshots: a world goes on from one bit for bit, wherever it is restored."""

import zlib
from collections.abc import Callable
from contextlib import suppress

import numpy as np
import pytest

from khep_twin import playpen
from khep_twin.board.fault_injection import parse
from khep_twin.board.uart import HostEvent, LineSettings
from khep_twin.errors import DivergedError, PlaypenError, SnapshotError
from khep_twin.interventions.move_robot import put
from khep_twin.interventions.switching import relight, switch
from khep_twin.playpen import Lamp, Lighting, Playpen
from khep_twin.world import World

LAMPS = """
[[lamp]]
x_mm = 620
y_mm = 80
power_w = 9
blink_period_s = 0.7
fade_s = 0.2
flicker = 0.4
"""

ROBOTS = """
[[robot]]
x_mm = 330
y_mm = 300
heading_deg = 90
[[robot]]
x_mm = 250
y_mm = 320
heading_deg = -20
model = "khepera2"
"""

PUSHED = "".join(
    f"\n[[block]]\nx_mm = {x_mm}\ny_mm = 500\nlength_mm = 30\nwidth_mm = 30\nheight_mm = 30\nmovable = true\n"
    for x_mm in (100, 200, 300, 400, 500, 600)
)


def arena(more: str = "", **changes: object) -> Playpen:
    """The shipped obstacles, with more, and with changes of its robot."""
    found = playpen.parse(playpen.dump(playpen.load("obstacles")) + more, "arena")
    robots = (found.robots[0].model_copy(update=changes), *found.robots[1:])
    return found.model_copy(update={"robots": robots})


class Events:
    """An observer that notes everything with its time."""

    def __init__(self) -> None:
        self.seen: list[object] = []

    def sample(self, world: World) -> None:
        self.seen.append((world.time_ns, world.data.xpos.tobytes()))

    def on_bytes(self, time_ns: int, robot: int, to_robot: bool, data: bytes) -> None:
        self.seen.append((time_ns, robot, to_robot, data))

    def on_host_event(self, time_ns: int, robot: int, event: HostEvent) -> None:
        self.seen.append((time_ns, robot, event))

    def on_event(self, time_ns: int, robot: int | None, text: str) -> None:
        self.seen.append((time_ns, robot, text))


WORDS = "D,9,4 N O D,-3,8 L,0,2 H D,10,10 K C,900,500 B D,20,19 E".split()
ARM = "T,1,E,255 T,1,D,1 T,1,E,152 T,1,D,0 T,1,G T,1,H,1 T,1,F".split()


def drive(world: World, seed: int, end_ns: int) -> None:
    """Let hosts do at random what they may, from the present on; the same for the same time and seed."""
    while world.time_ns < end_ns:
        rng = np.random.default_rng([seed, world.time_ns])
        for robot in world.robots:
            words = WORDS + ARM * bool(robot.firmware.turrets)
            robot.uart.tx.read(world.time_ns)
            robot.send(f"{rng.choice(words)}\n".encode() * int(rng.integers(1, 3)))
            match int(rng.integers(30)):
                case 0:
                    robot.send(b"N\nD,5", world.time_ns + 3_000_000)
                case 1:
                    robot.disconnect()
                case 2:
                    robot.compare_line(LineSettings(int(rng.choice([9600, 19200])), 2))
                case 3:
                    robot.flush()
                case 4:
                    robot.send(b"restart\n")
                case _:
                    pass
        match int(rng.integers(60)):
            case 0 if world.lamps.names:
                switch(world, 0, on=bool(rng.integers(2)))
            case 1 if world.lamps.names:
                relight(world, [Lamp(x_mm=200, y_mm=100, power_w=3, flicker=0.2)], Lighting())
            case 2:
                world.scan()
            case 3:
                x_mm, y_mm, heading = world.robots[0].pose
                with suppress(PlaypenError):  # no room
                    put(world, 0, x_mm * 1e3, y_mm * 1e3, heading + 10, afresh=True)
            case _:
                pass
        # Also between steps.
        world.advance_to(min(world.time_ns + int(rng.integers(1, 300_000_000)), end_ns))


Case = tuple[Callable[[], Playpen], dict[str, object]]

CASES: dict[str, Case] = {
    "one robot": (arena, {}),
    "another robot of the same make": (arena, {"vary": True}),
    "no noise, no line": (arena, {"noise": False, "unpaced": True}),
    "a strict line": (arena, {"strict_line": True}),
    "a lamp that blinks and fades": (lambda: arena(LAMPS), {}),
    "lamps by turns": (lambda: playpen.load("two-lamps"), {}),
    "lamps at random": (
        lambda: playpen.load("two-lamps").model_copy(update={"lighting": Lighting(mode="random")}),
        {},
    ),
    "three robots": (lambda: arena(ROBOTS), {"vary": True}),
    "things that are pushed and fall asleep": (lambda: arena(PUSHED), {}),
    "a gripper": (lambda: playpen.load("gripper"), {}),
    "faults": (
        lambda: arena(ROBOTS),
        {
            "faults": [
                parse(text)
                for text in ("stuck:2@0.4", "dead:left@1.003", "brown-out@1.7", "garble:0.01", "late:0.2:40")
            ]
        },
    ),
    "cells that run out": (lambda: arena(battery_used_min=41.06), {}),
}


@pytest.mark.parametrize("case", CASES)
def test_a_world_goes_on_from_a_snapshot_bit_for_bit(case: str) -> None:
    scene, options = CASES[case]
    rng = np.random.default_rng(zlib.crc32(case.encode()))
    seed, end_ns = int(rng.integers(1000)), 3_500_000_000
    world = World(scene(), seed=seed, compiled=False, **options)  # type: ignore[arg-type]
    drive(world, seed, int(rng.integers(1, end_ns - 1_500_000_000)))
    taken = world.snapshot()
    worlds = [world, World(scene(), seed=seed, compiled=True, **options)]  # type: ignore[arg-type]
    drive(worlds[1], seed + 1, 700_000_000)
    outcomes: list[tuple[list[object], bytes]] = []
    for each in [*worlds, worlds[0]]:
        each.restore(taken)
        assert each.snapshot() == taken
        each.observers = [events := Events()]
        drive(each, seed, end_ns)
        outcomes.append((events.seen, each.snapshot()))
    assert outcomes[0] == outcomes[1] == outcomes[2]
    assert len(outcomes[0][0]) > 100


def test_another_seed_changes_what_follows_and_nothing_else() -> None:
    world = World(arena(), compiled=False)
    world.advance_to(1_000_000_000)
    taken = world.snapshot()
    before = world.state()
    world.reseed(1)
    streams = {"simulation": before.simulation, "lamps_stream": before.lamps_stream}
    assert world.state()._replace(**streams) == before
    drawn: list[list[int]] = []
    for seed in (1, 2, 1):
        world.restore(taken)
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
    for other in (World(arena(LAMPS)), World(playpen.load("default")), World(arena(), vary=True)):
        taken = other.snapshot()
        before = world.snapshot()
        if other.scene == world.scene:  # lamps are part of the state
            world.restore(taken)
            assert len(world.lamps.names) == len(other.lamps.names)
            continue
        with pytest.raises(SnapshotError, match="of another scene"):
            world.restore(taken)
        assert world.snapshot() == before


def test_a_damaged_snapshot_gives_one_line() -> None:
    world = World(arena(PUSHED, turrets=("gripper",)), compiled=False)
    world.advance_to(500_000_000)
    taken = world.snapshot()
    rng = np.random.default_rng(5)
    head, text = taken[:26], zlib.decompress(taken[26:])
    damaged = [b"", taken[:20], taken[:-5], head[:8] + b"\2\0" + taken[10:], head + zlib.compress(b"[1]")]
    for _ in range(300):
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
        world.restore(taken)
        assert world.snapshot() == taken
    assert len(refused) > 50
    assert all(len(line.splitlines()) == 1 for line in refused)
