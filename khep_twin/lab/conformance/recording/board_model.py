"""Expected replies of a recorded robot, by the firmware with the same commands.

It is a `Firmware` without wheels and sensors, for letters, errors, modes and settings. A command that the
robot has refused is undone. If it is not known whether a command has arrived, the settings of the motors are
unknown until they are set again.
"""

from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

from khep_twin.board import kernel
from khep_twin.board.kernel import LEFT, RESET_VALUES, RIGHT, Board, Mode, Wheel
from khep_twin.board.protocol import COMMAND_NOT_FOUND, MOTION_COMMANDS, Request, Tool
from khep_twin.board.rom import Rom
from khep_twin.board.turrets import Turret, TurretKind, installed_turrets
from khep_twin.clock import NS_PER_S
from khep_twin.firmware import Firmware, parse
from khep_twin.log.decoding import printable
from khep_twin.log.exchanges import BANNER, Exchange
from khep_twin.log.transcript import escape
from khep_twin.units import BITS_PER_BYTE

_GAINS = {register: value for register, value in RESET_VALUES if Board.SPEED_KP <= register <= Board.SPEED_KD}


class MotorSettings(NamedTuple):
    """Settings of the left and right motor after the commands so far.

    Attributes:
        modes: Control modes.
        speeds: Speeds of D [pulses/10 ms].
        targets: Targets of C [pulses]; None if G has set the counters since.
        on_target: Target flags after the last command.
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
    """One exchange with the expected reply.

    Attributes:
        exchange: Recorded exchange.
        arrived_ns: Earliest possible arrival of the command at the robot [ns].
        byte_ns: Transmission time of a byte of the reply [ns]; 0 if unknown or none.
        request: Parsed command; None for an unsolicited line.
        expected: Reply of the firmware.
        motion: Settings of the motors after the command; None if unknown.
        exact: True if `arrived_ns` is exact, as in a twin's transcript.
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
        return max(self.exchange.reply_ns - length * self.byte_ns, self.arrived_ns)

    @property
    def reply_text(self) -> str:
        """Description of the reply."""
        reply = self.exchange.reply
        return "no reply" if reply is None else f"the reply {printable(escape(reply))}"

    @property
    def restarts(self) -> bool:
        """True if the robot sends its banner, after a command or unsolicited."""
        return BANNER in (self.exchange.reply or b"")


class KnownRobot(NamedTuple):
    """Robot as described by a log's label.

    Attributes:
        rom: Name of its ROM; empty if unknown.
        mode: Running mode; None if unknown.
        turrets: Turrets; None if unknown.
    """

    rom: str = ""
    mode: int | None = None
    turrets: tuple[TurretKind, ...] | None = None


class TimedExchange(NamedTuple):
    """An exchange with the command's earliest arrival [ns] and the baud rate, 0 if unknown."""

    exchange: Exchange
    arrived_ns: int
    baud: int


def version_reply(rom: Rom) -> bytes:
    """Return a ROM's reply to B without its line end."""
    return f"b,{rom.bios},{rom.protocol}".encode()


def count_wrong_modes(steps: Sequence[RecordedStep], rom: Rom) -> int:
    """Return the number of replies to K whose modes are not those of a ROM."""
    n_wrong = 0
    for step in steps:
        if step.exchange.letter == "K" and step.motion is not None and len(step.exchange.values or ()) == 6:
            codes = tuple(rom.mode_codes[mode] for mode in step.motion.modes)
            n_wrong += (step.exchange.values or ())[1::3] != codes
    return n_wrong


class BoardModel:
    """Firmware that receives the recorded commands.

    Args:
        rom: Version of the firmware.
        robot: Description of the robot by the label.
        exchanges: Exchanges, by which unknown turrets are guessed.
    """

    def __init__(self, rom: Rom, robot: KnownRobot, exchanges: Sequence[TimedExchange]) -> None:
        kinds = _guess_turrets(exchanges) if robot.turrets is None else robot.turrets
        self._turrets: dict[TurretKind, Turret] = {kind: kind.make() for kind in kinds}
        self._firmware = Firmware(rom, 1 if robot.mode is None else robot.mode, self._turrets)
        # A robot behind a relay was already on: its settings are unknown.
        self._is_sure = robot.mode is not None
        self._has_known_gains = True
        self._targets: tuple[int, int] | None = None

    def steps(
        self, exchanges: Sequence[TimedExchange], resets_ns: Sequence[int], simulated: bool, unpaced: bool
    ) -> Iterator[RecordedStep]:
        """Yield the steps.

        Args:
            exchanges: Exchanges in order of their commands.
            resets_ns: Times at which a user reset the board [ns].
            simulated: True for a twin, whose line has the board's baud rate.
            unpaced: True for a line without transmission times.
        """
        resets = deque(resets_ns)
        for exchange, arrived_ns, line_baud in exchanges:
            while resets and resets[0] <= exchange.sent_ns:
                resets.popleft()
                kernel.reset(self._firmware.register_view)
                self._is_sure = self._has_known_gains = True
            expected = self._execute(exchange) if exchange.command else self._handle_unasked(exchange)
            speed = self._firmware.reply_baud if simulated and not unpaced else line_baud
            byte_ns = BITS_PER_BYTE * NS_PER_S // speed if speed else 0
            request = parse(exchange.command) if exchange.command else None
            motion = self._motor_settings()
            yield RecordedStep(exchange, arrived_ns, byte_ns, request, expected, motion, simulated)

    def _handle_unasked(self, exchange: Exchange) -> bytes:
        if BANNER in (exchange.reply or b""):
            self._firmware.reset()
            self._is_sure = self._has_known_gains = True
        return b""

    def _execute(self, exchange: Exchange) -> bytes:
        """Execute a command unless the robot has refused it; return the firmware's reply."""
        firmware, reply = self._firmware, exchange.reply
        saved, settings = firmware.registers.copy(), (firmware.baud, firmware.running)
        for turret in self._turrets.values():
            # Time does not pass here, so each command must find the turret at rest.
            turret.reset()
        expected = firmware.receive(exchange.command + b"\n")
        if expected.startswith((b"z,", COMMAND_NOT_FOUND)):
            return expected
        if reply is not None and is_error(reply):
            # The robot has not executed it.
            firmware.registers[:] = saved
            firmware.baud, firmware.running = settings
            return expected
        is_answered, was_restarted = reply is not None, BANNER in (reply or b"")
        if isinstance(parse(exchange.command), Tool):
            self._is_sure = was_restarted or (self._is_sure and is_answered)
            self._has_known_gains = was_restarted or self._has_known_gains
        elif exchange.letter == "A":
            self._has_known_gains = is_answered
        elif exchange.letter == "J":
            self._is_sure = self._is_sure and is_answered
        elif exchange.letter in MOTION_COMMANDS:
            self._is_sure = is_answered
        if exchange.letter in ("C", "G"):
            targets = wheel_pair(firmware.register_view, Wheel.TARGET)
            self._targets = targets if exchange.letter == "C" else None
        return expected

    def _motor_settings(self) -> MotorSettings | None:
        view = self._firmware.register_view
        if not self._is_sure or self._firmware.running:
            return None
        left, right = wheel_pair(view, Wheel.MODE)
        return MotorSettings(
            (Mode(left), Mode(right)),
            wheel_pair(view, Wheel.SPEED_SETPOINT),
            self._targets,
            wheel_pair(view, Wheel.ON_TARGET),
            (min(wheel_pair(view, Wheel.MAX_SPEED)), min(wheel_pair(view, Wheel.ACCELERATION))),
            self._has_known_gains and all(view[register] == value for register, value in _GAINS.items()),
        )


def _guess_turrets(exchanges: Sequence[TimedExchange]) -> tuple[TurretKind, ...]:
    """Return the installed turrets whose numbers have replies."""
    numbers = {kind.number: kind for kind in reversed(tuple(installed_turrets().values()))}
    replies = [timed.exchange.reply or b"" for timed in exchanges]
    return tuple(
        numbers[number]
        for number in sorted(numbers)
        if any(reply.startswith(b"t,%d," % number) for reply in replies)
    )


def wheel_pair(registers: kernel.Registers, register: Wheel) -> tuple[int, int]:
    """Return a register of the left and of the right wheel."""
    return int(registers[LEFT + register]), int(registers[RIGHT + register])


def is_error(reply: bytes) -> bool:
    """Return whether a reply refuses a command."""
    return reply.startswith((b"z,", COMMAND_NOT_FOUND.strip()))
