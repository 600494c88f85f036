"""Start poses and lighting of runs."""

import pytest
from scenes import arena, robot, table

from khep_twin import playpen as playpens
from khep_twin.errors import PlaypenError
from khep_twin.lab.experiment.start_poses import (
    StartPose,
    parse_numbers,
    starts,
    with_lighting,
    without_nearest_lamp,
)
from khep_twin.playpen import Playpen
from khep_twin.playpen.starts import at_start, defined_starts

DEFAULT, OBSTACLES, TWO_LAMPS = (Playpen.load(name) for name in ("default", "obstacles", "two-lamps"))


def test_starts_are_listed_in_their_order() -> None:
    poses = starts(["100,200,90", "playpen", "300.5,250,-45"], DEFAULT, 0, 5, 1)
    robot = DEFAULT.robots[0]
    assert poses == [
        StartPose(100, 200, 90),
        StartPose(robot.x_mm, robot.y_mm, robot.heading_deg),
        StartPose(300.5, 250, -45),
    ]
    assert str(poses[2]) == "300.5,250,-45"


def test_a_grid_is_the_middles_of_its_cells() -> None:
    poses = starts(["grid:3x2@90"], DEFAULT, 0, 1, 0)
    assert poses == [StartPose(x, y, 90) for y in (125, 375) for x in (100, 300, 500)]


def test_a_grid_leaves_out_places_without_room() -> None:
    poses = starts(["grid:10x10"], OBSTACLES, 0, 1, 0)
    assert 30 < len(poses) < 100
    assert not [start for start in poses if (start.x_mm - 455) ** 2 + (start.y_mm - 300) ** 2 < 42**2]


def test_random_starts_are_the_seeds_and_have_room() -> None:
    poses = starts(["random"], OBSTACLES, 0, 20, 3)
    assert len({*poses}) == 20
    assert poses == starts(["random"], OBSTACLES, 0, 20, 3)
    assert poses[:5] == starts(["random"], OBSTACLES, 0, 5, 3)
    assert poses != starts(["random"], OBSTACLES, 0, 20, 4)
    for start in poses:
        assert starts([str(start)], OBSTACLES, 0, 1, 0) == [start]


def test_random_starts_take_their_turn_among_others() -> None:
    drawn, typed = starts(["random"], DEFAULT, 0, 3, 3), StartPose(300, 250, 90)
    poses = starts(["random", str(typed)], DEFAULT, 0, 5, 3)
    assert poses == [drawn[0], typed, drawn[1], typed, drawn[2]]


def test_a_robot_with_spots_starts_at_each() -> None:
    spots = table("spot", name="left", x_mm=100, y_mm=250, heading_deg=10)
    spots += table("spot", name="right", x_mm=500, y_mm=250, heading_deg=20)
    playpen = playpens.parse(arena() + spots + table("robot", spots=["right", "left"]), "spots")
    assert defined_starts(playpen, 0) == [StartPose(500, 250, 20), StartPose(100, 250, 10)]
    assert at_start(playpen, 0, StartPose(300, 200, 0)).robots[0].spots == ()


@pytest.mark.parametrize(
    ("wish", "line"),
    [
        ("455,300,0", "start 455,300,0: "),
        ("5,5,0", "start 5,5,0: robot 1 at (5, 5) overlaps the left wall"),
        ("9e9,0,0", "start 9e9,0,0: "),
        ("1,2", "start '1,2'; expected X,Y,HEADING"),
        ("1,2,nan", "start '1,2,nan'; expected"),
        ("somewhere", "start 'somewhere'; expected"),
        ("grid:0x3", "start 'grid:0x3'; expected grid:COLUMNSxROWS"),
        ("grid:999x999", "of up to 1000 places"),
        ("grid:1x1@x", "expected grid:"),
    ],
)
def test_a_start_that_cannot_be_is_an_error_of_one_line(wish: str, line: str) -> None:
    with pytest.raises(PlaypenError) as caught:
        starts([wish], OBSTACLES, 0, 1, 0)
    assert line in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_grid_of_places_without_room_is_refused() -> None:
    full = table("cylinder", x_mm=100, y_mm=100, radius_mm=20, height_mm=50) + robot(40, 40)
    playpen = playpens.parse(arena(200, 200) + full, "full")
    with pytest.raises(PlaypenError, match="none of the 1 places has room"):
        starts(["grid:1x1"], playpen, 0, 1, 0)


@pytest.mark.parametrize("index", [1, -1])
def test_a_robot_that_is_not_there_has_no_starts(index: int) -> None:
    with pytest.raises(PlaypenError, match=rf"robot = {index}: not in playpen 'default'; \(choices: 0\)"):
        starts(["playpen"], DEFAULT, index, 1, 0)


def test_lamps_are_on_as_wanted() -> None:
    assert with_lighting(TWO_LAMPS, None) is TWO_LAMPS
    assert with_lighting(TWO_LAMPS, "off").lamps == ()
    for mode in ("all", "random", "sequenced"):
        changed = with_lighting(TWO_LAMPS, mode)
        assert changed.lighting.mode == mode
        assert changed.lamps == TWO_LAMPS.lamps
    with pytest.raises(PlaypenError, match=r"lighting 'randon': unknown; did you mean 'random'\?"):
        with_lighting(TWO_LAMPS, "randon")


def test_the_nearest_lamp_goes_first() -> None:
    first, second = TWO_LAMPS.lamps
    assert without_nearest_lamp(TWO_LAMPS, first.x_mm + 1, first.y_mm).lamps == (second,)
    left = without_nearest_lamp(TWO_LAMPS, second.x_mm, second.y_mm)
    assert left.lamps == (first,)
    dark = without_nearest_lamp(left, second.x_mm, second.y_mm)
    with pytest.raises(PlaypenError, match="no lamp is left"):
        without_nearest_lamp(dark, 0, 0)


def test_numbers_are_as_many_as_wanted_and_finite() -> None:
    assert parse_numbers("1,-2.5", 2) == [1, -2.5]
    assert [parse_numbers(text, 2) for text in ("1", "1,2,3", "1,inf", "a,b", "")] == [None] * 5
