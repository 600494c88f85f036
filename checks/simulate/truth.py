"""Exchanges on a twin's line, each reply checked against wheels, speeds and sensors."""

import re
from dataclasses import dataclass

from checks.simulate.simulation import Simulation
from khep_twin.board.kernel import AMBIENT, LEFT, PROXIMITY, RIGHT, Mode, Wheel
from khep_twin.board.uart import HostEvent, HostEventKind
from khep_twin.observers import Observer
from khep_twin.ports.twin import Twin
from khep_twin.robots.robot import Robot
from khep_twin.units import PULSES_PER_TURN, wheel_pulses

_MOVES = re.compile(r"[CDP](,-?[0-9]+){2}")
"""Commands that move the robot; one that lost a byte on the line is refused."""

STOP = "D,0,0"
"""Request that stops the motors."""

SESSIONS = 60 * 256
"""Number of sessions that a tag can tell apart."""

REFUSED, BROWSERS = 62, 63
"""Bus addresses in the tags of hosts that may be refused, and of browsers, of whom nothing is carried out."""

_TOLERANCE_PULSES = 4
"""Largest error of a counter at rest [pulses]: two roundings, and the play of a step (assumed)."""


@dataclass(slots=True)
class Exchange:
    """A line that the robot has carried out, and its reply.

    Attributes:
        session: Number of the host, by the tag before it; -1 before the first.
        request: Line, without its ending.
        reply: Reply, with its ending; empty for none.
    """

    session: int
    request: str
    reply: str = ""


def tag(session: int) -> str:
    """Return the request that starts a session: a write to the empty extension bus, which has no effect."""
    return f"W,{session % 256},{session // 256}"


class Truth(Observer):
    """Observer of a twin's world.

    Args:
        simulation: Simulation, which it ends where a reply is wrong.
        twin: Twin with one robot on the line.
        is_exact: Whether the line has no faults.

    Attributes:
        exchanges: All requests that were carried out, with their replies.
        tags: Sessions that have started.
    """

    def __init__(self, simulation: Simulation, twin: Twin, *, is_exact: bool) -> None:
        self._simulation, self._robot, self._world = simulation, twin.robot, twin.world
        self._is_exact = is_exact
        self.exchanges: list[Exchange] = []
        self.tags: set[int] = set()
        self._session = -1
        self._partial_line = b""
        self._leaving = False
        self._origins = [0, 0]
        self._slack = [0.0, 0.0]
        twin.world.add_observer(self)

    # Observer of the world -----------------------------------------------------------------------------

    def on_host_event(self, time_ns: int, robot: int, event: HostEvent) -> None:
        """Note that a host leaves, whose last commands are carried out without replies."""
        if event.kind == HostEventKind.DISCONNECT:
            self._leaving = True
        elif event.kind == HostEventKind.SEND and self._leaving:
            self._leaving, self._partial_line = False, b""

    def on_bytes(self, time_ns: int, robot: int, to_robot: bool, data: bytes) -> None:
        """Take bytes of the line; check a reply."""
        if not to_robot:
            if self.exchanges:
                self.exchanges[-1].reply += data.decode("latin-1")
                if self._is_exact:
                    self._check(self.exchanges[-1])
            return
        *lines, self._partial_line = (self._partial_line + data).replace(b"\r", b"\n").split(b"\n")
        for line in filter(None, lines):
            self._take(line.decode("latin-1").strip())

    # Requests and replies ------------------------------------------------------------------------------

    def _take(self, request: str) -> None:
        letter, *fields = request.split(",")
        if letter == "W" and len(fields) == 2 and all(map(str.isdecimal, fields)):
            value, address = map(int, fields)
            if address == BROWSERS and self._is_exact:
                self._simulation.violate("replies", f"{request!r} of a browser was carried out")
            self._session = address * 256 + value
            self.tags.add(self._session)
        if self._is_exact and letter == "G" and (values := _integers(fields, 2)):
            self._origins = [pulses - value for pulses, value in zip(self._pulses(), values, strict=True)]
            self._slack = [self._speed(wheel) for wheel in range(2)]
        self.exchanges.append(Exchange(self._session, request))

    def _check(self, exchange: Exchange) -> None:
        """Check a reply against the wheels and the board."""
        simulation, registers = self._simulation, self._robot.registers
        letter, *fields = exchange.reply.rstrip("\r\n").split(",")
        if letter == "h" and (values := _integers(fields, 2)):
            simulation.count("counters")
            for wheel, (value, pulses) in enumerate(zip(values, self._pulses(), strict=True)):
                true = pulses - self._origins[wheel]
                tolerance = _TOLERANCE_PULSES + 1.5 * (self._speed(wheel) + self._slack[wheel])
                if abs(_wrapped(value - true)) > tolerance:
                    simulation.violate(
                        "counters", f"{exchange.reply!r}, but wheel {wheel} is at {true} pulses"
                    )
        elif letter == "d" and (values := _integers(exchange.request.split(",")[1:], 2)):
            simulation.count("speeds")
            speeds = [min(max(value, -127), 127) for value in values]
            if not drives(self._robot, speeds):
                simulation.violate(
                    "speeds", f"{exchange.request!r} was answered, but the wheels are not set so"
                )
        elif letter in "no" and len(fields) == 8:
            simulation.count("sensors")
            true = registers[PROXIMITY if letter == "n" else AMBIENT].tolist()
            if _integers(fields, 8) != true:
                simulation.violate("speeds", f"{exchange.reply!r}, but the board has {true}")

    def _pulses(self) -> list[int]:
        angles = self._world.data.qpos[list(self._robot.indices.wheel_qpos)].tolist()
        return [wheel_pulses(angle) for angle in angles]

    def _speed(self, wheel: int) -> float:
        """Return how far a wheel turns in a control period [pulses]."""
        speed = float(self._world.data.qvel[self._robot.indices.wheel_dofs[wheel]])
        return abs(speed) * PULSES_PER_TURN / 6.283 * 0.01

    @property
    def time_s(self) -> float:
        """Time of the twin [s]."""
        return self._world.time_ns / 1e9

    # Questions of hosts --------------------------------------------------------------------------------

    def replies(self, session: int) -> list[Exchange]:
        """Return the answered exchanges of a session, after its tag."""
        return [exchange for exchange in self.exchanges if exchange.session == session and exchange.reply]

    def has_stopped(self, session: int) -> bool:
        """Return whether the motors were stopped after the last command of a session that moves the robot."""
        for exchange in reversed(self.exchanges):
            if exchange.request == STOP:
                return True
            if exchange.session == session and _MOVES.fullmatch(exchange.request):
                return False
        return True


def drives(robot: Robot, speeds: list[int]) -> bool:
    """Return whether the motors of a robot are controlled to speeds [pulses/10 ms]."""
    registers = robot.registers
    modes = [registers[side + Wheel.MODE] for side in (LEFT, RIGHT)]
    setpoints = [registers[side + Wheel.SPEED_SETPOINT] for side in (LEFT, RIGHT)]
    return modes == [Mode.SPEED] * 2 and setpoints == speeds


def _integers(fields: list[str], count: int) -> list[int] | None:
    try:
        values = [int(field) for field in fields]
    except ValueError:
        return None
    return values if len(values) == count else None


def _wrapped(value: int) -> int:
    """Return a difference of counters of 32 bits."""
    return (value + 2**31) % 2**32 - 2**31
