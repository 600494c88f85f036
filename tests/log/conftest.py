"""A twin that drives about, and its log."""

from collections.abc import Callable
from pathlib import Path

import pytest

from khep_twin.ports.twin import Twin, TwinOptions, open_twin

COMMANDS = (b"D,8,5\n", b"N\n", b"O\n")
SECOND = 1_000_000_000


def drive(twin: Twin, seconds: int = 2) -> None:
    """Sends commands, one every tenth of a second."""
    for tenth in range(10 * seconds):
        twin.robot.send(COMMANDS[tenth % len(COMMANDS)])
        twin.advance_to((tenth + 1) * SECOND // 10)


@pytest.fixture
def start() -> Callable[[Path], Twin]:
    """Opens a twin in the obstacles playpen that is logged to a path."""

    def open_logged(path: Path) -> Twin:
        return open_twin("obstacles", TwinOptions(seed=3, log=str(path)))

    return open_logged


@pytest.fixture(scope="session")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A finished log of two seconds, with an event at its end."""
    path = tmp_path_factory.mktemp("log") / "run.mcap"
    with open_twin("obstacles", TwinOptions(seed=3, log=str(path))) as twin:
        drive(twin)
        twin.world.tell(0, "taken away")
    return path
