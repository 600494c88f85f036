"""A twin whose run is logged, and a finished log."""

from collections.abc import Callable
from pathlib import Path

import pytest
from driving import drive

from khep_twin.ports.twin import Twin, TwinOptions, open_twin


@pytest.fixture
def start() -> Callable[[Path], Twin]:
    """Opens a twin in the obstacles playpen that is logged to a path."""
    return lambda path: open_twin("obstacles", TwinOptions(seed=3, log=str(path)))


@pytest.fixture(scope="session")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A finished log of two seconds, with an event at its end."""
    path = tmp_path_factory.mktemp("log") / "run.mcap"
    with open_twin("obstacles", TwinOptions(seed=3, log=str(path))) as twin:
        drive(twin)
        twin.world.log_event(0, "taken away")
    return path
