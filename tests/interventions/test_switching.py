"""Lamps in a running world, switched manually."""

import pytest

from khep_twin import playpen as playpens
from khep_twin.board.kernel import AMBIENT
from khep_twin.errors import PlaypenError
from khep_twin.interventions.switching import switch
from khep_twin.playpen import Playpen
from khep_twin.world import World

SECOND = 10**9


def lamp_ahead() -> Playpen:
    """Return a playpen with one lamp in front of the robot."""
    return playpens.parse(
        'version = 1\nname = "lit"\n[arena]\nwidth_mm = 600\nheight_mm = 500\n'
        "[[lamp]]\nx_mm = 450\ny_mm = 250\npower_w = 7\n[[robot]]\nx_mm = 300\ny_mm = 250\nheading_deg = 0\n",
        "lit",
    )


def test_a_lamp_is_dark_to_the_sensors_until_it_is_switched_on_again() -> None:
    world = World(lamp_ahead(), noise=False)
    counts = []
    for on in (True, False, True):
        switch(world, 0, on)
        world.advance_to(world.time_ns + SECOND)
        counts.append(world.robots[0].registers[AMBIENT].min())
    assert counts[0] == counts[2] < 300 < 450 < counts[1]


def test_a_lamp_that_blinks_stays_dark_when_a_hand_has_switched_it_off() -> None:
    playpen = lamp_ahead()
    lamp = playpen.lamps[0].model_copy(update={"blink_period_s": 0.2})
    world = World(playpen.model_copy(update={"lamps": (lamp,)}))
    switch(world, 0, False)
    for _ in range(50):
        world.advance_to(world.time_ns + SECOND // 50)
        assert world.lamps.powers == [0]


def test_a_lamp_that_there_is_not_is_told() -> None:
    with pytest.raises(PlaypenError, match="lamp = 1: there is none"):
        switch(World(lamp_ahead()), 1, False)


def test_a_lamp_that_fades_does_so_from_the_moment_a_hand_switches_it() -> None:
    playpen = lamp_ahead()
    lamp = playpen.lamps[0].model_copy(update={"fade_s": 1.0})
    world = World(playpen.model_copy(update={"lamps": (lamp,)}))
    world.advance_to(2 * SECOND + 1)
    switch(world, 0, False)
    world.advance_to(world.time_ns + SECOND // 4)
    assert world.lamps.powers == [pytest.approx(7 * 0.75, rel=1e-6)]
    switch(world, 0, True)
    world.advance_to(world.time_ns + SECOND // 8)
    assert world.lamps.powers == [pytest.approx(7 * 0.875, rel=1e-6)]
