"""Saving into a file with comments: unchanged lines stay."""

import contextlib
import tomllib

import pytest

from khep_twin import playpen as playpens
from khep_twin.errors import PlaypenError
from khep_twin.files import toml_files
from khep_twin.playpen import Block, Lamp

TEXT = """# My playpen, measured on Monday.
version = 1
name = "mine"     # short

[arena]
width_mm = 600    # by the ruler
height_mm = 500

# The first one is made of wood.
[[block]]
x_mm = 120
y_mm = 200
length_mm = 60
width_mm  =  20   # two spaces
height_mm = 50
surface = "wood"

[[block]]         # the second
name = "second"
x_mm = 300
y_mm = 100
length_mm = 60
width_mm = 20
height_mm = 50

[[robot]]
x_mm = 300
y_mm = 250
heading_deg = 90  # up
"""


def test_what_is_not_changed_comes_back_byte_for_byte() -> None:
    assert playpens.edited(TEXT, playpens.parse(TEXT, "mine")) == TEXT


@pytest.mark.parametrize("name", playpens.names())
def test_a_shipped_playpen_comes_back_byte_for_byte(name: str) -> None:
    text = (toml_files.folder("playpens") / f"{name}.toml").read_text()
    assert playpens.edited(text, playpens.parse(text, name)) == text


def edited_text(**update: object) -> str:
    playpen = playpens.parse(TEXT, "mine").model_copy(update=update)
    text = playpens.edited(TEXT, playpen)
    assert playpens.parse(text, "edited") == playpen
    return text


def test_a_value_is_changed_where_it_stands_and_its_comment_stays() -> None:
    robot = playpens.parse(TEXT, "mine").robots[0].model_copy(update={"heading_deg": 45.0, "mode": 2})
    assert edited_text(robots=(robot,)) == TEXT.replace(
        "heading_deg = 90  # up", "heading_deg = 45.0  # up\nmode = 2"
    )


def test_a_thing_that_goes_takes_its_lines_with_it_and_no_others() -> None:
    first, second = playpens.parse(TEXT, "mine").blocks
    text = edited_text(blocks=(second,))
    assert "[[block]]         # the second" in text
    assert "made of wood" not in text.split("[[block]]")[1]
    assert "width_mm  =  20   # two spaces" in edited_text(blocks=(first,))


def test_a_new_thing_comes_behind_those_of_its_kind() -> None:
    playpen = playpens.parse(TEXT, "mine")
    third = Block(name="third", x_mm=400, y_mm=400, length_mm=20, width_mm=20, height_mm=50)
    text = edited_text(blocks=(*playpen.blocks, third))
    assert text.startswith(TEXT[: TEXT.index("[[robot]]")].rstrip())
    assert text.index("third") < text.index("[[robot]]")
    assert "# by the ruler" in text


def test_a_new_thing_has_no_keys_with_their_defaults() -> None:
    head = 'version = 1\nname = "p"\n\n[arena]\nwidth_mm = 600\nheight_mm = 500\n'
    playpen = playpens.parse(
        head
        + "[lighting]\nmode = 'random'\n"
        + "[[block]]\nx_mm = 100\ny_mm = 100\nlength_mm = 60\nwidth_mm = 20\nheight_mm = 50\n"
        + "[[lamp]]\nx_mm = 50\ny_mm = 50\npower_w = 2\n"
        + "[[spot]]\nname = 'a'\nx_mm = 300\ny_mm = 200\nheading_deg = 0\n"
        + "[[robot]]\nspots = ['a']\n"
        + "[[robot]]\nx_mm = 500\ny_mm = 400\nheading_deg = 90\nmodel = 'khepera2'\nrom = '5.02'\n",
        "p",
    )
    text = playpens.edited(head, playpen)
    assert playpens.parse(text, "p") == playpen
    data = tomllib.loads(text)
    assert data["arena"] == {"width_mm": 600, "height_mm": 500}
    assert data["lighting"] == {"mode": "random"}
    assert data["lamp"] == [{"x_mm": 50, "y_mm": 50, "power_w": 2}]
    assert sorted(data["block"][0]) == ["height_mm", "length_mm", "width_mm", "x_mm", "y_mm"]
    # Keys that follow from a spot or a model are written only if they deviate.
    assert data["robot"] == [
        {"spots": ["a"]},
        {"x_mm": 500, "y_mm": 400, "heading_deg": 90, "model": "khepera2", "rom": "5.02"},
    ]
    # A default that the file states stays.
    explicit = head.replace("height_mm = 500", "height_mm = 500\nsurface = 'white'")
    assert "surface = 'white'" in playpens.edited(explicit, playpen)


def test_the_first_thing_of_a_kind_can_be_given() -> None:
    text = edited_text(lamps=(Lamp(x_mm=50, y_mm=50, power_w=2),))
    assert text.startswith(TEXT.rstrip())
    assert "[[lamp]]" in text


def test_all_things_of_a_kind_can_be_taken_away() -> None:
    assert "[[block]]" not in edited_text(blocks=())


def test_a_file_without_a_last_line_end_can_be_added_to() -> None:
    text = TEXT.rstrip()
    playpen = playpens.parse(text, "mine")
    extended = playpen.model_copy(update={"lamps": (Lamp(x_mm=50, y_mm=50, power_w=2),)})
    assert playpens.parse(playpens.edited(text, extended), "edited") == extended


SPOTS = (
    '[[spot]]\nname = "a"\nx_mm = 100\ny_mm = 400\nheading_deg = 0\n\n'
    '[[spot]]\nname = "b"\nx_mm = 500\ny_mm = 400\nheading_deg = 90\n\n'
)


def test_what_follows_from_spots_and_model_is_written_where_they_change() -> None:
    head, robot = TEXT.split("[[robot]]\n")
    text = head + SPOTS + '[[robot]]\nspots = ["a"]\n'
    playpen = playpens.parse(text, "mine")
    for update in (
        {"spots": ("b",)},
        {"spots": ()},
        {"spots": ("b", "a"), "x_mm": 500.0, "heading_deg": 90.0},
        {"model": "khepera2"},
        {"model": "khepera2", "calibration": "khepera2", "rom": "khepera2"},
    ):
        changed_robot = playpen.robots[0].model_copy(update=update)
        extended = playpen.model_copy(update={"robots": (changed_robot,)})
        assert playpens.parse(playpens.edited(text, extended), "edited") == extended
    moved = (playpen.spots[0].model_copy(update={"x_mm": 120.0}), playpen.spots[1])
    extended = playpen.model_copy(update={"spots": moved})
    assert playpens.parse(playpens.edited(text, extended), "edited") == extended
    assert robot


def test_a_file_in_other_styles_is_changed_rightly_or_not_at_all() -> None:
    text = 'version = 1\nname = "p"\nsurfaces.a = {reflectance = 0.5, rgb = [1, 2, 3]}\n'
    text += 'lighting.mode = "all"\narena = {width_mm = 600, height_mm = 500}\n'
    playpen = playpens.parse(text, "p")
    extended = playpen.model_copy(update={"surfaces": {**playpen.surfaces, "z": playpen.surfaces["a"]}})
    result = None
    with contextlib.suppress(PlaypenError):
        result = playpens.parse(playpens.edited(text, extended), "edited")
    assert result in (None, extended)
