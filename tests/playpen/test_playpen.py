"""Playpen files: keys, defaults, invalid values and their error messages."""

import json
import os
import re
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pydantic import ValidationError

from khep_twin import playpen as playpens
from khep_twin.board.turrets import installed_turrets
from khep_twin.errors import PlaypenError
from khep_twin.files.toml_files import PROBLEM_LIMIT
from khep_twin.playpen import Block, Cylinder, Lamp, Playpen, RobotEntry
from khep_twin.playpen.footprint import Circle, overlap
from khep_twin.playpen.overlap import PART_LIMIT
from khep_twin.playpen.surfaces import BUILT_IN_SURFACES

HEAD = 'version = 1\nname = "p"\n'
ARENA = "[arena]\nwidth_mm = 600\nheight_mm = 500\n"
BLOCK = "[[block]]\nx_mm = 120\ny_mm = 200\nlength_mm = 60\nwidth_mm = 20\nheight_mm = 50\n"
CYLINDER = "[[cylinder]]\nx_mm = 400\ny_mm = 250\nradius_mm = 12.5\nheight_mm = 50\n"
LAMP = "[[lamp]]\nx_mm = 50\ny_mm = 450\npower_w = 7\n"
ROBOT = "[[robot]]\nx_mm = 300\ny_mm = 250\nheading_deg = 90\n"
CARDBOARD = "[surfaces.cardboard]\nreflectance = 0.6\nrgb = [180, 140, 90]\n"

TRIANGLE = "outline_mm = [[0, 0], [600, 0], [0, 500]]\n"
WALL = "[[wall]]\npoints_mm = [[100, 100], [300, 100], [300, 200]]\n"
SPOT = '[[spot]]\nname = "a"\nx_mm = 300\ny_mm = 250\nheading_deg = 0\n'

TABLES = {"block": BLOCK, "cylinder": CYLINDER, "lamp": LAMP, "robot": ROBOT}


def parse(*parts: str, head: str = HEAD, arena: str = ARENA) -> Playpen:
    return playpens.parse(head + arena + "".join(parts), "p.toml")


def numbered_lines_about(text: str) -> list[str]:
    with pytest.raises(PlaypenError) as caught:
        playpens.parse(text, "p.toml")
    return str(caught.value).splitlines()


def lines_about(text: str) -> list[str]:
    """Return the error lines without line numbers."""
    return [re.sub(r"^p\.toml:\d+:", "p.toml:", line) for line in numbered_lines_about(text)]


# Content of a file ---------------------------------------------------------------------------------------


def test_what_a_file_leaves_out_has_the_defaults_of_the_format() -> None:
    playpen = parse(BLOCK, CYLINDER, LAMP, ROBOT)
    assert (playpen.version, playpen.name, playpen.lighting.mode) == (1, "p", "all")
    arena, block, cylinder = playpen.arena, playpen.blocks[0], playpen.cylinders[0]
    assert (arena.wall_height_mm, arena.wall_thickness_mm, arena.surface) == (50, 10, "white")
    assert (block.angle_deg, block.surface, block.movable) == (0, "white", False)
    assert (cylinder.surface, cylinder.movable) == ("white", False)
    assert playpen.lamps[0].z_mm == 15
    robot = playpen.robots[0]
    assert (robot.model, robot.calibration, robot.mode, robot.rom) == ("khepera1", "khepera1", 1, "5.02")
    assert robot.turrets == ()
    assert all(item.name is None for item in (block, cylinder, playpen.lamps[0], robot))


def test_every_key_of_the_format_is_read() -> None:
    playpen = parse(
        BLOCK + 'angle_deg = 45\nsurface = "black"\nname = "b"\n',
        CYLINDER + 'movable = true\nmass_g = 12.5\nsurface = "cardboard"\n',
        LAMP + "z_mm = 40\n",
        '[lighting]\nmode = "all"\n',
        ROBOT + 'model = "khepera1"\ncalibration = "mine.toml"\nmode = 3\nrom = "4.06"\nturrets = []\n',
        CARDBOARD,
    )
    assert playpen.blocks == (
        Block(
            name="b",
            x_mm=120,
            y_mm=200,
            angle_deg=45,
            length_mm=60,
            width_mm=20,
            height_mm=50,
            surface="black",
        ),
    )
    assert playpen.cylinders == (
        Cylinder(
            x_mm=400, y_mm=250, radius_mm=12.5, height_mm=50, surface="cardboard", movable=True, mass_g=12.5
        ),
    )
    assert playpen.lamps == (Lamp(x_mm=50, y_mm=450, z_mm=40, power_w=7),)
    assert playpen.robots == (
        RobotEntry(x_mm=300, y_mm=250, heading_deg=90, calibration="mine.toml", mode=3, rom="4.06"),
    )
    assert playpen.surface("cardboard").rgb == (180, 140, 90)


def test_whole_numbers_are_lengths_too() -> None:
    x_mm = parse(ROBOT).robots[0].x_mm
    assert isinstance(x_mm, float)


def test_white_is_the_reference_and_black_hardly_reflects() -> None:
    reflectances = {name: surface.reflectance for name, surface in BUILT_IN_SURFACES.items()}
    assert reflectances == {
        "white": 1.0,
        "grey": 0.151,
        "black": 0.023,
        "wood": 0.98,
        "styropor": 0.913,
        "sponge": 0.575,
        "copper": 0.769,
        "lego": 0.8,
    }
    assert parse().surface("lego") is BUILT_IN_SURFACES["lego"]


def test_what_stands_on_the_floor_is_listed_by_table() -> None:
    playpen = parse(BLOCK, CYLINDER, LAMP, WALL, ROBOT)
    assert playpen.objects["block"] == playpen.blocks
    assert playpen.objects["cylinder"] == playpen.cylinders
    assert [item.angle_deg for items in playpen.objects.values() for item in items] == [0, 0]


def test_a_playpen_does_not_change() -> None:
    with pytest.raises(ValidationError):
        parse().name = "other"  # type: ignore[misc]


# Shipped playpens ----------------------------------------------------------------------------------------


def test_the_shipped_playpens_are_listed() -> None:
    assert {"default", "obstacles", "two-lamps"} <= set(playpens.names())


@pytest.mark.parametrize("name", playpens.names())
def test_a_shipped_playpen_bears_its_file_s_name_and_has_robots(name: str) -> None:
    playpen = Playpen.load(name)
    assert playpen.name == name
    assert len(playpen.robots) == {"swarm": 20, "arena4-two": 3}.get(name, 1)


def test_the_default_is_four_walls_and_one_robot_in_the_middle() -> None:
    playpen = Playpen.load("default")
    assert (playpen.arena.width_mm, playpen.arena.height_mm) == (600, 500)
    assert (playpen.robots[0].x_mm, playpen.robots[0].y_mm, playpen.robots[0].heading_deg) == (300, 250, 90)
    assert (playpen.blocks, playpen.cylinders, playpen.lamps) == ((), (), ())


def test_no_lane_between_the_obstacles_is_narrower_than_90_mm() -> None:
    playpen = Playpen.load("obstacles")
    inner = [block for block in playpen.blocks if not (block.name or "").startswith("corner")]
    footprints = [item.footprint for item in (*inner, *playpen.cylinders)]
    # A disc as wide as a lane overlaps at most one object or wall, anywhere in the arena.
    for x in range(0, 801, 10):
        for y in range(0, 601, 10):
            disc = Circle(x, y, 45)
            n_overlaps = sum(overlap(disc, footprint) for footprint in footprints)
            n_overlaps += min(x, 800 - x, y, 600 - y) < disc.radius_mm
            assert n_overlaps <= 1, (x, y)


# Invalid files -------------------------------------------------------------------------------------------

SURFACES = "(choices: white, grey, black, wood, styropor, sponge, copper, lego)"
PLACE = "expected a number from 0 to 10000"

WRONG_IN_ARENA = {
    "widht_mm = 3\n": "arena: widht_mm = 3: unknown key; did you mean 'width_mm'? (choices: "
    "width_mm, height_mm, outline_mm, wall_height_mm, wall_thickness_mm, table, surface, stripes)",
    'surface = "whit"\n': f"arena: surface = \"whit\": unknown; did you mean 'white'? {SURFACES}",
    "[block]\nx_mm = 1\n": "block; expected [[block]], in two brackets each",
    BLOCK.replace("120", "nan"): f"block 1: x_mm = nan; {PLACE}",
    BLOCK.replace("120", "inf"): f"block 1: x_mm = inf; {PLACE}",
    BLOCK.replace("120", "true"): f"block 1: x_mm = true; {PLACE}",
    BLOCK.replace("120", "-1"): f"block 1: x_mm = -1; {PLACE}",
    BLOCK.replace("120", "1979-05-27"): f"block 1: x_mm = 1979-05-27; {PLACE}",
    BLOCK.replace("120", "650"): "block 1: x_mm = 650: outside the arena; expected 0 to 600",
    BLOCK.replace("y_mm = 200\n", ""): "block 1: y_mm is missing; expected a number from 0 to 10000",
    BLOCK.replace("60", "0"): "block 1: length_mm = 0; expected a number from 1 to 10000",
    BLOCK.replace("= 50", "= 1001"): "block 1: height_mm = 1001; expected a number from 1 to 1000",
    BLOCK + "angle_deg = 400\n": "block 1: angle_deg = 400; expected a number from -360 to 360",
    BLOCK + "heigth_mm = 50\n": "block 1: heigth_mm = 50: unknown key; did you mean 'height_mm'? "
    "(choices: name, x_mm, y_mm, angle_deg, length_mm, width_mm, height_mm, surface, stripes, movable, "
    "mass_g, ramp)",
    BLOCK + BLOCK + "movable = 1\n": "block 2: movable = 1; expected true or false",
    BLOCK + 'name = ""\n': "block 1: name = \"\"; expected 1 to 64 letters, digits, '_' or '-'",
    BLOCK + 'name = "b"\nsurface = "velvet"\n': f'block 1 (b): surface = "velvet": unknown; {SURFACES}',
    CYLINDER + "movable = true\nmass_g = 0\n": "cylinder 1: mass_g = 0; expected a number from 1 to 10000",
    CYLINDER.replace("12.5", "12,5"): "not TOML: Expected newline or end of document after a "
    "statement (at line 9, column 15)",
    CYLINDER + "x_mm = 4\n": "not TOML: Cannot overwrite a value (at line 11, column 9)",
    LAMP.replace("7", "2000"): "lamp 1: power_w = 2000; expected a number from 0 to 1000",
    LAMP + "z_mm = 0\n": "lamp 1: z_mm = 0; expected a number from 1 to 1000",
    LAMP.replace("450", "501"): "lamp 1: y_mm = 501: outside the arena; expected 0 to 500",
    LAMP + "blink_duty = 2\n": "lamp 1: blink_duty = 2; expected a number from 0 to 1",
    LAMP + "dim = -1\n": "lamp 1: dim = -1; expected a number from 0 to 1",
    "[lighting]\nmax_angle_deg = 0\n": "lighting: max_angle_deg = 0; expected a number from 1 to 180",
    '[lighting]\nmode = "al"\n': "lighting: mode = \"al\": unknown; did you mean 'all'? "
    "(choices: all, random, sequenced)",
    ROBOT.replace("heading", "haeding"): "robot 1: heading_deg is missing; expected a number from "
    "-360 to 360",
    ROBOT + 'model = "khepera5"\n': 'robot 1: model = "khepera5": unknown; did you mean '
    "'khepera4'? (choices: khepera1, khepera2, khepera3, khepera3-firmware2, khepera4)",
    ROBOT.replace("300", "30") + 'model = "khepera2"\n': "robot 1 at (30, 250) overlaps the left "
    "wall at x = 0; expected 5 mm further in",
    ROBOT + "mode = 4\n": "robot 1: mode = 4: mode 4 runs a user's program from the "
    "robot's memory, and the twin runs no machine code; expected a running mode that the twin has "
    "(0, 1, 2, 3, 7)",
    ROBOT + 'mode = "1"\n': 'robot 1: mode = "1"; expected an integer from 0 to 15',
    ROBOT + "rom = 5.02\n": "robot 1: rom = 5.02: unknown; did you mean '5.02'? "
    "(choices: 5.02, 4.06, khepera2, 3.0, kh3server, 2.0, kh4server)",
    "[radio]\nloss = 1.1\n" + ROBOT: "radio: loss = 1.1; expected a number from 0 to 1",
    "[radio]\nrange_mm = -1\n" + ROBOT: "radio: range_mm = -1; expected a number from 0 to 100000",
    "[radio]\nair_time_ms = 0\n" + ROBOT: "radio: air_time_ms = 0; expected a number above 0 up to 10000",
    "[radio]\nrange = 5\n"
    + ROBOT: "radio: range = 5: unknown key; did you mean 'range_mm'? (choices: range_mm, loss, air_time_ms)",
    ROBOT + 'turrets = ["griper"]\n': "robot 1: turrets = ['griper']: unknown turret 'griper'; "
    f"did you mean 'gripper'? (choices: {', '.join(installed_turrets())})",
    ROBOT
    + 'turrets = ["gripper", "gripper"]\n': "robot 1: turrets = ['gripper', 'gripper']: turret 'gripper' is "
    "named twice",
    ROBOT + "battery_used_min = -1\n": "robot 1: battery_used_min = -1; expected a number from 0 to 1000",
    ROBOT + 'turrets = "gripper"\n': 'robot 1: turrets = "gripper"; expected names, such as ["gripper"]',
    ROBOT + 'calibration = ""\n': 'robot 1: calibration = ""; expected the name of a calibration, or '
    "the path of a file",
    CARDBOARD.replace("cardboard", "white"): "surfaces white: built in; expected a name other than "
    "white, grey, black, wood, styropor, sponge, copper, lego",
    CARDBOARD.replace("0.6", "2.5"): "surfaces cardboard: reflectance = 2.5; expected a number from 0 to 2",
    CARDBOARD.replace("180", "256"): "surfaces cardboard: rgb 1 = 256; expected three integers from 0 to 255",
    CARDBOARD.replace("180, ", ""): "surfaces cardboard: rgb 3 is missing; expected three "
    "integers from 0 to 255",
    CARDBOARD.replace("cardboard", '"card board"'): 'surfaces: "card board" is no name; expected 1 '
    "to 64 letters, digits, '_' or '-'",
    ROBOT.replace("300", "20"): "robot 1 at (20, 250) overlaps the left wall at x = 0; expected "
    "7.5 mm further in",
    ROBOT.replace("250", "480.25"): "robot 1 at (300, 480.25) overlaps the top wall at y = 500; "
    "expected 7.8 mm further in",
    ROBOT + ROBOT.replace("300", "350"): "robot 2 at (350, 250) overlaps robot 1 at (300, 250); "
    "expected a place clear of it",
    BLOCK.replace("120", "290")
    + "angle_deg = 60\n"
    + ROBOT: "robot 1 at (300, 250) overlaps block 1 at (290, 200); expected a place clear of it",
    LAMP.replace("50\ny_mm = 450", "330\ny_mm = 250")
    + ROBOT: "robot 1 at (300, 250) overlaps lamp 1 at (330, 250); expected a place clear of it",
    BLOCK + 'name = "wall"\n' + BLOCK.replace("120", "150") + 'movable = true\nname = "box"\n': "block "
    "2 (box) at (150, 200) overlaps block 1 (wall) at (120, 200); expected a place clear of it",
    CYLINDER.replace("400", "595") + "movable = true\n": "cylinder 1 at (595, 250) overlaps the right "
    "wall at x = 600; expected 7.5 mm further in",
    "outline_mm = [[0, 0], [600, 0]]\n": "arena: outline_mm: 2 corners; expected 3 to 200",
    "outline_mm = [[0, 0], [700, 0], [0, 500]]\n": "arena: outline_mm 2: 700: outside width and "
    "height; expected 0 to 600",
    "outline_mm = [[0, 0], [0, 0], [0, 500]]\n": "arena: outline_mm 1: same as the next "
    "corner; expected each corner once",
    "outline_mm = [[0, 0], [600, 500], [600, 0], [0, 500]]\n": "arena: outline_mm: edges 1 and 3 "
    "meet; expected an outline that does not cross or touch itself",
    "outline_mm = [[0, 0], [100, 0], [100, 50], [0, 50]]\n": "arena: outline_mm: 5000 mm2; "
    "expected at least 10000",
    "outline_mm = [[0, 0, 0], [100, 0], [100, 50]]\n": "arena: outline_mm 1; expected corners, "
    "such as [[0, 0], [600, 0], [300, 500]]",
    TRIANGLE + ROBOT.replace("300", "500").replace("250", "400"): "robot 1 at (500, 400) is "
    "outside the arena's outline; expected a place within it",
    TRIANGLE + ROBOT.replace("300", "100").replace("250", "390"): "robot 1 at (100, 390) overlaps "
    "the wall after corner 2; expected a place further in",
    "[[wall]]\npoints_mm = [[10, 10]]\n": "wall 1: points_mm; expected at least two points, such "
    "as [[100, 100], [100, 300]]",
    "[[wall]]\npoints_mm = [[10, 10], [10, 10]]\n": "wall 1: points_mm 1: same as the next "
    "point; expected each point once",
    WALL.replace("300, 100", "700, 100"): "wall 1: points_mm 2: 700: outside the arena; expected 0 to 600",
    WALL + ROBOT.replace("250", "120"): "robot 1 at (300, 120) overlaps wall 1 at (200, 100); "
    "expected a place clear of it",
    "wall_height_mm = 14\n"
    + ROBOT: "arena: wall_height_mm = 14: a robot drives over it at full speed; expected at least 15",
    "wall_height_mm = 20\n" + ROBOT + 'turrets = ["gripper"]\n': "arena: wall_height_mm = 20: a "
    "robot with a turret topples over it at full speed; expected at least 30",
    "wall_thickness_mm = 9\n"
    + CYLINDER
    + "movable = true\n"
    + ROBOT: "arena: wall_thickness_mm = 9: a robot presses movable things through it; expected at least 10",
    CYLINDER
    + "movable = true\nmass_g = 4\n"
    + ROBOT: "cylinder 1: mass_g = 4: a robot presses it through walls; expected at least 5",
    WALL + 'surface = "velvet"\n': f'wall 1: surface = "velvet": unknown; {SURFACES}',
    "[[patch]]\nx_mm = 1\ny_mm = 1\nradius_mm = 9\nwidth_mm = 9\n": "patch 1: neither disc nor "
    "rectangle; expected radius_mm alone, or length_mm and width_mm",
    "[[patch]]\nx_mm = 1\ny_mm = 1\n": "patch 1: neither disc nor rectangle; expected radius_mm "
    "alone, or length_mm and width_mm",
    "[[spot]]\nx_mm = 1\ny_mm = 1\nheading_deg = 0\n": "spot 1: name is missing; expected 1 to "
    "64 letters, digits, '_' or '-'",
    SPOT.replace("250", "10"): "spot 1 (a) at (300, 10) overlaps the bottom wall at y = 0; "
    "expected 17.5 mm further in",
    SPOT + '[[robot]]\nspots = ["b"]\nx_mm = 300\ny_mm = 250\nheading_deg = 0\n': "robot 1: "
    'spots: "b": unknown; (choices: a)',
    '[[robot]]\nspots = ["b"]\n': 'robot 1: spots: "b": unknown; (choices: none)',
    SPOT + SPOT.replace("300", "100"): 'spot 2 (a): name = "a": taken by spot 1 (a); expected a unique name',
    LAMP + "on_s = [[5, 2]]\n": "lamp 1: on_s = [5, 2]; expected times that rise, from 0 on",
    LAMP + "on_s = [[1, 4], [2, 5]]\n": "lamp 1: on_s = [2, 5]; expected times that rise, from 4 on",
    LAMP + "rgb = [1, 2]\n": "lamp 1: rgb 3 is missing; expected three integers from 0 to 255",
    BLOCK
    + 'name = "a"\n'
    + LAMP
    + 'name = "a"\n': 'lamp 1 (a): name = "a": taken by block 1 (a); expected a unique name',
    SPOT
    + '[[robot]]\nname = "r"\nspots = ["a"]\n'
    * 2: 'robot 2 (r): name = "r": taken by robot 1 (r); expected a unique name',
    "[[patch]]\nx_mm = 9999\ny_mm = 99\nradius_mm = 9\n": "patch 1: x_mm = 9999: outside the arena; "
    "expected 0 to 600",
    '[[patch]]\nname = "q"\nx_mm = 99\ny_mm = 99\nradius_mm = 9\n' * 2: 'patch 2 (q): name = "q": taken '
    "by patch 1 (q); expected a unique name",
}
"""Invalid text after a valid head and arena, and its error message."""

WRONG = {
    "": "name is missing; expected 1 to 64 letters, digits, '_' or '-'",
    HEAD: "arena is missing; expected a table",
    HEAD.replace("1", "2") + ARENA: "version = 2; expected 1",
    HEAD.replace("1", "true") + ARENA: "version = true; expected 1",
    HEAD.replace("1", "1.0") + ARENA: "version = 1.0; expected 1",
    'version = 1\nname = "a b"\n' + ARENA: "name = \"a b\"; expected 1 to 64 letters, digits, '_' or '-'",
    HEAD
    + "wdith = 3\n"
    + ARENA: f"wdith = 3: unknown key; (choices: {', '.join(playpens.schema()['properties'])})",
    HEAD + "arena = 3\n": "arena = 3; expected a table",
    HEAD + ARENA.replace("600", "60"): "arena: width_mm = 60; expected a number from 100 to 10000",
    HEAD + ARENA.replace("600", "20000"): "arena: width_mm = 20000; expected a number from 100 to 10000",
    HEAD + ARENA.replace("500", '"500"'): 'arena: height_mm = "500"; expected a number from 100 to 10000',
    **{HEAD + ARENA + text: line for text, line in WRONG_IN_ARENA.items()},
}


@pytest.mark.parametrize(("text", "line"), WRONG.items(), ids=range(len(WRONG)))
def test_a_wrong_file_is_reported_place_key_value_and_what_would_be_right(text: str, line: str) -> None:
    assert f"p.toml: {line}" in lines_about(text)


@pytest.mark.parametrize(("text", "line"), WRONG.items(), ids=range(len(WRONG)))
def test_the_line_that_is_reported_has_the_key_or_begins_the_table(text: str, line: str) -> None:
    numbers = re.findall(r"^p\.toml:(\d+): (.*)$", "\n".join(numbered_lines_about(text)), re.MULTILINE)
    for number, message in numbers:
        reported_line = text.splitlines()[int(number) - 1]
        words = re.findall(r"\w+", message)
        assert set(re.findall(r"\w+", reported_line.partition("=")[0])) & set(words), (reported_line, message)
    # Only missing keys and files that are not TOML have no line.
    if not numbers:
        assert "is missing" in line or "not TOML" in line or "is no name" in line


@pytest.mark.parametrize("text", WRONG, ids=range(len(WRONG)))
def test_no_line_shows_what_the_file_is_checked_with(text: str) -> None:
    message = "\n".join(lines_about(text))
    assert not any(word in message for word in ("pydantic", "http", "Input", "validation", "Traceback"))


def test_all_problems_are_reported_at_once() -> None:
    text = HEAD + ARENA.replace("600", "nan") + BLOCK.replace("50", "-50") + ROBOT + "wheels = 3\n"
    assert len(lines_about(text)) == 3
    text = HEAD + ARENA + ROBOT + ROBOT + ROBOT.replace("300", "5") + LAMP.replace("450", "550")
    assert len(lines_about(text)) == 3


def test_huge_numbers_and_deep_tables_are_refused() -> None:
    assert lines_about(HEAD + ARENA + BLOCK.replace("120", "9" * 400)) == [
        f"p.toml: block 1: x_mm = {'9' * 57}...; {PLACE}"
    ]
    assert "not TOML" in lines_about("a = " + "9" * 5000)[0]
    assert "nested too deeply" in lines_about("a = " + "[" * 50_000)[0]
    assert lines_about("a." * 20_000 + "a = 1") == ["p.toml: a key has more than 32 parts"]


def test_so_many_objects_are_refused_before_they_are_compared() -> None:
    lamps = ",".join(["{x_mm=50,y_mm=450,power_w=7}"] * (PART_LIMIT + 1))
    (line,) = lines_about(f"lamp = [{lamps}]\n" + HEAD + ARENA)
    assert line == "p.toml: 5001 blocks, cylinders, lamps and robots; expected up to 5000 together"


def test_of_very_many_problems_of_a_place_only_the_first_are_reported() -> None:
    robots = ",".join(["{x_mm=300,y_mm=250,heading_deg=0}"] * 1000)
    lines = lines_about(f"robot = [{robots}]\n" + HEAD + ARENA)
    assert len(lines) == PROBLEM_LIMIT + 1
    assert (
        lines[-1]
        == f"p.toml: more than {PROBLEM_LIMIT} problems; the others are reported once these are gone"
    )


# Placement -----------------------------------------------------------------------------------------------


def test_fixed_objects_may_cross_each_other_and_the_walls() -> None:
    assert len(parse(BLOCK, BLOCK + "angle_deg = 90\n", CYLINDER.replace("400", "599")).blocks) == 2


def test_a_robot_may_touch_a_wall_and_another_robot() -> None:
    robot = ROBOT.replace("x_mm = 300", "x_mm = 27.5")
    assert len(parse(robot, robot.replace("27.5", "82.5")).robots) == 2


def test_a_robot_fits_beside_the_corner_of_a_turned_block() -> None:
    # A square of 40 mm on its corner reaches 28.28 mm, plus 27.5 mm of the robot.
    square = (
        "[[block]]\nx_mm = 200\ny_mm = 250\nlength_mm = 40\nwidth_mm = 40\nheight_mm = 50\nangle_deg = 45\n"
    )
    assert parse(square, ROBOT.replace("300", "255.8"))
    with pytest.raises(PlaypenError):
        parse(square, ROBOT.replace("300", "255.7"))


def test_a_robot_may_start_below_a_lamp_that_hangs_high() -> None:
    lamp = LAMP.replace("50\ny_mm = 450", "300\ny_mm = 250")
    assert parse(lamp + "z_mm = 40\n", ROBOT)
    with pytest.raises(PlaypenError):
        parse(lamp + "z_mm = 39\n", ROBOT)


# Files ---------------------------------------------------------------------------------------------------


def test_a_playpen_loads_by_path(tmp_path: Path) -> None:
    file = tmp_path / "mine.toml"
    file.write_text(HEAD + ARENA)
    assert Playpen.load(file) == Playpen.load(str(file)) == parse()


def test_a_missing_file_is_reported_with_what_ships(tmp_path: Path) -> None:
    choices = r"did you mean 'default'\? \(choices: arena3, arena3-line, arena4, arena4-line,"
    with pytest.raises(PlaypenError, match=rf"^defualt: no such file; .*{choices}"):
        Playpen.load("defualt")


@pytest.mark.parametrize(
    ("content", "line"),
    [
        (b"\xff\xfe", "this is text in UTF-16; expected UTF-8, as which an editor can save it"),
        (b"v\xe4", "byte 1 is no UTF-8 text; expected UTF-8, as which an editor can save it"),
        (b"#" * (2**20 + 1), "larger than 1048576 bytes, the most that is read"),
    ],
)
def test_what_is_no_text_of_a_sensible_size_is_refused(tmp_path: Path, content: bytes, line: str) -> None:
    file = tmp_path / "bad.toml"
    file.write_bytes(content)
    with pytest.raises(PlaypenError) as caught:
        Playpen.load(file)
    assert str(caught.value) == f"{file}: {line}"


def test_a_folder_and_an_impossible_path_are_refused(tmp_path: Path) -> None:
    with pytest.raises(PlaypenError, match="cannot be read: Is a directory"):
        Playpen.load(tmp_path)
    with pytest.raises(PlaypenError, match="cannot be read"):
        Playpen.load("a\0b")


@pytest.mark.skipif(os.geteuid() == 0, reason="root may read every file")
def test_an_unreadable_file_is_refused(tmp_path: Path) -> None:
    locked = tmp_path / "locked.toml"
    locked.touch(mode=0)
    with pytest.raises(PlaypenError, match="cannot be read: Permission denied"):
        Playpen.load(locked)


# Dump and parse ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", playpens.names())
def test_a_shipped_playpen_survives_its_dump(name: str) -> None:
    playpen = Playpen.load(name)
    text = playpens.dump(playpen)
    assert playpens.parse(text, "dump") == playpen
    assert playpens.dump(playpens.parse(text, "dump")) == text


def test_a_dump_can_be_given_more_by_hand() -> None:
    assert len(playpens.parse(playpens.dump(parse(ROBOT)) + LAMP, "dump").lamps) == 1


coordinates = st.floats(0, 500, allow_nan=False)
sizes = st.floats(1, 400, allow_nan=False)
object_names = st.none() | st.from_regex(r"[A-Za-z0-9_-]{1,64}", fullmatch=True)
surfaces = st.sampled_from(["white", "grey", "black", "lego"])
angles = st.floats(-360, 360)
blocks = st.builds(
    Block,
    x_mm=coordinates,
    y_mm=coordinates,
    angle_deg=angles,
    length_mm=sizes,
    width_mm=sizes,
    height_mm=sizes,
    surface=surfaces,
    mass_g=sizes,
)
cylinders = st.builds(
    Cylinder, x_mm=coordinates, y_mm=coordinates, radius_mm=sizes, height_mm=sizes, surface=surfaces
)
lamps = st.builds(
    Lamp, x_mm=coordinates, y_mm=coordinates, z_mm=st.floats(41, 1000), power_w=st.floats(0, 1000)
)
robots = st.builds(
    RobotEntry,
    name=object_names,
    x_mm=st.floats(30, 470),
    y_mm=st.floats(30, 470),
    heading_deg=angles,
    calibration=st.text(st.characters(exclude_categories=["Cs"]), min_size=1, max_size=20),
    mode=st.integers(1, 3),
    rom=st.sampled_from(["5.02", "4.06"]),
)


@settings(derandomize=True, database=None, max_examples=20, deadline=None)
@given(
    st.lists(blocks, max_size=3).map(tuple),
    st.lists(cylinders, max_size=3).map(tuple),
    st.lists(lamps, max_size=3).map(tuple),
    robots,
)
def test_any_playpen_survives_its_dump(
    blocks: tuple[Block, ...], cylinders: tuple[Cylinder, ...], lamps: tuple[Lamp, ...], robot: RobotEntry
) -> None:
    base = parse()
    for parts in (
        {"blocks": blocks, "cylinders": cylinders, "lamps": lamps},
        {"robots": (robot,), "lamps": lamps},
    ):
        playpen = base.model_copy(update=parts)
        assert playpens.parse(playpens.dump(playpen), "dump") == playpen


KEYS = [
    *Playpen.model_fields,
    *Block.model_fields,
    *RobotEntry.model_fields,
    *TABLES,
    "width_mm",
    "reflectance",
    "rgb",
    "mode",
    "a.b",
    '"',
]
values = st.one_of(
    st.integers().map(str),
    st.floats().map(repr),
    st.sampled_from(
        ["true", '"all"', "[]", "[1, 2]", "{}", "{x_mm = 1}", "1979-05-27", "'", '"\\u0000"', "[[[]]]"]
    ),
)
settings_of_keys = st.tuples(st.sampled_from(KEYS), values).map(" = ".join)
headers = st.sampled_from(
    ["[arena]", "[lighting]", "[surfaces]", "[surfaces.x]", "[[block]]", "[[robot]]", "[block]"]
)
lines = st.one_of(
    settings_of_keys, headers, st.sampled_from([HEAD, ARENA, BLOCK, ROBOT]), st.text(max_size=20)
)


@settings(derandomize=True, database=None, max_examples=100, deadline=None)
@given(st.lists(lines, max_size=8).map("\n".join))
def test_any_text_is_a_playpen_or_is_refused_as_one(text: str) -> None:
    messages: list[str] = []
    try:
        playpen = playpens.parse(text, "p.toml")
        assert playpens.parse(playpens.dump(playpen), "dump") == playpen
    except PlaypenError as error:
        messages = str(error).splitlines()
    assert all(re.match(r"p\.toml:(\d+:)? ", line) for line in messages)


@pytest.mark.parametrize(
    ("old", "new", "line"),
    [
        ("version = 1", "version = 0x" + "9" * 5000, "version = a number of thousands of digits; expected 1"),
        (
            "[arena]",
            "[lighting]\nmode = 0x" + "9" * 5000 + "\n[arena]",
            "lighting: mode = a number of thousands of digits: unknown; (choices: all, random, sequenced)",
        ),
    ],
)
def test_a_number_too_long_to_write_out_is_reported(old: str, new: str, line: str) -> None:
    text = 'version = 1\nname = "x"\n[arena]\nwidth_mm = 600\nheight_mm = 500\n'
    with pytest.raises(PlaypenError) as caught:
        playpens.parse(text.replace(old, new), "x")
    assert re.sub(r"^x:\d+:", "x:", str(caught.value)) == f"x: {line}"


def test_nesting_of_any_depth_is_an_error_of_ours() -> None:
    for depth in range(440, 500):
        for head in ("", "[" + ".".join("a" * 31) + "]\n"):
            with pytest.raises(PlaypenError):
                playpens.parse(f"{head}b = {'[' * depth}{']' * depth}\n", "x")


# Spots ---------------------------------------------------------------------------------------------------

TWO_SPOTS = SPOT + SPOT.replace('"a"', '"b"').replace("300", "100")


def drawn_positions(text: str, seed: int) -> list[float]:
    playpen = playpens.place_robots(parse(text), np.random.default_rng(seed))
    assert not any(robot.spots for robot in playpen.robots)
    return [robot.x_mm for robot in playpen.robots]


def test_a_robot_stands_at_one_of_its_spots_by_the_seed() -> None:
    positions = [drawn_positions(TWO_SPOTS + '[[robot]]\nspots = ["a", "b"]\n', seed) for seed in range(20)]
    assert {x for (x,) in positions} == {100, 300}
    assert positions[0] == drawn_positions(TWO_SPOTS + '[[robot]]\nspots = ["a", "b"]\n', 0)


def test_robots_that_share_spots_always_find_room_where_there_is() -> None:
    text = TWO_SPOTS + '[[robot]]\nspots = ["a", "b"]\n[[robot]]\nspots = ["a"]\n'
    assert all(drawn_positions(text, seed) == [100, 300] for seed in range(20))


@pytest.mark.parametrize(
    "robots",
    ['[[robot]]\nspots = ["a"]\n[[robot]]\nspots = ["a"]\n', '[[robot]]\nspots = ["a"]\n' + ROBOT],
)
def test_too_few_spots_are_reported(robots: str) -> None:
    (line,) = lines_about(HEAD + ARENA + SPOT + robots)
    assert line == (
        "p.toml: robots: there is not a spot for each of them, clear of the others; expected a spot more"
    )


def test_a_spot_has_room_for_the_largest_robot_that_may_stand_there() -> None:
    text = SPOT.replace("300", "30")
    assert parse(text, '[[robot]]\nspots = ["a"]\n')
    robots = '[[robot]]\nspots = ["a"]\nturrets = ["gripper"]\n[[robot]]\nspots = ["a"]\n'
    assert any(
        "spot 1 (a) at (30, 250) overlaps the left wall" in line
        for line in lines_about(HEAD + ARENA + text + robots)
    )


def test_a_wall_thicker_than_a_notch_is_refused() -> None:
    corners = "[0, 0], [600, 0], [600, 500], [204, 500], [204, 300], [200, 300], [200, 500], [0, 500]"
    notch = f"outline_mm = [{corners}]\n"
    lines = lines_about(HEAD + ARENA + notch)
    assert any("is thicker than the room behind it" in line for line in lines)
    assert parse(arena=ARENA + notch + "wall_thickness_mm = 1\n")


# Schema --------------------------------------------------------------------------------------------------


def test_the_published_schema_is_that_of_the_format() -> None:
    published = Path(__file__).parents[2] / "docs" / "playpen.schema.json"
    assert json.loads(published.read_text()) == playpens.schema(), (
        "run `khep-twin playpen schema -o docs/...`"
    )


def test_the_schema_names_every_table_and_its_limits() -> None:
    schema = playpens.schema()
    tables = {field.alias or name for name, field in Playpen.model_fields.items()}
    assert set(schema["properties"]) == tables
    arena = schema["$defs"]["Arena"]
    assert arena["additionalProperties"] is False
    width = arena["properties"]["width_mm"]
    assert (width["minimum"], width["maximum"]) == (100, 10_000)
