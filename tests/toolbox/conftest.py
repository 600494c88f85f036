"""Clean-up after the toolbox's tests, and drawing without a screen."""

from collections.abc import Iterator
from pathlib import Path

import matplotlib
import pytest

from khep_twin import toolbox
from khep_twin.toolbox import figures, roborunner, robot_view, serial_commands


@pytest.fixture(autouse=True)
def clean_up() -> Iterator[None]:
    """Close the playpen and the ports after each test, and clear its graphs, views and runs."""
    yield
    toolbox.close_playpen()
    serial_commands.ports({})
    for latest in (figures._latest_graph, robot_view._open_view, roborunner._runs):
        latest.clear()


@pytest.fixture
def no_screen(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Draw without a screen, in an empty folder."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("MPLBACKEND", "agg")
    matplotlib.use("agg")
