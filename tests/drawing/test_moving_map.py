"""Maps over time: robots and movable objects are drawn at their poses, static parts only once."""

import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from test_map import SCENE

from khep_twin.drawing.moving_map import MovingMap

ROBOTS = [(0.1, 0.1, 0.0), (0.5, 0.1, 3.0)]


def changed(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Return the centre of the pixels that differ, in parts of height and width."""
    rows, columns = np.nonzero((one != other).any(axis=2))
    return np.array([rows.mean() / one.shape[0], columns.mean() / one.shape[1]])


def test_what_moves_is_drawn_where_it_is_and_leaves_no_trace(monkeypatch: pytest.MonkeyPatch) -> None:
    film = MovingMap(SCENE)
    monkeypatch.setattr(FigureCanvasAgg, "draw", None)  # of the whole map
    first = film.picture(ROBOTS, [(0.3, 0.2, 0.0)])
    pushed = film.picture(ROBOTS, [(0.3, 0.1, 0.0)])
    driven = film.picture([(0.2, 0.25, 1.0), ROBOTS[1]], [(0.3, 0.2, 0.0)])
    # Along x the object lies in the middle of the arena, and the robot at a sixth and then a third of it.
    assert changed(first, pushed)[1] == pytest.approx(0.5, abs=0.05)
    assert changed(first, driven)[1] < 0.4
    assert (film.picture(ROBOTS, [(0.3, 0.2, 0.0)]) == first).all()
    assert [size % 2 for size in first.shape] == [0, 0, 1]


def test_a_robot_that_turns_looks_another_way_at_its_place() -> None:
    film = MovingMap(SCENE)
    one, other = (film.picture([(0.1, 0.1, turn), ROBOTS[1]], [(0.3, 0.2, 0.0)]) for turn in (0.0, np.pi))
    assert changed(one, other)[1] < 0.4
    assert (one != other).any(axis=2).sum() < 0.01 * one.shape[0] * one.shape[1]
