"""Figures of sensor tests: their layout, and that they are reproducible."""

from pathlib import Path

import matplotlib as mpl
import numpy as np
import pytest
from matplotlib.collections import PolyCollection

from khep_twin.drawing.map import save
from khep_twin.errors import SensorTestError
from khep_twin.lab.sensor_test.sensor_figure import AMBIENT_LIMIT, check, draw, mean_and_spread, positions
from khep_twin.lab.sensor_test.sensor_test import QuantityName, SensorRun, SensorTest
from khep_twin.robots.khepera4.model import KHEPERA_4
from khep_twin.units import SENSOR_LABELS

LINEAR = SensorTest(linear_cm=10)
TURN = SensorTest(rotate_deg=360)
LIGHT = SensorTest("light", rotate_deg=-90)


def run(test: SensorTest = LINEAR, counts: int = 100, n: int = 11, part: float = 1.0) -> SensorRun:
    """A run whose sensors rise linearly to a level, over a part of the path."""
    way = np.linspace(0, part, n)
    dv = np.empty((n, 10), np.int64)
    dv[:, :2] = np.round(np.outer(way, test.target))
    dv[:, 2:] = np.round(np.outer(way * counts, np.ones(8)))
    return SensorRun(test, dv, np.arange(n) / 10, "in $ and $")


def test_eight_axes_lie_like_the_sensors_on_a_robot_that_looks_up() -> None:
    figure = draw([run()])
    places_of = {axes.get_title(): axes.get_position() for axes in figure.axes if axes.get_title()}
    assert list(places_of) == list(SENSOR_LABELS)
    for side in ("90", "45", "10"):
        assert places_of[f"left {side}"].x1 < places_of[f"right {side}"].x0
    assert places_of["back left"].x1 < places_of["back right"].x0
    assert places_of["left 90"].y1 < places_of["left 45"].y0
    assert places_of["back left"].y1 < places_of["left 90"].y0


@pytest.mark.parametrize("quantity", ["proximity", "light"])
def test_a_khepera4_has_axes_for_its_own_sensors_up_to_their_limit(quantity: QuantityName) -> None:
    test = SensorTest(quantity, linear_cm=10, model="khepera4")
    dv = np.full((11, 14), 980)
    figure = draw([SensorRun(test, dv, np.arange(11) / 10)])
    assert tuple(axes.get_title() for axes in figure.axes) == KHEPERA_4.body.sensors
    assert figure.axes[0].get_ylim()[1] > 980


@pytest.mark.parametrize(("model", "n_sensors"), [("khepera3", 11), ("khepera4", 12)])
def test_description_and_legend_of_another_robot_share_the_free_cell(model: str, n_sensors: int) -> None:
    dv = np.full((11, 2 + n_sensors), 500)
    dv[:, :2] = np.arange(11)[:, None]
    test = SensorTest(linear_cm=10, model=model)
    figure = draw([SensorRun(test, dv + level, np.arange(11) / 10, "a\nb") for level in (0, 1)])
    ((description,), (legend,)) = figure.texts, figure.legends
    boxes = [artist.get_window_extent() for artist in (description, legend)]
    assert boxes[0].y1 < boxes[1].y0
    assert all(not axes.get_window_extent().overlaps(box) for axes in figure.axes for box in boxes)


def test_a_path_counts_down_to_0_at_the_right_and_a_turn_up() -> None:
    way = draw([run()], sensor="left 10").axes[0]
    low, high = way.get_xlim()
    assert low > 10 > 0 > high
    assert "[cm]" in way.get_xlabel()
    turn = draw([run(TURN)], sensor="left 10").axes[0]
    low, high = turn.get_xlim()
    assert low < 0 < 360 < high
    assert "[degrees]" in turn.get_xlabel()


@pytest.mark.parametrize("linear_cm", [10, -10])
def test_the_end_of_the_path_is_0_in_either_direction(linear_cm: float) -> None:
    np.testing.assert_allclose(positions(run(SensorTest(linear_cm=linear_cm)))[[0, -1]], [10, 0], atol=1e-9)


def test_proximity_goes_to_1023_and_light_to_about_525() -> None:
    proximity, light = draw([run()], sensor="left 10").axes[0], draw([run(LIGHT)], sensor="left 10").axes[0]
    assert proximity.get_ylim()[1] == pytest.approx(1023, rel=0.03)
    assert light.get_ylim()[1] == pytest.approx(AMBIENT_LIMIT, rel=0.03)
    assert (proximity.get_ylabel(), light.get_ylabel()) == ("proximity [counts]", "ambient [counts]")


def test_one_sensor_is_drawn_from_y_min_on_with_a_grid() -> None:
    figure = draw([run(counts=900)], sensor="right 45", y_min=200, grid=True)
    (axes,) = figure.axes
    assert axes.get_title(loc="left").startswith("right 45")
    assert 180 < axes.get_ylim()[0] <= 200
    assert all(line.get_visible() for line in axes.get_xgridlines())
    assert not any(line.get_visible() for line in draw([run()], sensor="right 45").axes[0].get_xgridlines())
    x, y = axes.lines[0].get_data()
    np.testing.assert_allclose(np.asarray(x), np.linspace(10, 0, 11), atol=0.01)
    np.testing.assert_allclose(np.asarray(y), np.linspace(0, 900, 11), atol=0.5)


def test_one_run_has_points_and_several_have_mean_band_and_legend() -> None:
    single = draw([run()], sensor="left 10").axes[0]
    assert len(single.lines) == 1
    assert single.lines[0].get_marker() == "o"
    assert single.get_legend() is None
    several = draw([run(counts=level) for level in (100, 200, 300)], sensor="left 10").axes[0]
    assert len(several.lines) == 4
    assert any(isinstance(artist, PolyCollection) for artist in several.collections)
    legend = several.get_legend()
    assert legend is not None
    assert [text.get_text() for text in legend.get_texts()] == ["3 runs", "± 1 standard deviation", "mean"]


def test_mean_and_spread_are_those_of_the_runs_where_all_have_been() -> None:
    runs = [run(counts=100), run(counts=200, n=21), run(counts=300, part=0.5)]
    x, mean, spread = mean_and_spread(runs)
    assert x[0] == pytest.approx(5, abs=0.01)
    assert x[-1] == pytest.approx(10, abs=0.01)
    # Halfway each run has half of its level.
    assert mean[0] == pytest.approx(np.mean([50, 100, 150]), abs=1)
    assert spread[0] == pytest.approx(np.std([50, 100, 150], ddof=1), abs=1)


@pytest.mark.parametrize(
    ("runs", "options", "line"),
    [
        ([run(LIGHT), run(TURN)], {}, "runs of light, rotational and of proximity, rotational; expected"),
        ([run(LINEAR), run(TURN)], {}, "runs of proximity, linear and of proximity, rotational; expected"),
        ([], {}, "runs of no kind"),
        ([run()], {"sensor": "left 9"}, "sensor = left 9: no such sensor; did you mean 'left 90'"),
        ([run()], {"y_min": 1023}, "y-min = 1023; expected 0 to 1022 for proximity"),
        ([run(LIGHT)], {"y_min": -1}, "y-min = -1; expected 0 to 524 for light"),
        ([run(TURN), run(SensorTest(rotate_deg=-90))], {}, "the runs have no part of the path in common"),
        ([run(n=0)], {}, "a run without rows"),
    ],
)
def test_what_cannot_be_drawn_is_reported_in_one_line(
    runs: list[SensorRun], options: dict[str, str | int], line: str
) -> None:
    with pytest.raises(SensorTestError, match=line):
        check(runs, **options)  # pyright: ignore[reportArgumentType]


@pytest.mark.share(3)
@pytest.mark.parametrize("suffix", ["png", "svg", "pdf"])
def test_the_same_runs_give_the_same_bytes_whatever_matplotlib_is_set_to(suffix: str, tmp_path: Path) -> None:
    runs = [run(), run(counts=200)]
    save(draw(runs), tmp_path / f"a.{suffix}")
    with mpl.rc_context({"lines.linewidth": 9, "font.size": 20, "svg.hashsalt": "x", "savefig.dpi": 30}):
        save(draw(runs), tmp_path / f"b.{suffix}")
    assert (tmp_path / f"a.{suffix}").read_bytes() == (tmp_path / f"b.{suffix}").read_bytes()


@pytest.mark.parametrize("test", [SensorTest("vision", linear_cm=10), SensorTest("vision", rotate_deg=-90)])
def test_line_images_are_strips_over_the_path_with_the_left_pixel_at_the_top(test: SensorTest) -> None:
    part = np.array([0.0, 0.6, 1.0])
    dv = np.zeros((3, 66), np.int64)
    dv[:, :2] = np.round(np.outer(part, test.target))
    dv[:, 2:] = np.arange(64) + np.array([[0], [100], [150]])
    run = SensorRun(test, dv, np.arange(3) / 10)
    figure = draw([run, run])
    assert len(figure.axes) == 2
    axes = figure.axes[0]
    [strip] = axes.images
    pixels = np.asarray(strip.get_array())
    left, right, bottom, top = strip.get_extent()
    assert (top, bottom) == (-0.5, 63.5)
    # The strip is drawn at its x values, in either direction of the axis.
    assert (left, right) == pytest.approx((positions(run).min(), positions(run).max()))
    columns = pixels.shape[1]
    for reading, x in zip(dv[:, 2:], positions(run), strict=True):
        column = round((x - left) / (right - left) * (columns - 1))
        assert np.array_equal(pixels[:, column], reading)
    assert axes.xaxis_inverted() == (test.motion == "linear")
