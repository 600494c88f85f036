"""The conformance checks on khep:// and a pty at three speeds, or on the port given by --port."""

import subprocess
import sys
from collections.abc import Iterator

import pytest
from lateness import lateness

from khep_twin.host import Khepera
from khep_twin.lab.conformance.port.check import Check, CheckedPort
from khep_twin.lab.conformance.port.conform import checks, run_check

MOST_LATE = 0.003
"""Lateness of the machine that the checks of pace bear [s]."""

TWINS = [f"{kind}-{baudrate}" for kind in ("khep", "pty") for baudrate in (9600, 19200, 38400)]


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    given = metafunc.config.getoption("--port")
    metafunc.parametrize("line", [given] if given else TWINS, indirect=True, scope="module")
    metafunc.parametrize("check", list(checks(True)), ids=lambda check: check.name)


@pytest.fixture(scope="module")
def line(request: pytest.FixtureRequest) -> Iterator[CheckedPort]:
    """An open line to what is checked."""
    if request.param not in TWINS:
        with Khepera(request.param, baudrate=request.config.getoption("--baudrate")) as robot:
            yield CheckedPort(robot.port)
        return
    kind, baudrate = request.param.split("-")
    mode = {"9600": "1", "19200": "2", "38400": "3"}[baudrate]
    if kind == "khep":
        with Khepera(f"khep://default?mode={mode}", baudrate=int(baudrate)) as robot:
            yield CheckedPort(robot.port)
        return
    command = [sys.executable, "-m", "khep_twin", "serve", "default", "--mode", mode]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True) as process:
        try:
            assert process.stdout is not None
            with Khepera(process.stdout.readline().strip(), baudrate=int(baudrate)) as robot:
                yield CheckedPort(robot.port)
        finally:
            process.terminate()


def test_the_port_conforms(line: CheckedPort, check: Check) -> None:
    if hasattr(line.port, "time_ns"):  # simulated time
        assert run_check(check, line).deviation == ""
        return
    # In real time a busy machine delays replies, which is no deviation of the port's.
    for _ in range(5):
        with lateness() as late:
            deviation = run_check(check, line).deviation
        if not deviation or late.worst < MOST_LATE:
            break
    if deviation:
        late.excuse(MOST_LATE)
    assert deviation == ""
