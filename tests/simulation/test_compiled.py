"""The stepping core: plain and compiled code give the same bits, in one call or in many."""

import pytest
from notes import Events
from numba_marks import with_numba

from checks.branches import LAMPS, ROBOTS, arena
from khep_twin.board.fault_injection import parse_fault
from khep_twin.playpen import Playpen
from khep_twin.world import World

pytestmark = with_numba

WORDS = [f"{word}\n".encode() for word in "D,9,4 N O D,-3,8 L,0,2 H D,10,10 K C,900,500 B".split()]


def driven(
    scene: Playpen, compiled: bool | None, *, observed: bool = True, **options: object
) -> list[object]:
    """Return replies, registers, positions, voltages and events of robots with a command every 130 ms."""
    world = World(scene, seed=3, compiled=compiled, **options)  # type: ignore[arg-type]
    if compiled is None:
        world.code.switch_step = 300
    events = Events()
    if observed:
        world.add_observer(events)
    for turn in range(24):
        for robot in world.robots:
            robot.send(WORDS[(turn + robot.index) % len(WORDS)])
        if any(robot.firmware.turrets for robot in world.robots):
            world.robots[0].send(b"T,1,E,%d\nT,1,H,1\n" % (152 + 4 * turn))
        world.advance_to((turn + 1) * 130_000_000)
        if turn == 12:
            world.scan()
    assert world.simulation.is_compiled == (compiled is not False)
    replies = [robot.uart.tx.read(world.time_ns) for robot in world.robots]
    boards = [robot.registers.tolist() for robot in world.robots]
    return [replies, boards, world.data.qpos.tobytes(), world.data.ctrl.tobytes(), events.samples]


CASES = {
    "one robot": (arena(), {}),
    "another robot of the same make": (arena(), {"vary": True}),
    "no noise, no line": (arena(), {"noise": False, "unpaced": True}),
    "a lamp that blinks and fades": (arena(LAMPS), {}),
    "lamps by turns": (Playpen.load("two-lamps"), {}),
    "three robots": (arena(ROBOTS), {}),
    "three other robots of the same make": (arena(ROBOTS), {"vary": True}),
    "a gripper": (Playpen.load("gripper"), {}),
    "faults": (
        arena(ROBOTS),
        {"faults": [*map(parse_fault, ("stuck:2@0.4", "dead:left@1.003", "brown-out@1.7", "garble:0.01"))]},
    ),
    "faults that end": (
        arena(),
        {
            "faults": [
                *map(parse_fault, ("dead:3@0.1-0.8", "weak:left:0.5@0.3-0.9", "weak:right:0.7")),
                *map(parse_fault, ("slip:left:0.1@0.501-1.2", "blocked:right@1.3-1.6", "drop:0.01@0.2-1")),
            ],
            "vary": True,
        },
    ),
    "cells that run out": (arena(battery_used_min=41.06), {}),
}


@pytest.mark.share(12)
@pytest.mark.parametrize("case", CASES)
def test_compiled_code_gives_the_bits_of_plain_code(case: str) -> None:
    scene, options = CASES[case]
    plain = driven(scene, False, **options)
    assert driven(scene, True, **options) == plain
    # Without observers, steps without line events are run in one call.
    unobserved = driven(scene, True, observed=False, **options)
    assert unobserved[:4] == plain[:4]


@pytest.mark.share(4)
@pytest.mark.parametrize("case", ["faults", "lamps by turns", "three robots"])
def test_a_run_that_changes_over_to_compiled_code_stays_what_it_is(case: str) -> None:
    scene, options = CASES[case]
    assert driven(scene, None, **options) == driven(scene, False, **options)
