"""Lamps over time: they blink, fade, and shine in sequence as the Khepera Toolbox for Matlab had it."""

from functools import cache, partial
from itertools import pairwise

import numpy as np
import pytest
from notes import Notes

from khep_twin import playpen
from khep_twin.board.kernel import AMBIENT
from khep_twin.playpen import Playpen
from khep_twin.randomness import stream
from khep_twin.sensing.lamps import Lamps
from khep_twin.sensing.light import Bulb, Light, LightLaw
from khep_twin.world import World

MIDDLE = (0.5, 0.5)
STEP_NS = 2_500_000


def lamps(text: str, seed: int = 0) -> Lamps:
    head = 'version = 1\nname = "lamps"\n[arena]\nwidth_mm = 1000\nheight_mm = 1000\n'
    return Lamps(playpen.parse(head + text, "lamps"), cache(partial(stream, seed, "lamps")))


def lamp(x_mm: float, y_mm: float, more: str = "") -> str:
    return f"[[lamp]]\nx_mm = {x_mm}\ny_mm = {y_mm}\npower_w = 2\n{more}"


THREE = lamp(200, 200) + lamp(800, 200) + lamp(800, 800)
CORNERS = [(0.2, 0.2), (0.8, 0.2), (0.8, 0.8)]


def test_all_lamps_are_on_unless_the_playpen_says_otherwise() -> None:
    found = lamps(THREE)
    assert (found.powers, found.lit_index, found.are_constant) == ([2, 2, 2], None, True)


def test_a_dimmed_lamp_shines_with_a_part_of_its_power() -> None:
    assert lamps(lamp(200, 200, "dim = 0.25\n")).powers == [0.5]


def test_a_lamp_blinks_by_its_period_and_duty() -> None:
    found = lamps(lamp(200, 200, "blink_period_s = 0.1\nblink_duty = 0.3\n"))
    assert not found.are_constant
    shown = []
    for step in range(1, 81):
        found.update(step * STEP_NS, [(*MIDDLE, 0.0275)])
        shown.append(found.powers[0])
    expected = [2.0 if step * STEP_NS % 100_000_000 < 30_000_000 else 0.0 for step in range(1, 81)]
    assert shown == expected


def test_a_lamp_that_fades_goes_on_and_off_along_a_line() -> None:
    found = lamps(lamp(200, 200, "blink_period_s = 1\nfade_s = 0.2\n"))
    shown = {}
    for step in range(1, 401):
        found.update(step * STEP_NS, [(*MIDDLE, 0.0275)])
        shown[step * STEP_NS] = found.powers[0]
    assert shown[500_000_000 - STEP_NS] == 2
    assert shown[600_000_000 - STEP_NS] == pytest.approx(1)
    assert shown[700_000_000] == 0
    assert shown[1_000_000_000] == pytest.approx(2 * 2.5 / 200)


def test_all_lamps_that_flicker_have_one_phase_which_the_seed_draws() -> None:
    still = Light(LightLaw(False, 0.0, 0.0, True, 10_000_000, 0.0), [Bulb()] * 2, [])
    assert lamps(lamp(200, 200) * 2).add_flicker(still) is still
    both = lamp(200, 200, "flicker = 0.3\n") + lamp(300, 300)
    found = [lamps(both, seed) for seed in (1, 1, 2)]
    phases = [each.add_flicker(still).law.flicker_phase for each in found]
    assert phases[0] == phases[1] != phases[2]
    assert [bulb.flicker for bulb in found[0].add_flicker(still).bulbs] == [0.3, 0]
    assert (found[0].powers, found[0].are_constant) == ([2, 2], True)


def test_the_mains_go_on_when_the_lamps_of_a_world_are_changed() -> None:
    scene = Playpen.load("two-lamps")
    flickering = [each.model_copy(update={"flicker": 0.5}) for each in scene.lamps]
    world = World(scene, seed=3)
    world.set_lamps(flickering)
    phase = world.simulation.plain.light.law.flicker_phase
    world.set_lamps(flickering[:1])
    assert world.simulation.plain.light.law.flicker_phase == phase > 0


def walk(found: Lamps, *positions: tuple[float, float]) -> list[int | None]:
    lit = []
    for number, position in enumerate(positions, 1):
        found.update(number * STEP_NS, [(*position, 0.0275)])
        lit.append(found.lit_index)
    return lit


def test_in_sequence_the_next_lamp_is_on_when_a_robot_comes_near_the_one_that_is() -> None:
    found = lamps('[lighting]\nmode = "sequenced"\n' + THREE)
    assert found.powers == [2, 0, 0]
    way = [MIDDLE, CORNERS[0], CORNERS[0], MIDDLE, CORNERS[2], CORNERS[1], MIDDLE, CORNERS[2], MIDDLE]
    assert walk(found, *way) == [0, 1, 1, 1, 1, 2, 2, 0, 0]
    assert found.powers == [2, 0, 0]


def test_in_sequence_the_next_lamp_is_on_when_a_robot_comes_near_a_wall() -> None:
    found = lamps('[lighting]\nmode = "sequenced"\n' + THREE)
    wall = (0.05, 0.5)
    assert walk(found, MIDDLE, wall, wall, MIDDLE, wall) == [0, 1, 1, 1, 2]


def test_a_robot_that_starts_at_a_wall_has_not_come_there() -> None:
    found = lamps('[lighting]\nmode = "sequenced"\n' + THREE)
    assert walk(found, (0.05, 0.5), (0.05, 0.5), MIDDLE, (0.5, 0.95)) == [0, 0, 0, 1]


def test_how_near_is_near_is_the_playpens_choice() -> None:
    text = '[lighting]\nmode = "sequenced"\nswitch_distance_mm = 100\n' + THREE
    beside = (0.2 + 0.0275 + 0.010 + 0.099, 0.2)
    beyond = (beside[0] + 0.002, 0.2)
    assert walk(lamps(text), MIDDLE, beyond) == [0, 0]
    assert walk(lamps(text), MIDDLE, beside) == [0, 1]


def test_with_a_distance_of_0_the_first_lamp_stays_wherever_robots_are() -> None:
    text = '[lighting]\nmode = "random"\nswitch_distance_mm = 0\n' + THREE
    drawn = [walk(lamps(text, seed), MIDDLE, *CORNERS, (0.01, 0.5), MIDDLE) for seed in range(1, 20)]
    assert all(len({*lit}) == 1 for lit in drawn)
    assert {lit[0] for lit in drawn} == {0, 1, 2}


def test_by_chance_another_lamp_is_on_each_time_and_each_gets_its_turn() -> None:
    found = lamps('[lighting]\nmode = "random"\n' + THREE, seed=5)
    lit = walk(found, *([MIDDLE, (0.05, 0.5)] * 300))[1::2]
    assert all(one != other for one, other in pairwise(lit))
    np.testing.assert_allclose(np.bincount(np.array(lit)) / 300, 1 / 3, atol=0.06)


def test_the_same_seed_draws_the_same_lamps() -> None:
    def drawn(seed: int) -> list[int | None]:
        return walk(lamps('[lighting]\nmode = "random"\n' + THREE, seed), *([MIDDLE, (0.05, 0.5)] * 10))

    assert drawn(1) == drawn(1)
    assert drawn(1) != drawn(2)


def test_one_lamp_alone_stays_on_and_none_is_no_trouble() -> None:
    assert walk(lamps('[lighting]\nmode = "random"\n' + lamp(200, 200)), MIDDLE, CORNERS[0]) == [0, 0]
    assert lamps('[lighting]\nmode = "random"\n').are_constant


def test_a_robot_that_drives_to_a_lamp_sees_the_next_one_come_on() -> None:
    text = (
        'version = 1\nname = "turns"\n[arena]\nwidth_mm = 1000\nheight_mm = 400\n'
        '[lighting]\nmode = "sequenced"\n[[robot]]\nx_mm = 300\ny_mm = 200\nheading_deg = 0\n'
        + lamp(500, 200, 'name = "first"\n')
        + lamp(100, 200, 'name = "second"\n')
    )
    world = World(playpen.parse(text, "turns"), noise=False)
    front, back = world.robots[0].registers[AMBIENT][[2, 6]]
    assert front < 400 < back
    notes = Notes()
    world.add_observer(notes)
    world.robots[0].send(b"D,10,10\n")
    world.advance_to(2_500_000_000)
    front, back = world.robots[0].registers[AMBIENT][[2, 6]]
    assert front == 485 > back
    assert notes.told == ["second is on"]
