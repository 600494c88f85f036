"""The board's own code beside a recorded robot: what it answers to the commands that the robot was given.

It is a `Firmware` without wheels and sensors, which knows letters, errors, modes and settings. Commands that
the robot has refused are undone in it, and where it is not known whether one has arrived, the settings of the
motors are unknown until they are set again.
"""

from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

from khep_twin.board import kernel
from khep_twin.board.kernel import LEFT, RESET_VALUES, RIGHT, Board, Mode, Wheel
from khep_twin.board.protocol import COMMAND_NOT_FOUND, MOVING, Request, Tool
from khep_twin.board.rom import Rom
from khep_twin.board.turrets import Turret, TurretKind, installed
from khep_twin.clock import NS_PER_S
from khep_twin.firmware import Firmware, parse
from khep_twin.log.exchanges import BANNER, Exchange
from khep_twin.units import BITS_PER_BYTE

_GAINS = {register: value for register, value in RESET_VALUES if Board.SPEED_KP <= register <= Board.SPEED_KD}


class MotorSettings(NamedTuple):
    """Settings of the motors by the commands so far, left and right.

    Attributes:
        modes: Control modes.
        speeds: Speeds of D [pulses/10 ms].
        targets: Targets of C [pulses]; None where G has renumbered them since.
        on_target: Target flags as the last command has left them.
        profile: Lowest speed [pulses/10 ms] and acceleration [pulses/256 per (10 ms)^2] of J.
        usual_gains: True if the speed controllers have the gains of a reset.
    """

    modes: tuple[Mode, Mode]
    speeds: tuple[int, int]
    targets: tuple[int, int] | None
    on_target: tuple[int, int]
    profile: tuple[int, int]
    usual_gains: bool


@dataclass(frozen=True, slots=True)
class RecordedStep:
    """One exchange and the board's own.

    Attributes:
        exchange: Recorded exchange.
        arrived_ns: Earliest time at which the robot can have had the command [ns].
        byte_ns: Time of a byte of the reply on the line [ns]; 0 if it is unknown or none.
        request: Command as parsed; None for a line that came unasked.
        expected: Reply of the board's own code.
        motion: Settings of the motors after the command; None where they are unknown.
        exact: True if the robot had the command at its arrival, as a twin's transcript says.
    """

    exchange: Exchange
    arrived_ns: int
    byte_ns: int
    request: Request | None
    expected: bytes
    motion: MotorSettings | None
    exact: bool

    @property
    def read_ns(self) -> int:
        """Latest time at which the values of the reply were read [ns]."""
        if self.exact:
            return self.arrived_ns
        length = len(self.exchange.reply or b"") + 2
        return max(self.exchange.heard_ns - length * self.byte_ns, self.arrived_ns)

    @property
    def restarts(self) -> bool:
        """True if the robot shows its banner, asked or not."""
        return BANNER in (self.exchange.reply or b"")


class KnownRobot(NamedTuple):
    """Robot as a log's label describes it.

    Attributes:
        rom: Name of its ROM; empty if unknown.
        mode: Running mode; None if unknown.
        turrets: Turrets; None if unknown.
    """

    rom: str = ""
    mode: int | None = None
    turrets: tuple[TurretKind, ...] | None = None


class TimedExchange(NamedTuple):
    """An exchange with the command's earliest arrival [ns] and the line's speed [baud], 0 if unknown."""

    exchange: Exchange
    arrived_ns: int
    baud: int


def versions(rom: Rom) -> bytes:
    """Return a ROM's reply to B without its line end."""
    return f"b,{rom.bios},{rom.protocol}".encode()


def wrong_modes(steps: Sequence[RecordedStep], rom: Rom) -> int:
    """Return the number of replies to K with other modes than those of a ROM."""
    wrong = 0
    for step in steps:
        if step.exchange.letter == "K" and step.motion is not None and len(step.exchange.values or ()) == 6:
            wrong += (step.exchange.values or ())[1::3] != tuple(
                rom.mode_codes[mode] for mode in step.motion.modes
            )
    return wrong


class BoardModel:
    """The board's own code, to which the recorded commands are told.

    Args:
        rom: Version of the firmware.
        known: What is known of the robot.
        timed: Exchanges, from which unknown turrets are guessed.
    """

    def __init__(self, rom: Rom, known: KnownRobot, timed: Sequence[TimedExchange]) -> None:
        kinds = _answering(timed) if known.turrets is None else known.turrets
        self._turrets: dict[TurretKind, Turret] = {kind: kind.make() for kind in kinds}
        self._firmware = Firmware(rom, 1 if known.mode is None else known.mode, self._turrets)
        # A robot that a relay finds has been on for long.
        self._sure = known.mode is not None
        self._gains_known = True
        self._targets: tuple[int, int] | None = None

    def steps(
        self, timed: Sequence[TimedExchange], resets_ns: Sequence[int], simulated: bool, unpaced: bool
    ) -> Iterator[RecordedStep]:
        """Yield the steps.

        Args:
            timed: Exchanges in order of their commands.
            resets_ns: Times at which a user reset the board [ns].
            simulated: True for a twin, whose line has the board's speed.
            unpaced: True for a line that takes no time.
        """
        resets = deque(resets_ns)
        for exchange, arrived_ns, line_baud in timed:
            while resets and resets[0] <= exchange.sent_ns:
                resets.popleft()
                kernel.reset(self._firmware.register_view)
                self._sure = self._gains_known = True
            expected = self._answer(exchange) if exchange.command else self._notice(exchange)
            speed = self._firmware.reply_baud if simulated and not unpaced else line_baud
            byte_ns = BITS_PER_BYTE * NS_PER_S // speed if speed else 0
            request = parse(exchange.command) if exchange.command else None
            yield RecordedStep(exchange, arrived_ns, byte_ns, request, expected, self._motion(), simulated)

    def _notice(self, unasked: Exchange) -> bytes:
        if BANNER in (unasked.reply or b""):
            self._firmware.reset()
            self._sure = self._gains_known = True
        return b""

    def _answer(self, exchange: Exchange) -> bytes:
        """Carry out a command as far as the robot has; return the board's own reply."""
        firmware, reply = self._firmware, exchange.reply
        before, settings = firmware.registers.copy(), (firmware.baud, firmware.running)
        for turret in self._turrets.values():
            # What one does takes time, which does not pass here: each order finds it at rest.
            turret.reset()
        expected = firmware.receive(exchange.command + b"\n")
        if expected.startswith((b"z,", COMMAND_NOT_FOUND)):
            return expected
        if reply is not None and is_error(reply):
            # The robot has not carried it out.
            firmware.registers[:] = before
            firmware.baud, firmware.running = settings
            return expected
        answered, restarted = reply is not None, BANNER in (reply or b"")
        if isinstance(parse(exchange.command), Tool):
            self._sure = restarted or (self._sure and answered)
            self._gains_known = restarted or self._gains_known
        elif exchange.letter == "A":
            self._gains_known = answered
        elif exchange.letter == "J":
            self._sure = self._sure and answered
        elif exchange.letter in MOVING:
            self._sure = answered
        if exchange.letter in ("C", "G"):
            targets = both(firmware.register_view, Wheel.TARGET)
            self._targets = targets if exchange.letter == "C" else None
        return expected

    def _motion(self) -> MotorSettings | None:
        view = self._firmware.register_view
        if not self._sure or self._firmware.running:
            return None
        left, right = both(view, Wheel.MODE)
        return MotorSettings(
            (Mode(left), Mode(right)),
            both(view, Wheel.SPEED_SETPOINT),
            self._targets,
            both(view, Wheel.ON_TARGET),
            (min(both(view, Wheel.MAX_SPEED)), min(both(view, Wheel.ACCELERATION))),
            self._gains_known and all(view[register] == value for register, value in _GAINS.items()),
        )


def _answering(timed: Sequence[TimedExchange]) -> tuple[TurretKind, ...]:
    """Return the installed turrets under whose numbers there are answers."""
    numbers = {kind.number: kind for kind in reversed(tuple(installed().values()))}
    replies = [each.exchange.reply or b"" for each in timed]
    return tuple(
        numbers[number]
        for number in sorted(numbers)
        if any(reply.startswith(b"t,%d," % number) for reply in replies)
    )


def both(registers: kernel.Registers, register: Wheel) -> tuple[int, int]:
    """Return a register of the left and of the right wheel."""
    return int(registers[LEFT + register]), int(registers[RIGHT + register])


def is_error(reply: bytes) -> bool:
    """Return whether a reply refuses a command."""
    return reply.startswith((b"z,", COMMAND_NOT_FOUND.strip()))
