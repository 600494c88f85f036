"""Checks that robots whose commands are letters share, with the robot's numbers as data."""

from collections.abc import Sequence
from dataclasses import dataclass

from khep_twin.lab.conformance.port.check import (
    Catalogue,
    Check,
    CheckedPort,
    Deviation,
    Numbers,
    expect_range,
    replies,
)

_STOPPING = 0.6
"""Time in which the robot stops from any speed of these checks [s]."""

_FORWARD, _SPIN = "drives up to 40 cm forwards and back", "turns on the spot"
_ANYWHERE = "drives for 1 s without commands, around obstacles"


def line_endings(section: str, version: str) -> Check:
    """Return the check of the ends of lines by B, whose reply matches a pattern."""

    def body(line: CheckedPort) -> None:
        for end in ("\n", "\r", "\r\n"):
            line.send("B" + end)
            line.expect_reply("B" + end, version)
            line.expect_silence(f"after the reply to {'B' + end!r}")
        line.send("\n\r\n\r")
        line.expect_silence("after empty lines")

    name = "B reads the version; a command may end in LF, CR or CR LF, and an empty line gets no reply"
    return Check(name, section, "", body)


def single_bytes(section: str, request: str) -> Check:
    """Return the check of a line of single bytes, by a command that is acknowledged."""

    def body(line: CheckedPort) -> None:
        for byte in request + "\n":
            line.send(byte)
            line.sleep(0.002)
        line.expect_reply(request, request[0].lower())

    return Check("bytes sent one at a time make up a line", section, "", body)


def is_server(line: CheckedPort) -> bool:
    """Return whether a server answers, whose replies end in CR LF, those of a firmware in LF CR."""
    line.send("B\n")
    return line.framing.read(line.port, line.time).endswith(b"\r\n")


@dataclass(frozen=True, slots=True)
class LetterChecks:
    """Checks of a robot with the commands A, B, D, E, F, H, I, L, M, R and X."""

    section: str  # of the commands in the manual
    version: str  # pattern of the reply to B
    origin: str  # command that sets the positions to `positions`
    binary: tuple[int, int]  # length of the reply to X, index of the speeds and positions in it
    speed: int  # for D
    duty: int  # for L
    pulse_rate: float  # pulses per second at a speed of 1
    weak_gains: str  # command after which wheels reach less than two thirds of twice the speed
    moves: Sequence[tuple[Sequence[str], str, int, float, float]]
    """Commands before a move, its letter and target, and its least and longest time [s]."""
    near: int  # largest distance from its target of a wheel that has stopped [pulses]
    prefix: str = ""  # of speeds and positions
    positions: tuple[int, int] = (0, 0)
    small_bytes: Sequence[int] = ()  # indices of bytes below 4 in the reply to X
    stops: Sequence[str] = ("M",)  # commands that stop the motors
    vehicles: Sequence[tuple[str, str, str]] = (("A,0", "A,2", "a"),)
    """Commands that start and end the vehicle, and the reply at its end."""

    def catalogue(self, *further: Check) -> Catalogue:
        """Return these checks and further ones, those that move the robot last."""
        section, stop = self.section, self._wheels("D", 0)
        positions = (
            Numbers("R", 2, position - 20, position + 20, slice(side, side + 1))
            for side, position in enumerate(self.positions)
        )
        at_rest = replies(
            "E reads the speeds, 0 at rest, and R the positions that I sets",
            section,
            *(self._wheels("F", 0), self._wheels("L", 0), stop, _STOPPING, self.origin),
            *(Numbers("E", 2, -3, 3), *positions),
            at_rest=True,
        )
        bodies = (
            ("X reads speeds and positions", "", self._binary),
            ("D drives the wheels at the requested speeds, which E reads", _FORWARD, self._speeds),
            ("D and L drive the left and the right wheel in this order", _SPIN, self._wheel_order),
            ("F drives to positions, at the speed that J sets", _FORWARD, self._targets),
            ("H sets the gains, M resets them and stops the motors", _FORWARD, self._gains),
            ("A drives without commands, also after a D, until it is ended", _ANYWHERE, self._vehicle),
        )
        checks = (
            line_endings(section, self.version),
            Check("of commands sent together a server answers the first", "server", "", self._pipelining),
            *(at_rest, *further),
            *(
                Check(name, f"{section}, command {name[0]}", moves, body, at_rest=True)
                for name, moves, body in bodies
            ),
        )
        return Catalogue(tuple(sorted(checks, key=lambda check: bool(check.moves))), counters="R")

    def _wheels(self, letter: str, left: int, ratio: int = 1) -> str:
        """Return a command with a number of the left wheel, and one of the right wheel by their ratio."""
        return f"{letter},{self.prefix}{left},{self.prefix}{ratio * left}"

    def _expect_standing(self, line: CheckedPort, order: str) -> None:
        line.sleep(1.0)
        if max(map(abs, pulses := _pulses(line, 0.3))) > 20:
            line.order("A,2", self._wheels("D", 0))
            raise Deviation(f"after {order} in motion the positions changed by {pulses}; expected a stop")

    def _pipelining(self, line: CheckedPort) -> None:
        requests = "B" if is_server(line) else "BEE"
        line.send("B\nE\nE\n")
        for request in requests:
            line.expect_reply(request, f"{request.lower()},.*")
        line.expect_silence("after the replies to commands sent together")

    def _binary(self, line: CheckedPort) -> None:
        line.order(self._wheels("D", 0), self.origin, pause=_STOPPING)
        line.send("X\n")
        size, first = self.binary
        reply: bytes = line.port.read(size)
        if len(reply) != size or reply[:1] + reply[65:67] != b"x\n\r":
            raise Deviation(f"'X' was answered {reply!r}; expected {size} bytes, x first, LF CR at 65 and 66")
        starts = range(first, first + 16, 4)
        numbers = [int.from_bytes(reply[start : start + 4], "little", signed=True) for start in starts]
        if any(abs(n - m) > 20 for n, m in zip(numbers, (0, 0, *self.positions), strict=True)):
            raise Deviation(f"'X' gave speeds and positions {numbers}; expected 0, 0, {self.positions}")
        expect_range("X", [reply[index] for index in self.small_bytes], 0, 3)

    def _speeds(self, line: CheckedPort) -> None:
        line.order("M")
        for sign in (1, -1):
            line.order(self._wheels("D", sign * self.speed), pause=1.2)
            speeds, pulses = line.numbers("E", 2), _pulses(line, 0.3)
            line.order(self._wheels("D", 0), pause=_STOPPING)
            way = 0.3 * self.pulse_rate * self.speed
            expect_range("E", [sign * n for n in speeds], int(0.9 * self.speed), int(1.1 * self.speed))
            expect_range("R", [sign * n for n in pulses], int(0.8 * way), int(1.3 * way))

    def _wheel_order(self, line: CheckedPort) -> None:
        for letter, size in (("D", self.speed), ("L", self.duty)):
            for left in (size, -size):
                line.order(order := self._wheels(letter, left, -1))
                pulses = _pulses(line, 0.5)
                line.order(self._wheels("D", 0), pause=_STOPPING)
                if min(pulses[0] * left, -pulses[1] * left) <= 0:
                    raise Deviation(f"{order} moved the positions by {pulses}")

    def _targets(self, line: CheckedPort) -> None:
        for orders, letter, target, shortest, longest in self.moves:
            line.order(*orders, order := self._wheels(letter, target))
            start, previous = line.time(), [0, 0]
            while (now := line.numbers("R", 2)) != previous or max(abs(target - n) for n in now) > self.near:
                if line.time() - start > 8:
                    raise Deviation(f"{order} was not on target after 8 s: R gave {now}")
                previous = now
                line.sleep(0.05)
            if not shortest < (time := line.time() - start) < longest:
                raise Deviation(f"{order} took {time:.2f} s; expected {shortest:g} to {longest:g} s")

    def _gains(self, line: CheckedPort) -> None:
        line.order(self.weak_gains, self._wheels("D", 2 * self.speed), pause=0.8)
        speeds = line.numbers("E", 2)
        line.order("M", self._wheels("D", -self.speed), pause=0.8)
        expect_range("E", line.numbers("E", 2), -int(1.2 * self.speed), -int(0.8 * self.speed))
        for order in self.stops:
            line.order(self._wheels("D", -self.speed), pause=0.4)
            line.order(order)
            self._expect_standing(line, order)
        expect_range("E", speeds, 0, 4 * self.speed // 3)

    def _vehicle(self, line: CheckedPort) -> None:
        for start, end, reply in self.vehicles:
            line.order(start, stop := self._wheels("D", 0), pause=0.8)
            speeds = line.numbers("E", 2)
            line.expect(end, reply)
            if not any(speeds):
                raise Deviation(f"after {start} and {stop} E gave {speeds}; expected a robot that drives")
            self._expect_standing(line, end)
        line.order("M")


def _pulses(line: CheckedPort, duration: float) -> list[int]:
    """Return the change of the positions in a duration [s]."""
    starts = line.numbers("R", 2)
    line.sleep(duration)
    return [end - start for start, end in zip(starts, line.numbers("R", 2), strict=True)]
