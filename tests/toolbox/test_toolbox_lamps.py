"""Lamps that a program places, moves and takes away in the toolbox's simulator."""

from collections.abc import Iterator

import pytest

from khep_twin import playpen as playpens
from khep_twin.errors import PlaypenError
from khep_twin.toolbox import names
from khep_twin.toolbox.simulator import OpenPlaypen


@pytest.fixture
def btmap1() -> Iterator[OpenPlaypen]:
    yield names.open_default(noise=False)
    names.close_playpen()


def test_a_lamp_shines_where_it_is_placed_and_moved_until_it_is_removed(btmap1: OpenPlaypen) -> None:
    names.putkhep(300, 250, 0)
    dark = names.sim_rls(1)
    names.place_lamp(400, 250)
    ahead = names.sim_rls(1)
    assert ahead[2:4].max() < 300
    names.kheprom(btmap1, 0.1)
    assert names.sim_rls(1) == pytest.approx(ahead, abs=2)
    names.move_lamp(390, 260, 200, 250)
    behind = names.sim_rls(1)
    assert behind[6:].max() < 300
    assert behind[2:4].min() > 400
    names.remove_lamp(0, 0)
    assert names.sim_rls(1).tolist() == dark.tolist()


def test_a_lamp_behind_a_wall_stays_in_its_shadow(btmap1: OpenPlaypen) -> None:
    bare = btmap1.twin.world.playpen
    text = playpens.dump(bare) + "[[wall]]\npoints_mm = [[350, 50], [350, 450]]\nheight_mm = 60\n"
    for text_of, lit in ((text, False), (playpens.dump(bare), True)):
        names.open_custom(playpens.parse(text_of, "p"), noise=False)
        names.putkhep(300, 250, 0)
        names.place_lamp(400, 250)
        assert (names.sim_rls(1)[2:4].max() < 400) == lit


def test_lamp_control_begins_at_once(btmap1: OpenPlaypen) -> None:
    for x_mm in (100, 500):
        names.place_lamp(x_mm, 250)
    lamps = btmap1.twin.world
    assert lamps.lamps.powers == [7, 7]
    names.lamp_control("sequenced")
    assert lamps.lamps.powers == [7, 0]
    names.putkhep(300, 250, 180)
    names.kheprom(btmap1)
    names.putkhep(140, 250, 180)
    names.kheprom(btmap1)
    assert lamps.lamps.powers == [0, 7]
    names.lamp_control("off")
    assert lamps.lamps.powers == []


def test_a_playpen_is_opened_with_its_lamps_as_wanted() -> None:
    one_by_one = names.open_custom("two-lamps", lighting="sequenced")
    assert sorted(one_by_one.twin.world.lamps.powers)[0] == 0
    assert names.open_default(lighting="off", rom="4.06").twin.robot.firmware
    with pytest.raises(PlaypenError, match="lighting 'dim': unknown"):
        names.open_default(lighting="dim")
    names.close_playpen()


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: names.place_lamp(700, 100), "place_lamp: default: lamp 1: x_mm = 700: outside the arena"),
        (lambda: names.place_lamp(100, 100, -1), "place_lamp: default: lamp.*power_w = -1"),
        (lambda: names.place_lamp(float("nan"), 1), "place_lamp: .*expected finite numbers"),
        (lambda: names.move_lamp(1, 1, 2, 2), "no lamp is left; expected one"),
        (lambda: names.remove_lamp(1, 1), "no lamp is left; expected one"),
        (lambda: names.lamp_control("dim"), "lighting 'dim': unknown"),
    ],
)
def test_a_lamp_that_cannot_be_is_one_line(btmap1: OpenPlaypen, call: object, message: str) -> None:
    with pytest.raises(PlaypenError, match=message) as error:
        call()  # type: ignore[operator]
    assert "\n" not in str(error.value)
