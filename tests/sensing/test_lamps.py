"""Lamps over time: they blink, fade, and take turns as in the Khepera Toolbox for Matlab."""

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


def lamp(x_mm: float, y_mm: float, options: str = "") -> str:
    return f"[[lamp]]\nx_mm = {x_mm}\ny_mm = {y_mm}\npower_w = 2\n{options}"


THREE = lamp(200, 200) + lamp(800, 200) + lamp(800, 800)
CORNERS = [(0.2, 0.2), (0.8, 0.2), (0.8, 0.8)]


def test_all_lamps_are_on_unless_the_playpen_says_otherwise() -> None:
    three = lamps(THREE)
    assert (three.powers, three.lit_index, three.are_constant) == ([2, 2, 2], None, True)


def test_a_dimmed_lamp_shines_with_a_part_of_its_power() -> None:
    assert lamps(lamp(200, 200, "dim = 0.25\n")).powers == [0.5]


def test_a_lamp_blinks_by_its_period_and_duty() -> None:
    blinking = lamps(lamp(200, 200, "blink_period_s = 0.1\nblink_duty = 0.3\n"))
    assert not blinking.are_constant
    powers = []
    for step in range(1, 81):
        blinking.update(step * STEP_NS, [(*MIDDLE, 0.0275)])
        powers.append(blinking.powers[0])
    expected = [2.0 if step * STEP_NS % 100_000_000 < 30_000_000 else 0.0 for step in range(1, 81)]
    assert powers == expected


def test_a_lamp_that_fades_goes_on_and_off_along_a_line() -> None:
    fading = lamps(lamp(200, 200, "blink_period_s = 1\nfade_s = 0.2\n"))
    powers = {}
    for step in range(1, 401):
        fading.update(step * STEP_NS, [(*MIDDLE, 0.0275)])
        powers[step * STEP_NS] = fading.powers[0]
    assert powers[500_000_000 - STEP_NS] == 2
    assert powers[600_000_000 - STEP_NS] == pytest.approx(1)
    assert powers[700_000_000] == 0
    assert powers[1_000_000_000] == pytest.approx(2 * 2.5 / 200)


def test_all_lamps_that_flicker_have_one_phase_which_the_seed_draws() -> None:
    steady_light = Light(LightLaw(False, 0.0, 0.0, True, 10_000_000, 0.0), [Bulb()] * 2, [])
    assert lamps(lamp(200, 200) * 2).add_flicker(steady_light) is steady_light
    text = lamp(200, 200, "flicker = 0.3\n") + lamp(300, 300)
    by_seed = [lamps(text, seed) for seed in (1, 1, 2)]
    phases = [pair.add_flicker(steady_light).law.flicker_phase for pair in by_seed]
    assert phases[0] == phases[1] != phases[2]
    assert [bulb.flicker for bulb in by_seed[0].add_flicker(steady_light).bulbs] == [0.3, 0]
    assert (by_seed[0].powers, by_seed[0].are_constant) == ([2, 2], True)


def test_the_mains_go_on_when_the_lamps_of_a_world_are_changed() -> None:
    scene = Playpen.load("two-lamps")
    flickering = [lamp.model_copy(update={"flicker": 0.5}) for lamp in scene.lamps]
    world = World(scene, seed=3)
    world.set_lamps(flickering)
    phase = world.simulation.plain.light.law.flicker_phase
    world.set_lamps(flickering[:1])
    assert world.simulation.plain.light.law.flicker_phase == phase > 0


def walk(room_lamps: Lamps, *positions: tuple[float, float]) -> list[int | None]:
    indices = []
    for number, position in enumerate(positions, 1):
        room_lamps.update(number * STEP_NS, [(*position, 0.0275)])
        indices.append(room_lamps.lit_index)
    return indices


def test_in_sequence_the_next_lamp_is_on_when_a_robot_comes_near_the_one_that_is() -> None:
    three = lamps('[lighting]\nmode = "sequenced"\n' + THREE)
    assert three.powers == [2, 0, 0]
    positions = [MIDDLE, CORNERS[0], CORNERS[0], MIDDLE, CORNERS[2], CORNERS[1], MIDDLE, CORNERS[2], MIDDLE]
    assert walk(three, *positions) == [0, 1, 1, 1, 1, 2, 2, 0, 0]
    assert three.powers == [2, 0, 0]


def test_in_sequence_the_next_lamp_is_on_when_a_robot_comes_near_a_wall() -> None:
    three = lamps('[lighting]\nmode = "sequenced"\n' + THREE)
    wall = (0.05, 0.5)
    assert walk(three, MIDDLE, wall, wall, MIDDLE, wall) == [0, 1, 1, 1, 2]


def test_a_robot_that_starts_at_a_wall_has_not_come_there() -> None:
    three = lamps('[lighting]\nmode = "sequenced"\n' + THREE)
    assert walk(three, (0.05, 0.5), (0.05, 0.5), MIDDLE, (0.5, 0.95)) == [0, 0, 0, 1]


def test_how_near_is_near_is_the_playpens_choice() -> None:
    text = '[lighting]\nmode = "sequenced"\nswitch_distance_mm = 100\n' + THREE
    inside = (0.2 + 0.0275 + 0.010 + 0.099, 0.2)
    outside = (inside[0] + 0.002, 0.2)
    assert walk(lamps(text), MIDDLE, outside) == [0, 0]
    assert walk(lamps(text), MIDDLE, inside) == [0, 1]


def test_with_a_distance_of_0_the_first_lamp_stays_wherever_robots_are() -> None:
    text = '[lighting]\nmode = "random"\nswitch_distance_mm = 0\n' + THREE
    walks = [walk(lamps(text, seed), MIDDLE, *CORNERS, (0.01, 0.5), MIDDLE) for seed in range(1, 20)]
    assert all(len({*indices}) == 1 for indices in walks)
    assert {indices[0] for indices in walks} == {0, 1, 2}


def test_by_chance_another_lamp_is_on_each_time_and_each_gets_its_turn() -> None:
    three = lamps('[lighting]\nmode = "random"\n' + THREE, seed=5)
    indices = walk(three, *([MIDDLE, (0.05, 0.5)] * 300))[1::2]
    assert all(previous != current for previous, current in pairwise(indices))
    np.testing.assert_allclose(np.bincount(np.array(indices)) / 300, 1 / 3, atol=0.06)


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
    assert notes.events == ["second is on"]
