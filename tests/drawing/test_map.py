"""Drawings: to scale, complete, and the same for the same arguments."""

import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import matplotlib
import numpy as np
import pytest
from matplotlib.collections import LineCollection
from matplotlib.colors import to_hex
from matplotlib.figure import Figure
from matplotlib.patches import Circle, FancyArrowPatch, Polygon, Rectangle
from matplotlib.text import Text
from matplotlib.transforms import Bbox
from numpy.typing import NDArray

from khep_twin import playpen as playpens
from khep_twin.drawing.map import POINT_LIMIT, draw, save
from khep_twin.drawing.paths import DrawnPath
from khep_twin.errors import KhepTwinError
from khep_twin.playpen import Playpen

SCENE = playpens.parse(
    """
version = 1
name = "scene"
[arena]
width_mm = 600
height_mm = 300
surface = "grey"
[surfaces.cork]
reflectance = 0.6
rgb = [180, 140, 90]
[[block]]
x_mm = 200
y_mm = 150
length_mm = 60
width_mm = 20
height_mm = 50
angle_deg = 30
surface = "cork"
[[cylinder]]
x_mm = 300
y_mm = 200
radius_mm = 20
height_mm = 50
movable = true
[[lamp]]
x_mm = 500
y_mm = 250
power_w = 7.5
[[robot]]
x_mm = 100
y_mm = 100
heading_deg = 0
[[robot]]
x_mm = 500
y_mm = 100
heading_deg = 180
""",
    "scene.toml",
)


def track(n: int = 50, start_s: float = 0) -> DrawnPath:
    time_s = np.linspace(start_s, start_s + 10, n)
    return DrawnPath("khepera0", time_s, np.stack((100 + 10 * time_s, 100 + 5 * time_s), axis=1))


def texts(figure: Figure) -> set[str]:
    return {text.get_text() for text in figure.findobj(Text) if isinstance(text, Text)}


def scene_with(mode: str, lamps: int = 3) -> playpens.Playpen:
    lamp = "[[lamp]]\nx_mm = {}\ny_mm = 100\npower_w = 4\n"
    text = "".join(lamp.format(100 + 150 * index) for index in range(lamps))
    return playpens.parse(
        f'version = 1\nname = "lit"\n[arena]\nwidth_mm = 600\nheight_mm = 300\n'
        f'[lighting]\nmode = "{mode}"\n{text}',
        "lit.toml",
    )


def glow(figure: Figure) -> NDArray[np.float64]:
    """Return the strength of the tint along the lamps."""
    (image,) = figure.axes[0].images
    alpha = np.asarray(image.get_array())[..., 3]
    return alpha[alpha.shape[0] // 3]


def test_sequenced_lamps_are_numbered_with_arrows_between_and_one_is_on() -> None:
    figure = draw(scene_with("sequenced"))
    assert {"1: 4 W", "2: 4 W", "3: 4 W", "one lamp on, in sequence"} <= texts(figure)
    assert sum(isinstance(patch, FancyArrowPatch) for patch in figure.axes[0].patches) == 3
    light = glow(figure)
    assert light.argmax() == pytest.approx(len(light) * 100 / 600, abs=10)  # as wide as the bulb
    assert light[len(light) * 250 // 600] < light.max() / 2


def test_lamps_at_random_share_the_light_and_none_is_drawn_as_on() -> None:
    figure, all_on = draw(scene_with("random")), draw(scene_with("all"))
    assert "one lamp on, at random" in texts(figure)
    assert "one lamp on, at random" not in texts(all_on)
    assert glow(figure).max() < glow(all_on).max()
    rays = [len(drawing.axes[0].lines) for drawing in (figure, all_on)]
    assert rays == [0, 24]


def boxes(figure: Figure) -> list[Bbox]:
    figure.draw_without_rendering()
    return [text.get_window_extent() for text in figure.axes[0].texts]


def test_labels_do_not_overlap_where_paths_end_together() -> None:
    time_s = np.linspace(0, 1, 5)
    paths = [
        DrawnPath(f"starts-{k:03d}", time_s, np.stack((200 + 3 * k * time_s, 100 + time_s), axis=1))
        for k in range(11)
    ]
    label_boxes = boxes(draw(SCENE, paths))
    assert len(label_boxes) == 14  # two robots, a lamp and eleven ends
    for index, box in enumerate(label_boxes):
        assert not any(box.overlaps(other) for other in label_boxes[:index])


def test_a_label_at_the_wall_stays_within_the_axes() -> None:
    text = "version = 1\nname = 'x'\n[arena]\nwidth_mm = 600\nheight_mm = 300\n"
    figure = draw(playpens.parse(text + "[[lamp]]\nx_mm = 5\ny_mm = 5\npower_w = 1\n", "x.toml"))
    (box,) = boxes(figure)
    window = figure.axes[0].get_window_extent()
    assert window.x0 <= box.x0
    assert window.y0 <= box.y0


def test_a_small_drawing_keeps_the_size_of_its_letters() -> None:
    small, large = draw(SCENE, longer_side=3), draw(SCENE)
    assert small.get_figwidth() < large.get_figwidth() - 2
    sizes = [{text.get_fontsize() for text in figure.findobj(Text)} for figure in (small, large)]
    assert sizes[0] == sizes[1]


def test_a_drawing_names_robots_axes_lamps_surfaces_and_playpen() -> None:
    words = texts(draw(SCENE))
    assert {"khepera0", "khepera1", "7.5 W", "x [mm]", "y [mm]", "scene", "cork", "white", "movable"} <= words
    assert "time [s]" not in words


def test_a_title_takes_the_name_s_place() -> None:
    words = texts(draw(SCENE, title="Run 3"))
    assert "Run 3" in words
    assert "scene" not in words


def test_a_millimetre_is_as_long_along_x_as_along_y(tmp_path: Path) -> None:
    figure = draw(SCENE, [track()])
    save(figure, tmp_path / "scene.png")
    corner, along, up = figure.axes[0].transData.transform([(0, 0), (100, 0), (0, 100)])
    assert along[0] - corner[0] == pytest.approx(up[1] - corner[1])


def test_what_a_playpen_holds_stands_where_it_says() -> None:
    axes = draw(SCENE).axes[0]
    circles = {(circle.center, circle.radius) for circle in axes.patches if isinstance(circle, Circle)}
    assert {((300, 200), 20), ((500, 250), 10), ((100, 100), 27.5), ((500, 100), 27.5)} <= circles
    block = next(patch for patch in axes.patches if isinstance(patch, Rectangle) and patch.get_width() == 60)
    corners = block.get_patch_transform().transform(block.get_path().vertices)[:4]
    assert corners.mean(axis=0) == pytest.approx((200, 150))
    assert corners[1] - corners[0] == pytest.approx((60 * np.cos(np.pi / 6), 60 * np.sin(np.pi / 6)))
    assert block.get_facecolor()[:3] == pytest.approx((180 / 255, 140 / 255, 90 / 255))


def test_a_robot_s_wedge_points_ahead() -> None:
    axes = draw(SCENE).axes[0]
    wedges = [patch for patch in axes.patches if isinstance(patch, Polygon) and len(patch.get_xy()) == 4]
    tips = [wedge.get_xy()[0] for wedge in wedges]
    assert tips[0] == pytest.approx((100 + 0.88 * 27.5, 100))
    assert tips[1] == pytest.approx((500 - 0.88 * 27.5, 100))


def test_movable_things_are_hatched_and_dashed() -> None:
    axes = draw(SCENE).axes[0]
    hatched = [patch for patch in axes.patches if patch.get_hatch()]
    assert [patch.center for patch in hatched if isinstance(patch, Circle)] == [(300, 200)]
    assert len(hatched) == 1
    assert hatched[0].get_linestyle() != "solid"


def test_the_axes_end_at_the_walls() -> None:
    axes = draw(
        SCENE, [DrawnPath("khepera0", np.array([0.0, 1.0]), np.array([(100.0, 100.0), (2000.0, 2000.0)]))]
    ).axes[0]
    assert axes.get_xlim() == (-12, 612)
    assert axes.get_ylim() == (-12, 312)


def test_all_tracks_share_one_scale_of_time() -> None:
    figure = draw(SCENE, [track(), track(start_s=5)])
    paths = [item for item in figure.axes[0].collections if isinstance(item, LineCollection)]
    assert [(path.norm.vmin, path.norm.vmax) for path in paths] == [(0, 15), (0, 15)]
    assert {"time [s]", "start", "end"} <= texts(figure)


def test_paths_of_several_robots_have_a_colour_and_a_name_each() -> None:
    other = replace(track(start_s=5), robot="khepera1")
    figure = draw(SCENE, [track(), other])
    paths = [item for item in figure.axes[0].collections if isinstance(item, LineCollection)]
    (legend,) = figure.legends
    handles = {line.get_label(): line.get_color() for line in legend.get_lines()}
    assert [to_hex(path.get_colors()[0]) for path in paths] == [handles["khepera0"], handles["khepera1"]]
    assert handles["khepera0"] != handles["khepera1"]
    assert "time [s]" not in texts(figure)


def test_arrays_in_metres_are_paths_by_name_or_without() -> None:
    one, other = np.array([[0.1, 0.1], [0.2, 0.2]]), np.array([[0.3, 0.1, 0.0], [0.4, 0.1, np.pi]])
    failed = np.full((2, 3), np.nan)  # of an episode that failed
    for paths in ([one, other], {"a": one, "b": other}, [DrawnPath("", None, 1000 * one), other, failed]):
        drawn = [
            lines for lines in draw(SCENE, paths).axes[0].collections if isinstance(lines, LineCollection)
        ]
        assert [lines.get_segments()[0].tolist() for lines in drawn] == pytest.approx(
            np.array([[[100, 100], [200, 200]], [[300, 100], [400, 100]]])
        )
        assert drawn[0].get_colors().tolist() != drawn[1].get_colors().tolist()
    assert len(draw("default", np.zeros((2, 3, 10, 3))).axes[0].collections) == 6


@pytest.mark.parametrize(
    ("path", "message"),
    [
        (np.zeros(3), r"ndarray of shape \(3,\); expected positions \(n, 2\) or poses \(n, 3\) \[m\]"),
        (["x"], r"a path: str of shape \(0,\); expected positions"),
        (7, r"paths: int; expected arrays of positions \[m\], or DrawnPaths"),
        (np.full((3, 2), 250.0), "a path with a coordinate of 250 m; expected metres"),
    ],
)
def test_other_arrays_are_refused_in_one_line(path: Any, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        draw(SCENE, path)


def test_a_track_runs_from_its_first_to_its_last_point() -> None:
    figure = draw(SCENE, [track()])
    (path,) = figure.axes[0].collections
    assert isinstance(path, LineCollection)
    segments = path.get_segments()
    assert segments[0][0] == pytest.approx((100, 100))
    assert segments[-1][1] == pytest.approx((200, 150))


@pytest.mark.parametrize("n", [0, 1, 2])
def test_the_shortest_tracks_can_be_drawn(tmp_path: Path, n: int) -> None:
    save(draw(SCENE, [track(n)]), tmp_path / "short.png")


def test_of_a_long_track_evenly_many_points_are_drawn() -> None:
    (path,) = draw(SCENE, [track(3 * POINT_LIMIT + 1)]).axes[0].collections
    assert isinstance(path, LineCollection)
    assert POINT_LIMIT / 2 < len(path.get_segments()) <= POINT_LIMIT


@pytest.mark.parametrize(
    ("time_s", "xy_mm"),
    [([0, 1], [(0, 0)]), ([0], [(0, 0, 0)]), ([[0]], [(0, 0)]), ([np.nan], [(0, 0)]), ([0], [(0, np.inf)])],
)
def test_a_track_is_finite_and_has_a_place_for_every_time(time_s: list[float], xy_mm: list[float]) -> None:
    with pytest.raises(ValueError, match=r"are not \(n,\)|not finite"):
        DrawnPath("khepera0", np.array(time_s, float), np.array(xy_mm, float))


@pytest.mark.share(6)
@pytest.mark.parametrize("name", playpens.names())
def test_every_shipped_playpen_can_be_drawn(tmp_path: Path, name: str) -> None:
    file = tmp_path / f"{name}.png"
    save(draw(Playpen.load(name)), file)
    assert file.read_bytes().startswith(b"\x89PNG")


@pytest.mark.parametrize("size", ["width_mm = 10000\nheight_mm = 100", "width_mm = 100\nheight_mm = 10000"])
def test_the_longest_arenas_can_be_drawn(tmp_path: Path, size: str) -> None:
    text = f'version = 1\nname = "long"\n[arena]\n{size}\n[[lamp]]\nx_mm = 50\ny_mm = 50\npower_w = 1\n'
    save(draw(playpens.parse(text, "long.toml")), tmp_path / "long.png")


@pytest.mark.share(3)
@pytest.mark.parametrize("suffix", ["png", "svg", "pdf"])
def test_the_same_arguments_give_the_same_bytes_whatever_matplotlib_is_set_to(
    tmp_path: Path, suffix: str
) -> None:
    one, two = tmp_path / f"one.{suffix}", tmp_path / f"two.{suffix}"
    save(draw(SCENE, [track()]), one)
    with matplotlib.rc_context(
        {"lines.linewidth": 9, "font.size": 20, "svg.hashsalt": "x", "savefig.dpi": 30}
    ):
        save(draw(SCENE, [track()]), two)
    assert one.read_bytes() == two.read_bytes()


def test_drawing_leaves_matplotlib_as_it_was(tmp_path: Path) -> None:
    before = dict(matplotlib.rcParams)
    save(draw(SCENE, [track()]), tmp_path / "scene.svg")
    assert dict(matplotlib.rcParams) == before


def test_an_svg_is_well_formed_and_has_neither_hour_nor_version(tmp_path: Path) -> None:
    file = tmp_path / "scene.SVG"
    save(draw(SCENE), file)
    text = file.read_text()
    assert ElementTree.fromstring(text).tag.endswith("svg")
    assert "matplotlib.org/" not in text.replace("matplotlib.org/\n", "")
    assert "<dc:date>" not in text


def test_another_suffix_is_refused(tmp_path: Path) -> None:
    for name in ("scene.bmp", "scene"):
        with pytest.raises(KhepTwinError, match=r"expected a name that ends in \.png, \.svg or \.pdf"):
            save(draw(SCENE), tmp_path / name)
    assert not list(tmp_path.iterdir())


def test_a_place_that_cannot_be_written_is_reported(tmp_path: Path) -> None:
    with pytest.raises(KhepTwinError, match=r"scene\.png: cannot be written: there is no directory"):
        save(draw(SCENE), tmp_path / "missing" / "scene.png")


def test_drawing_needs_no_pyplot_and_no_window() -> None:
    program = "import sys, khep_twin.drawing.map; sys.exit('matplotlib.pyplot' in sys.modules)"
    subprocess.run([sys.executable, "-c", program], check=True, timeout=60)
