"""Fixtures and options of several tests."""

import gc
import importlib.util
import os
import signal
import subprocess
import sys
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import hypothesis
import pytest

from khep_twin import playpen
from khep_twin.playpen import Playpen
from khep_twin.process.machine import name_glfw

# What a card would run, numba's simulator of CUDA runs: before anything imports numba.
os.environ["NUMBA_ENABLE_CUDASIM"] = "1"

# The many processes of the suite start faster: pydantic would search all packages for plugins.
name_glfw()
os.environ["PYDANTIC_DISABLE_PLUGINS"] = "__all__"

# Machines are as slow as they are: no example fails for the time that it takes.
hypothesis.settings.register_profile("patient", deadline=None)
hypothesis.settings.load_profile("patient")

FIELD = """
version = 1
name = "field"

[arena]
width_mm = 5000
height_mm = 5000

[[robot]]
x_mm = 1500
y_mm = 2500
heading_deg = 0
"""


@pytest.fixture
def field() -> Playpen:
    """A robot on a wide floor, 1.5 m from the nearest wall, looking along x."""
    return playpen.parse(FIELD, "field")


@pytest.fixture(scope="session", autouse=True)
def private_registry(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Keep the twins that tests serve, and list, apart from those that a person serves meanwhile."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_RUNTIME_DIR", str(tmp_path_factory.mktemp("runtime")))
        yield


@pytest.fixture(scope="session", autouse=True)
def early_compiled_code() -> Iterator[None]:
    """Let worlds change over to compiled code after a second: a worker loads the code once for all tests."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("khep_twin.simulation.stepping_code._MIN_STEPS", 1000)
        yield


def pytest_configure() -> None:
    """Let the programs that tests interrupt take signals, though a shell runs the suite in its background."""
    for number in (signal.SIGINT, signal.SIGHUP, signal.SIGQUIT):
        if signal.getsignal(number) is signal.SIG_IGN:
            signal.signal(number, signal.default_int_handler if number == signal.SIGINT else signal.SIG_DFL)


_PARTS = (
    ("world", "episodes", "world.khepera4"),
    ("plane", "shadow", "vision"),
)
"""Parts of `khep-twin compile` that share inner functions, a process each."""

_COMPILE = "import gc, khep_twin.cli.app; gc.disable(); khep_twin.cli.app.main()"
"""`khep-twin`, a tenth faster as its memory is not searched for garbage."""

_COMPILATIONS = pytest.StashKey["list[subprocess.Popen[bytes]]"]()


def pytest_sessionstart(session: pytest.Session) -> None:
    """Compile the stepping core once, before all workers do so at the same time, while they collect."""
    config = session.config
    if (
        config.getoption("numprocesses", None)  # not in a worker, nor without any
        and any(Path(argument).is_dir() for argument in config.args)
        and importlib.util.find_spec("numba") is not None
    ):
        config.stash[_COMPILATIONS] = [
            subprocess.Popen([sys.executable, "-c", _COMPILE, "compile", *parts]) for parts in _PARTS
        ]


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_node_collection_finished(node: Any) -> None:
    """Wait for that before tests are handed out."""
    for process in node.config.stash.get(_COMPILATIONS, []):
        process.wait()


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark the cases of a test long, except for every nth, the argument of its marker `share`."""
    n_cases = Counter[str]()
    for item in items:
        if share := item.get_closest_marker("share"):
            name = item.nodeid.partition("[")[0]
            if n_cases[name] % share.args[0]:
                item.add_marker(pytest.mark.long)
            n_cases[name] += 1


def pytest_collection_finish() -> None:
    """Keep modules and tests, which stay, out of the garbage collection: a tenth of the suite's time."""
    gc.collect()
    gc.freeze()
    gc.set_threshold(10_000, 20, 20)


def pytest_addoption(parser: pytest.Parser) -> None:
    """`pytest tests/conformance --port URL` checks a robot or a served twin instead of its own twins."""
    parser.addoption("--port", help="port of a robot or twin to check; its robot moves about 10 cm")
    parser.addoption("--baudrate", type=int, default=9600, help="speed of that port's line")


def pytest_xdist_auto_num_workers() -> int:
    """For `-n auto`, one more than there are cores: many tests wait for a line or a clock."""
    return len(os.sched_getaffinity(0)) + 1
