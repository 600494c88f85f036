"""Conformance of a robot or twin at a port to the serial protocol of its model.

Twins and robots have the same checks. Each names the section of the manual that it tests, or another source
that its family of robots has. Checks that move the robot are optional.
"""

import json
from collections.abc import Iterator
from contextlib import closing, suppress
from dataclasses import asdict, dataclass
from functools import partial

from khep_twin.errors import PORT_FAILURES, PortError, PortTimeout, ProtocolError
from khep_twin.host.host_robot import HostRobot, open_robot
from khep_twin.lab.conformance.port.check import (
    Catalogue,
    Check,
    CheckedPort,
    Deviation,
    NotPossibleError,
    is_driving,
)
from khep_twin.ports.twin import Twin
from khep_twin.robots.model_checks import check_identity
from khep_twin.robots.registry import DEFAULT, find_family


@dataclass(frozen=True, slots=True)
class Result:
    """Result of a check; its attributes are keys of the JSON report.

    Attributes:
        name: Tested statement.
        section: Section of the manual.
        deviation: Deviation from it; empty if the check passed or was not possible.
        absent: Whether it checks a turret that is not installed.
        impossible: Reason why the check was not possible with this robot or here; empty if it was.
    """

    name: str
    section: str
    deviation: str
    absent: bool = False
    impossible: str = ""


@dataclass(frozen=True, slots=True)
class ConformanceReport:
    """Results of all checks.

    Attributes:
        port: URL of the port.
        results: Results in the order of the checks.
        skipped: Names of the checks that were not run as they move the robot.
    """

    port: str
    results: tuple[Result, ...]
    skipped: tuple[str, ...]

    @property
    def passed(self) -> bool:
        """True if every check passed."""
        return not any(result.deviation for result in self.results)

    def text(self) -> str:
        """Return the report as readable text."""
        failed = [result for result in self.results if result.deviation]
        absent = [result for result in self.results if result.absent]
        impossible = [result for result in self.results if result.impossible]
        lines = [
            f"{'FAIL' if result.deviation else 'none' if result.absent or result.impossible else 'ok  '}  "
            f"{result.name} [{result.section}]"
            for result in self.results
        ]
        lines += [f"skip  {name} (moves the robot; enable with --move)" for name in self.skipped]
        reasons = {result.impossible: result.name for result in impossible[::-1]}
        lines += [f"\n{name}\n    {reason}" for reason, name in reasons.items()]
        lines += [f"\n{result.name}\n    {result.deviation}" for result in failed]
        n_passed = len(self.results) - len(failed) - len(absent) - len(impossible)
        suffix = f", {len(impossible)} not possible here" if impossible else ""
        suffix += f", {len(absent)} of turrets that are absent" if absent else ""
        lines.append(f"\n{self.port}: {n_passed} passed, {len(failed)} failed{suffix}")
        return "\n".join(lines)

    def json(self) -> str:
        """Return the report as JSON."""
        return json.dumps({"passed": self.passed, **asdict(self)}, indent=2)


def conform(
    url: str, *, move: bool = False, baudrate: int | None = None, model: str = DEFAULT
) -> ConformanceReport:
    """Check the robot or twin at a port.

    Args:
        url: URL of the port.
        move: Also run the checks that move the robot.
        baudrate: Baud rate; by default the usual one of its model.
        model: Name of the robot's model, or of its family.

    Raises:
        PortError: The port cannot be opened, its robot is of another model, or time passes there at a speed
            other than 1.
        RobotModelError: The model is unknown or has no checks, or its host class or identity is wrong.
    """
    if baudrate is not None and baudrate < 1:
        raise PortError(key="baudrate", value=baudrate, expected="the speed of the line, such as 9600")
    robot_model = find_family(model)
    # A broken robot may not even acknowledge the last stop, which must not prevent the report.
    with closing(open_robot(robot_model, url, baudrate=baudrate or robot_model.dialect.baud)) as robot:
        robot.check_clock("checks")
        if robot.clock_speed != 1:
            raise PortError(
                f"{url}: checks at a server with --speed {robot.clock_speed:g}; expected --speed 1"
            )
        robot.check_model()
        check_identity(robot_model, type(robot), _twin_identity(robot))
        return examine(CheckedPort(robot.port, robot_model.dialect.framing), url, move=move, model=model)


def _twin_identity(robot: HostRobot) -> str | None:
    """Return the reply of a twin in this process to the first probe; None without one, or with faults."""
    twin: Twin | None = getattr(robot.port, "twin", None)
    with suppress(PortTimeout, ProtocolError):
        if twin is not None and not twin.options.faults:
            return robot.ask(robot.dialect.probes[0])
    return None


def examine(line: CheckedPort, name: str, *, move: bool = False, model: str = DEFAULT) -> ConformanceReport:
    """Run the checks on an open line."""
    body = partial(_expect_waiting, counters=_catalogue_of(model).counters)
    reason = run_check(Check("the robot waits for commands", "", "", body), line).impossible
    results = tuple(
        Result(check.name, check.section, "", impossible=reason)
        if reason and check.at_rest
        else run_check(check, line)
        for check in checks(move, model)
    )
    skipped = () if move else tuple(check.name for check in checks(True, model) if check.moves)
    return ConformanceReport(name, results, skipped)


def checks(move: bool, model: str = DEFAULT) -> Iterator[Check]:
    """Return the checks, with or without those that move the robot."""
    return (check for check in _catalogue_of(model).checks if move or not check.moves)


def _catalogue_of(model: str) -> Catalogue:
    """Return the checks of a model or family."""
    return find_family(model).load("conformance", Catalogue)


def run_check(check: Check, line: CheckedPort) -> Result:
    """Run one check on a silent line and leave the line silent."""
    deviation, absent, impossible = "", False, ""
    try:
        line.port.reset_input_buffer()
        try:
            absent = check.turret is not None and line.ask(f"T,{check.turret},B").startswith("z,")
            if not absent:
                check.body(line)
            line.expect_silence("after the last reply")
        except NotPossibleError as error:
            impossible = str(error)
        except Deviation as error:
            deviation = str(error)
            # The rest of a wrong reply must not reach the next check.
            line.send(line.framing.resync)
            line.read_for(0.3)
    except PORT_FAILURES as error:
        deviation = f"the port failed: {error}"
    return Result(check.name, check.section, deviation, absent, impossible)


def _expect_waiting(line: CheckedPort, counters: str) -> None:
    if counters and is_driving(line, counters):
        raise NotPossibleError(
            "the robot drives without commands, as in its demonstration (mode 0); needs one that waits"
        )
