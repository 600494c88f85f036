"""Lamps that a program places, moves and removes in the toolbox's simulator."""

import pytest

from khep_twin import playpen as playpens
from khep_twin import toolbox
from khep_twin.errors import PlaypenError
from khep_twin.toolbox.simulator import OpenPlaypen


@pytest.fixture
def btmap1() -> OpenPlaypen:
    return toolbox.open_default(noise=False)


def test_a_lamp_shines_where_it_is_placed_and_moved_until_it_is_removed(btmap1: OpenPlaypen) -> None:
    toolbox.putkhep(300, 250, 0)
    dark = toolbox.sim_rls(1)
    toolbox.place_lamp(400, 250)
    front_lamp = toolbox.sim_rls(1)
    assert front_lamp[2:4].max() < 300
    toolbox.kheprom(btmap1, 0.1)
    assert toolbox.sim_rls(1) == pytest.approx(front_lamp, abs=2)
    toolbox.move_lamp(390, 260, 200, 250)
    rear_lamp = toolbox.sim_rls(1)
    assert rear_lamp[6:].max() < 300
    assert rear_lamp[2:4].min() > 400
    toolbox.remove_lamp(0, 0)
    assert toolbox.sim_rls(1).tolist() == dark.tolist()


def test_a_lamp_behind_a_wall_stays_in_its_shadow(btmap1: OpenPlaypen) -> None:
    bare = btmap1.twin.world.playpen
    text = playpens.dump(bare) + "[[wall]]\npoints_mm = [[350, 50], [350, 450]]\nheight_mm = 60\n"
    for text_of, is_visible in ((text, False), (playpens.dump(bare), True)):
        toolbox.open_custom(playpens.parse(text_of, "p"), noise=False)
        toolbox.putkhep(300, 250, 0)
        toolbox.place_lamp(400, 250)
        assert (toolbox.sim_rls(1)[2:4].max() < 400) == is_visible


def test_lamp_control_begins_at_once(btmap1: OpenPlaypen) -> None:
    for x_mm in (100, 500):
        toolbox.place_lamp(x_mm, 250)
    lamps = btmap1.twin.world
    assert lamps.lamps.powers == [7, 7]
    toolbox.lamp_control("sequenced")
    assert lamps.lamps.powers == [7, 0]
    toolbox.putkhep(300, 250, 180)
    toolbox.kheprom(btmap1)
    toolbox.putkhep(140, 250, 180)
    toolbox.kheprom(btmap1)
    assert lamps.lamps.powers == [0, 7]
    toolbox.lamp_control("off")
    assert lamps.lamps.powers == []


def test_a_playpen_is_opened_with_its_lamps_as_wanted() -> None:
    one_by_one = toolbox.open_custom("two-lamps", lighting="sequenced")
    assert sorted(one_by_one.twin.world.lamps.powers)[0] == 0
    assert toolbox.open_default(lighting="off", rom="4.06").twin.robot.firmware
    with pytest.raises(PlaypenError, match="lighting 'dim': unknown"):
        toolbox.open_default(lighting="dim")


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: toolbox.place_lamp(700, 100), "place_lamp: default: lamp 1: x_mm = 700: outside the arena"),
        (lambda: toolbox.place_lamp(100, 100, -1), "place_lamp: default: lamp.*power_w = -1"),
        (lambda: toolbox.place_lamp(float("nan"), 1), "place_lamp: .*expected finite numbers"),
        (lambda: toolbox.move_lamp(1, 1, 2, 2), "no lamp is left; expected one"),
        (lambda: toolbox.remove_lamp(1, 1), "no lamp is left; expected one"),
        (lambda: toolbox.lamp_control("dim"), "lighting 'dim': unknown"),
    ],
)
def test_a_lamp_that_cannot_be_is_one_line(btmap1: OpenPlaypen, call: object, message: str) -> None:
    with pytest.raises(PlaypenError, match=message) as error:
        call()  # type: ignore[operator]
    assert "\n" not in str(error.value)
