"""The conformance checks on khep:// and a pty at three speeds, or on the port given by --port."""

from collections.abc import Iterator

import pytest
from scheduling_delay import scheduling_delay
from served_twin import served

from khep_twin.host import Khepera
from khep_twin.lab.conformance.port.check import Check, CheckedPort
from khep_twin.lab.conformance.port.conform import checks, run_check

MAX_DELAY = 0.003
"""Largest scheduling delay that the checks of timing tolerate [s]."""

TWINS = [f"{kind}-{baudrate}" for kind in ("khep", "pty") for baudrate in (9600, 19200, 38400)]
SHARE = {"khep-9600": lambda check: True, "pty-38400": lambda check: not check.moves}
"""Checks in the test suite: all in simulated time, those without motion in real time."""


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    port = metafunc.config.getoption("--port")
    cases = [
        pytest.param(
            line,
            check,
            id=f"{line}-{check.name}",
            marks=() if port or SHARE.get(line, lambda check: False)(check) else pytest.mark.long,
        )
        for line in ([port] if port else TWINS)
        for check in checks(True)
    ]
    metafunc.parametrize(("line", "check"), cases, indirect=["line"], scope="module")


@pytest.fixture(scope="module")
def line(request: pytest.FixtureRequest) -> Iterator[CheckedPort]:
    """An open line to the checked robot."""
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
    with served("default", "--mode", mode) as (_, port), Khepera(port, baudrate=int(baudrate)) as robot:
        yield CheckedPort(robot.port)


def test_the_port_conforms(line: CheckedPort, check: Check) -> None:
    if hasattr(line.port, "time_ns"):  # simulated time
        assert run_check(check, line).deviation == ""
        return
    # In real time a busy machine delays replies, which is not a deviation.
    for _ in range(5):
        with scheduling_delay() as delay:
            deviation = run_check(check, line).deviation
        if not deviation or delay.worst < MAX_DELAY:
            break
    if deviation:
        delay.excuse(MAX_DELAY)
    assert deviation == ""
