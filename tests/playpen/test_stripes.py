"""Stripes of a playpen: panels, checks, scene and infrared reflectance."""

import math

import numpy as np
import pytest

from khep_twin import playpen as playpens
from khep_twin.errors import PlaypenError
from khep_twin.playpen import Block, Playpen
from khep_twin.playpen.footprint import Circle, Rectangle
from khep_twin.playpen.merge import merge_blocks
from khep_twin.playpen.stripes import panels, panels_within, stripe_intervals
from khep_twin.playpen_to_mjcf import to_spec

PATTERN = ((20.0, "black"), (30.0, "white"))
HEAD = 'version = 1\nname = "p"\n[arena]\nwidth_mm = 600\nheight_mm = 500\n'
STRIPES = 'stripes = [[20, "black"], [30, "white"]]\n'
BLOCK = "[[block]]\nx_mm = 120\ny_mm = 200\nlength_mm = 60\nwidth_mm = 20\nheight_mm = 50\n"
ROUND = "[[cylinder]]\nx_mm = 400\ny_mm = 250\nradius_mm = 12.5\nheight_mm = 50\n"
WALL = "[[wall]]\npoints_mm = [[200, 100], [300, 100], [300, 200]]\n"


def parse(text: str) -> Playpen:
    return playpens.parse(text, "p.toml")


def test_a_pattern_repeats_along_a_side_and_its_last_stripe_is_cut() -> None:
    intervals = list(stripe_intervals(110, PATTERN))
    assert [(first, last) for first, last, _ in intervals] == [
        (0, 20),
        (20, 50),
        (50, 70),
        (70, 100),
        (100, 110),
    ]
    assert [surface for _, _, surface in intervals] == ["black", "white", "black", "white", "black"]


def test_the_sides_of_a_block_begin_at_their_left_as_seen_from_outside() -> None:
    block_panels = list(panels(Rectangle(0, 0, 60, 40, 0), PATTERN))
    front, right, back, left = block_panels[:3], block_panels[3:5], block_panels[5:8], block_panels[8:]
    assert [panel.ends for panel in front] == [
        ((-30, -20), (-10, -20)),
        ((-10, -20), (20, -20)),
        ((20, -20), (30, -20)),
    ]
    # Seen from x > 30, the lower corner of the block is on the left.
    assert right[0].ends == (pytest.approx((30, -20)), pytest.approx((30, 0)))
    assert back[0].ends == (pytest.approx((30, 20)), pytest.approx((10, 20)))
    assert left[0].ends == (pytest.approx((-30, 20)), pytest.approx((-30, 0)))
    assert sum(panel.width_mm for panel in block_panels) == pytest.approx(200)


@pytest.mark.parametrize(
    "corners", [((0, 0), (60, 0), (60, 50), (0, 50)), ((0, 50), (60, 50), (60, 0), (0, 0))]
)
def test_the_walls_of_an_arena_begin_at_their_left_as_seen_from_inside(
    corners: tuple[tuple[float, float], ...],
) -> None:
    wall_panels = list(panels_within(corners, ((100.0, "black"),)))
    assert len(wall_panels) == 4
    for panel in wall_panels:
        (x0, y0), (x1, y1) = panel.ends
        # The inside is on the right on the way from the left end to the right end.
        assert (x1 - x0) * (25 - y0) - (y1 - y0) * (30 - x0) < 0


def test_a_cylinder_s_stripes_cover_it_by_flat_panels_that_touch_it() -> None:
    cylinder_panels = list(panels(Circle(100, 50, 10), PATTERN))
    assert {panel.surface for panel in cylinder_panels} == {"black", "white"}
    middles = np.array([(panel.x_mm, panel.y_mm) for panel in cylinder_panels]) - (100, 50)
    assert np.hypot(*middles.T) == pytest.approx(10)
    ends = np.array([panel.ends for panel in cylinder_panels]) - (100, 50)
    assert np.hypot(ends[..., 0], ends[..., 1]).max() <= 10 / math.cos(math.radians(3)) + 1e-9
    turns = np.unwrap(np.arctan2(ends[..., 1], ends[..., 0]).ravel())
    # Counter-clockwise all the way round, with neither gap nor overlap.
    assert turns[1:-1:2] == pytest.approx(turns[2::2])
    assert turns[-1] - turns[0] == pytest.approx(2 * math.pi)
    black = [panel for panel in cylinder_panels if panel.surface == "black"]
    assert sum(panel.width_mm for panel in black) == pytest.approx(20 + 62.832 - 50, rel=0.002)


def test_the_infrared_sees_the_mean_reflectance() -> None:
    model = to_spec(parse(HEAD + STRIPES + BLOCK + STRIPES)).compile()
    mean = (20 * 0.023 + 30 * 1.0) / 50
    for name in ("wall_left", "wall_top", "block0"):
        assert model.geom(name).user[0] == pytest.approx(mean)
        assert model.geom(name).rgba[:3] == pytest.approx([244 / 255, 243 / 255, 238 / 255], abs=1e-6)


def test_stripes_are_sites_that_nothing_touches() -> None:
    plain, striped = (
        to_spec(parse(text)).compile() for text in (HEAD + ROUND, HEAD + STRIPES + ROUND + STRIPES)
    )
    assert striped.ngeom == plain.ngeom
    assert striped.nsite > plain.nsite + 40
    for site in range(striped.nsite):
        assert striped.site(site).name.startswith(("stripe_wall_", "stripe_cylinder0_"))


def test_stripes_move_with_what_they_are_on() -> None:
    model = to_spec(parse(HEAD + BLOCK + STRIPES + "movable = true\nangle_deg = 30\n")).compile()
    block = model.body("block0").id
    assert (model.site_bodyid == block).all()
    # In the frame of the block its sides are at half of its length and width.
    assert np.abs(model.site_pos[:, :2]).max(axis=0) == pytest.approx([0.03, 0.01], abs=1e-4)
    assert model.site_pos[:, 2] == pytest.approx(0)


def test_striped_blocks_are_not_merged() -> None:
    blocks = [
        Block(x_mm=x, y_mm=100, length_mm=20, width_mm=20, height_mm=50, stripes=PATTERN) for x in (100, 120)
    ]
    assert len(merge_blocks(blocks)) == 2
    assert len(merge_blocks([block.model_copy(update={"stripes": ()}) for block in blocks])) == 1


@pytest.mark.parametrize(
    ("text", "line"),
    [
        (HEAD + 'stripes = [[20, "blak"]]\n', "arena: stripes 1: \"blak\": unknown; did you mean 'black'?"),
        (HEAD + BLOCK + 'stripes = [[20, "black"], [5, "x"]]\n', 'block 1: stripes 2: "x": unknown'),
        (HEAD + WALL + 'stripes = [[20, "x"]]\n', 'wall 1: stripes 1: "x": unknown'),
        (HEAD + 'stripes = [[0.5, "black"]]\n', "expected widths from 1 to 10000"),
        (HEAD + "stripes = [20, 30]\n", "stripes"),
        (
            HEAD.replace("600", "9000").replace("500", "9000") + 'stripes = [[1, "black"]]\n',
            "more than 5000 panels",
        ),
    ],
)
def test_a_wrong_pattern_is_refused(text: str, line: str) -> None:
    with pytest.raises(PlaypenError) as error:
        parse(text)
    assert line in str(error.value)


def test_stripes_survive_a_file_and_an_edit() -> None:
    mine = parse(HEAD + STRIPES + BLOCK + STRIPES + ROUND + WALL + STRIPES)
    assert playpens.parse(playpens.dump(mine), "p.toml") == mine
    moved = mine.blocks[0].model_copy(update={"x_mm": 130.0, "stripes": ((10.0, "grey"),)})
    changed = mine.model_copy(update={"blocks": (moved,)})
    text = HEAD + STRIPES + BLOCK + STRIPES + ROUND + WALL + STRIPES
    assert parse(playpens.edited(text, changed)) == changed
