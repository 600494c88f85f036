"""Faults of the Khepera Toolbox for Matlab with playpens and placement, which khep_twin does not have."""

from functools import partial
from pathlib import Path

import numpy as np
import pytest
from command_line import good
from scenes import arena, robot, table
from scipy.io import savemat

from khep_twin import playpen
from khep_twin.board.kernel import AMBIENT
from khep_twin.errors import PlaypenError
from khep_twin.playpen import Playpen
from khep_twin.playpen_to_mjcf import to_spec
from khep_twin.world import World

HEAD, ROBOT = arena(), robot(300, 250, 90)
block = partial(table, "block", length_mm=60, width_mm=20, height_mm=50)


def test_nothing_is_placed_on_top_of_a_wall_or_an_object() -> None:
    for text in (ROBOT.replace("300", "10"), block(x_mm=310, y_mm=260) + ROBOT):
        with pytest.raises(PlaypenError, match=r"robot 1 at .* overlaps"):
            playpen.parse(HEAD + text, "p")


@pytest.mark.parametrize("angle_deg", [0, 17.5, 45, 90, -45, 133])
def test_objects_turn_to_any_angle(angle_deg: float) -> None:
    arena_playpen = playpen.parse(HEAD + block(x_mm=300, y_mm=250, angle_deg=angle_deg), "p")
    model = to_spec(arena_playpen).compile()
    w, _, _, z = model.geom_quat[model.geom("block0").id]
    assert np.degrees(2 * np.arctan2(z, w)) == pytest.approx(angle_deg)


def test_objects_and_robots_are_moved_and_turned_where_they_stand() -> None:
    text = HEAD + block(x_mm=100, y_mm=100) + ROBOT
    original = playpen.parse(text, "p")
    moved = original.model_copy(
        update={
            "blocks": (original.blocks[0].model_copy(update={"x_mm": 200.0, "angle_deg": 30.0}),),
            "robots": (original.robots[0].model_copy(update={"y_mm": 300.0, "heading_deg": 15.0}),),
        }
    )
    assert playpen.parse(playpen.edited(text, moved), "p") == moved


def test_a_lamp_does_not_shine_through_a_wall() -> None:
    lamp = table("lamp", x_mm=300, y_mm=450, power_w=7)
    wall = table("wall", points_mm=[[100, 350], [500, 350]], height_mm=60)
    free_view, behind_wall = (
        World(playpen.parse(HEAD + text, "p"), noise=False).robots[0].registers[AMBIENT]
        for text in (lamp + ROBOT, lamp + wall + ROBOT)
    )
    assert free_view[2] < 400
    assert (behind_wall == behind_wall[6]).all()


def test_more_than_one_robot_has_room() -> None:
    assert len(playpen.parse(HEAD + ROBOT + ROBOT.replace("300", "400"), "p").robots) == 2


def test_a_scanned_playpen_comes_out_the_right_way_up(tmp_path: Path) -> None:
    # Drawn with something in the upper left corner; scanned, the last row is the upper one.
    drawn = np.ones((500, 600))
    drawn[40:60, 50:110] = 44
    savemat(tmp_path / "scan.mat", {"btmap1": np.flipud(drawn)})
    good("playpen", "import", tmp_path / "scan.mat", "-o", tmp_path / "scan.toml")
    (one,) = Playpen.load(tmp_path / "scan.toml").blocks
    assert (one.x_mm, one.y_mm, one.length_mm, one.width_mm) == (80, 450, 60, 20)
