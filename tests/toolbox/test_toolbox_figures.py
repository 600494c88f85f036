"""The toolbox's graphs and khepbase, without a screen."""

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from khep_twin import toolbox
from khep_twin.errors import KhepTwinError, SensorTestError
from khep_twin.toolbox import robot_view

pytestmark = pytest.mark.usefixtures("no_screen")


def rows(left: int, right: int) -> np.ndarray:
    """Return a test whose sensors increase by 1 per row, with offsets of 10 between sensors."""
    ramp = np.arange(21)
    counters = [np.round(ramp / 20 * end) for end in (left, right)]
    return np.column_stack([*counters, *(ramp + 10 * sensor for sensor in range(8))])


@pytest.mark.parametrize(("draw", "grid"), [(toolbox.ddl, False), (toolbox.ddlg, True)])
def test_a_straight_path_counts_down_to_0_cm(draw: object, grid: bool) -> None:
    figure = draw(rows(1500, 1500), 1500)  # type: ignore[operator]
    axes = [subplot for subplot in figure.axes if subplot.lines]
    assert [subplot.get_title() for subplot in axes][:3] == ["left 90", "left 45", "left 10"]
    assert axes[0].lines[0].get_xdata()[[0, -1]] == pytest.approx([12, 0], abs=1e-9)
    assert axes[3].lines[0].get_ydata()[0] == 30
    assert axes[0].get_xlim()[0] > axes[0].get_xlim()[1]
    assert any(line.get_visible() for line in axes[0].get_xgridlines()) == grid


@pytest.mark.parametrize(("draw", "grid"), [(toolbox.ddr, False), (toolbox.ddrg, True)])
def test_a_turn_is_in_degrees(draw: object, grid: bool) -> None:
    # 85 pulses are 14.98 degrees, as near to 15 as pulses come.
    figure = draw(rows(-85, 85), 85, "light")  # type: ignore[operator]
    axes = figure.axes[0]
    assert axes.lines[0].get_xdata()[-1] == pytest.approx(15, abs=0.1)
    assert axes.get_xlabel() == "" or "degrees" in axes.get_xlabel()
    assert 500 < axes.get_ylim()[1] < 600
    assert any(line.get_visible() for line in axes.get_xgridlines()) == grid


def description(figure: object) -> str:
    """Return the text below a figure's graphs."""
    return " ".join(text.get_text() for text in figure.texts)  # type: ignore[attr-defined]


def test_the_speed_that_was_driven_is_named_or_none() -> None:
    assert "speed" not in description(toolbox.ddl(rows(1500, 1500), 1500))
    assert "speed 4" in description(toolbox.ddlg(rows(1500, 1500), 1500, speed=4))
    assert "speed" not in toolbox.disonel(rows(1500, 1500), 1500, 3).axes[0].get_title(loc="left")
    assert "speed 7" in toolbox.disonel(rows(1500, 1500), 1500, 3, speed=7).axes[0].get_title(loc="left")
    toolbox.open_default(noise=False)
    dv, khep_pos = toolbox.simsense("light", rotate_deg=30, max_speed=9)
    # Quantity and speed of the test are known.
    text = description(toolbox.ddr(dv, khep_pos))
    assert "light" in text
    assert "speed 9" in text
    assert "speed" not in description(toolbox.ddr(dv.copy(), khep_pos))


@pytest.mark.parametrize("which_one", [3, "left 10"])
def test_one_sensor_is_drawn_alone(which_one: int | str) -> None:
    straight = toolbox.disonel(rows(-625, -625), 625, which_one, y_min=10, grid=True)
    (axes,) = straight.axes
    assert axes.lines[0].get_ydata()[0] == 20
    assert axes.get_ylim()[0] == pytest.approx(10, abs=25)
    assert "[cm]" in axes.get_xlabel()
    turn = toolbox.disonel(rows(2042, -2042), 2042, which_one)
    assert "degrees" in turn.axes[0].get_xlabel()
    assert turn.axes[0].lines[0].get_xdata()[-1] == pytest.approx(-360, abs=0.1)


def test_the_latest_graph_goes_to_paper_and_into_a_text() -> None:
    toolbox.ddl(rows(1500, 1500), 1500)
    toolbox.disonel(rows(1500, 1500), 1500, 1)
    assert toolbox.dataprnt() == Path("graph_data.pdf")
    assert Path("graph_data.pdf").read_bytes().startswith(b"%PDF")
    assert toolbox.datameta() == Path("graph_data.svg")
    assert "left 90" in Path("graph_data.svg").read_text()
    toolbox.dataprnt("one.png")
    assert Path("one.png").exists()


@pytest.mark.parametrize(
    ("draw", "message"),
    [
        (lambda: toolbox.ddl(np.ones((3, 9)), 1500), "dv: is 3 x 9; expected rows of 10"),
        (lambda: toolbox.ddl(np.ones((0, 10)), 1500), "dv: is 0 x 10"),
        (lambda: toolbox.ddl(rows(9, 9) + 0.5, 1500), "not all are integers"),
        (lambda: toolbox.ddl(rows(9, 9), 8000), "linear = 64 cm; expected 5 to 60"),
        (lambda: toolbox.ddr(rows(-9, 9), 40), "rotate = .* degrees; expected 15 to 360"),
        (lambda: toolbox.disonel(rows(9, 9), 1500, 9), "which_one = 9: no such sensor"),
        (lambda: toolbox.dataprnt(), "there is no graph yet"),
    ],
)
def test_what_cannot_be_drawn_is_one_line(draw: object, message: str) -> None:
    with pytest.raises(SensorTestError, match=message) as error:
        draw()  # type: ignore[operator]
    assert "\n" not in str(error.value)


def count_pixels(file: Path, colour: str) -> int:
    """Return the number of pixels of a colour in a picture."""
    with Image.open(file) as picture:
        pixels = np.asarray(picture.convert("RGB"))
    rgb = [int(colour[start : start + 2], 16) for start in (1, 3, 5)]
    return int((pixels == rgb).all(axis=2).sum())


def test_khepbase_shows_each_cycle_what_the_robot_senses_and_does() -> None:
    full = [1023] * 8, [500] * 8, [20, 20]
    pictures = {}
    for name, part in (("empty", 0.0), ("half", 0.5), ("full", 1.0)):
        toolbox.khepbase(picture=f"{name}.png")
        prox, light, speed = ([part * value for value in values] for values in full)
        assert toolbox.khepbase(prox, light, speed) == Path(f"{name}.png")
        pictures[name] = [
            count_pixels(Path(f"{name}.png"), getattr(robot_view, colour))
            for colour in ("_PROXIMITY", "_LIGHT", "_SPEED")
        ]
    # The legend contains each colour.
    half_counts, full_counts = (np.subtract(pictures[name], pictures["empty"]) for name in ("half", "full"))
    assert (half_counts > 100).all()
    assert full_counts == pytest.approx(2 * half_counts, rel=0.06)


def test_a_bar_of_speed_points_back_when_the_robot_backs() -> None:
    toolbox.khepbase()
    toolbox.khepbase([0] * 8, [0] * 8, [10, -40])
    left, right = robot_view._open_view[-1]._bars["speed"]
    assert left.get_height() == pytest.approx(robot_view._BAR_HEIGHT / 2)
    assert right.get_height() == pytest.approx(-robot_view._BAR_HEIGHT)


def test_without_a_screen_khepbase_writes_a_picture() -> None:
    assert toolbox.khepbase() == Path("khepbase.png")
    with Image.open("khepbase.png") as picture:
        assert picture.size[0] > 300


def test_khepbase_is_opened_first_and_takes_whole_rows() -> None:
    with pytest.raises(KhepTwinError, match="khepbase: it is not open"):
        toolbox.khepbase([0] * 8, [0] * 8, [0, 0])
    toolbox.khepbase()
    with pytest.raises(ValueError, match="light_data has 7 values; expected 8"):
        toolbox.khepbase([0] * 8, [0] * 7, [0, 0])
    with pytest.raises(ValueError, match="or nothing to open it"):
        toolbox.khepbase([0] * 8)
