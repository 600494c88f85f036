"""pytest's plugin of the check mutants: a time limit of each test, and the tests that reach each line.

With `--record FOLDER` it writes lines by test as data of coverage, one file per process, and the outcomes as
`outcomes.json`. Lines of a fixture that several tests share count for all tests of the file.
"""

import json
import os
import signal
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import coverage
import pytest

TEST_LIMIT_S = 20.0
"""Longest time of one test [s]; a test that takes longer fails."""


class SlowTestError(BaseException):
    """A test takes longer than its limit; no `except` of the product catches it."""


def pytest_addoption(parser: pytest.Parser) -> None:
    """Add the folder of the recording."""
    parser.addoption("--record", help="folder for lines by test")


def pytest_configure(config: pytest.Config) -> None:
    """Start the recording."""
    if folder := config.getoption("--record"):
        config.pluginmanager.register(Recording(config, Path(folder)))


@pytest.hookimpl(wrapper=True)
def pytest_runtest_protocol() -> Iterator[Any]:
    """Fail a test at its limit."""

    def fail(*_: object) -> None:
        raise SlowTestError(f"more than {TEST_LIMIT_S:g} s")

    signal.signal(signal.SIGALRM, fail)
    signal.setitimer(signal.ITIMER_REAL, TEST_LIMIT_S)
    try:
        return (yield)
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)


class Recording:
    """Lines of the product that each test reaches."""

    def __init__(self, config: pytest.Config, folder: Path) -> None:
        self._folder, self._is_worker = folder, hasattr(config, "workerinput")
        self._is_controller = bool(config.getoption("numprocesses", None))
        self._outcomes: dict[str, tuple[str, float]] = {}
        self._context = ""
        self._coverage = coverage.Coverage(
            str(folder / f"lines.{os.getpid()}"), source=["khep_twin"], config_file=False
        )
        self._coverage.set_option("run:relative_files", True)
        self._coverage.set_option("run:disable_warnings", ["no-data-collected", "module-not-measured"])
        if not self._is_controller:
            self._coverage.start()
        self._trace = sys.gettrace()

    @pytest.hookimpl(wrapper=True, tryfirst=True)
    def pytest_runtest_protocol(self, item: pytest.Item) -> Iterator[Any]:
        """Count lines for the test."""
        if sys.gettrace() is not self._trace:  # a test that traces has ended the recording
            self._coverage.stop()
            self._coverage.start()
            self._trace = sys.gettrace()
        self._context = item.nodeid
        self._coverage.switch_context(self._context)
        return (yield)

    @pytest.hookimpl(wrapper=True)
    def pytest_fixture_setup(self, fixturedef: pytest.FixtureDef[Any]) -> Iterator[Any]:
        """Count lines of a shared fixture for the file."""
        if fixturedef.scope == "function":
            return (yield)
        self._coverage.switch_context(self._context.partition("::")[0])
        try:
            return (yield)
        finally:
            self._coverage.switch_context(self._context)

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        """Keep the worst outcome of a test, and its time."""
        outcome, duration = self._outcomes.get(report.nodeid, ("passed", 0.0))
        worst = report.outcome if outcome == "passed" else outcome
        self._outcomes[report.nodeid] = worst, duration + report.duration

    def pytest_unconfigure(self) -> None:
        """Write the recording."""
        if not self._is_controller:
            self._coverage.stop()
            self._coverage.save()
        if not self._is_worker:
            (self._folder / "outcomes.json").write_text(json.dumps(self._outcomes))
