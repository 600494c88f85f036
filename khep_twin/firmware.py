"""The firmware: effects of the serial protocol's commands on the board's registers.

Bytes in, bytes out: no clock, file or thread. The control loop itself is `kernel`; the owner of the clock
calls it. Cases that the manual leaves open are decided to be safe for a host:

    - numbers of up to ten digits that are out of range are clipped: speed +-127, duty +-255, target
      +-(2^23 - 2), gains 0 to 32767, trapezoid speed 0 to 127 and acceleration 1 to 65535, counters to 32
      bits by wrapping;
    - an LED, converter channel or bus address that does not exist is a protocol error;
    - the extension bus is empty, so it reads as 255; a message to a missing turret, or one that the turret
      does not know, is answered `z,Turret order not supported`;
    - a processor without power is silent, and its motors keep their duty.

docs/protocol.md lists all these decisions.
"""

import inspect
from collections.abc import Callable, Iterable, Mapping
from functools import lru_cache
from typing import Annotated, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray
from pydantic import Base64UrlBytes, Field

from khep_twin.board import bios, kernel, protocol
from khep_twin.board.kernel import LEFT, RIGHT, Board, Mode, Wheel
from khep_twin.board.protocol import (
    END,
    PROTOCOL_ERROR,
    TURRET_REFUSAL,
    Command,
    LineReader,
    Malformed,
    Request,
    Tool,
    TurretMessage,
    reply,
)
from khep_twin.board.rom import DEMO, ROMS, SELF_TEST, Rom
from khep_twin.board.turrets import Turret, TurretKind
from khep_twin.robots.framing import LINES
from khep_twin.units import COUNTS_LIMIT, DUTY_LIMIT, N_SENSORS

Execute = TypeVar("Execute", bound=Callable[..., bytes])

SPEED_LIMIT_PULSES = 127
"""Fastest speed of command D [pulses/10 ms] (manual, appendix A)."""

TARGET_LIMIT_PULSES = 2**23 - 2
"""Farthest target of command C [pulses] (manual, appendix A)."""

GAIN_LIMIT = 32767
"""Largest controller gain (assumed: a 16-bit word)."""

ACCELERATION_LIMIT = 65535
"""Largest acceleration of command J [pulses/256 per (10 ms)^2] (assumed: a 16-bit word)."""

_LARGEST = 2**42
"""Limit of registers without a limit of their own: no arithmetic on them overflows."""

_RANGES = {
    **{
        side + register: limits
        for side in (LEFT, RIGHT)
        for register, limits in (
            (Wheel.POSITION, (-(2**31), 2**31 - 1)),
            (Wheel.MODE, (0, len(Mode) - 1)),
            (Wheel.MAX_SPEED, (0, SPEED_LIMIT_PULSES)),
            (Wheel.ACCELERATION, (0, ACCELERATION_LIMIT)),
            (Wheel.ON_TARGET, (0, 1)),
            (Wheel.DUTY, (-DUTY_LIMIT, DUTY_LIMIT)),
        )
    },
    **dict.fromkeys(range(Board.SPEED_KP, Board.LED_0), (0, GAIN_LIMIT)),
    **dict.fromkeys((Board.LED_0, Board.LED_1), (0, 1)),
    Board.SCAN: (0, N_SENSORS - 1),
    **dict.fromkeys((*kernel.PROXIMITY, *kernel.AMBIENT), (0, COUNTS_LIMIT)),
}
"""Range of each register."""

N_CONVERTER_CHANNELS = 7
"""Channels of command I (manual II, appendix A; the manual names none)."""

_PROXIMITY = slice(kernel.PROXIMITY[0], kernel.PROXIMITY[-1] + 1)
_AMBIENT = slice(kernel.AMBIENT[0], kernel.AMBIENT[-1] + 1)
_COMMANDS: dict[str, Callable[..., bytes]] = {}
_DESCRIPTIONS = {"T": "send a message to a turret"}
"""Method of each command's letter, and its description for `help`; `_command` adds to them."""


def _command(letter: str, description: str) -> Callable[[Execute], Execute]:
    """Return a decorator that makes a method the command of a letter, with the method's parameters."""

    def add(execute: Execute) -> Execute:
        _COMMANDS[letter], _DESCRIPTIONS[letter] = execute, description
        return execute

    return add


class FirmwareState(NamedTuple):
    """State of the firmware besides its registers.

    Attributes:
        baud: Baud rate of the serial line from the next reply on.
        reply_baud: Baud rate of the line for the last reply.
        running: ROM function that runs; empty for none.
        partial_line: Bytes of the incomplete line.
        turrets: Registers of each turret, by its name.
    """

    baud: Annotated[int, Field(gt=0, le=10**9)]
    reply_baud: Annotated[int, Field(gt=0, le=10**9)]
    running: Annotated[str, Field(max_length=64)]
    partial_line: Base64UrlBytes
    turrets: dict[str, tuple[Annotated[int, Field(ge=-(2**63), lt=2**63)], ...]]


class Firmware:
    """Command interpreter of one robot.

    Args:
        rom: Version of the firmware.
        mode: Running mode.
        turrets: Turrets that are plugged on top.
        registers: Memory for the state of the board (N_REGISTERS,); by default a new array.
        processor: Memory for the state of the processor (N_PROCESSOR,); by default a new array.

    Attributes:
        registers: State of the board (N_REGISTERS,).
        register_view: The same memory as a memoryview, which is faster to index.
        turrets: Turrets that are plugged on top.
        baud: Baud rate of the serial line from the next reply on.
        reply_baud: Baud rate of the line for the last reply; differs from `baud` after the tool `serial`.
        running: ROM function that runs; empty for none.
        answer_ns: Time that an answer takes [ns], 0.
    """

    answer_ns = 0

    def __init__(
        self,
        rom: Rom,
        mode: int = 1,
        turrets: Mapping[TurretKind, Turret] | None = None,
        registers: NDArray[np.int64] | None = None,
        processor: NDArray[np.int64] | None = None,
    ) -> None:
        self.registers = np.zeros(kernel.N_REGISTERS, np.int64) if registers is None else registers
        self.register_view = self.registers.data
        self._processor = (np.zeros(kernel.N_PROCESSOR, np.int64) if processor is None else processor).data
        self._rom = rom
        self._mode = rom.modes[mode]
        self._reader = LineReader()
        self.turrets = turrets or {}
        self._turrets_by_number = {kind.number: turret for kind, turret in self.turrets.items()}
        self._processor[kernel.POWERED] = 1
        self.reset()

    @property
    def powered(self) -> bool:
        """True if the supply suffices for the processor."""
        return bool(self._processor[kernel.POWERED])

    def state(self) -> FirmwareState:
        """Return the state besides the registers."""
        turrets = {kind.name: tuple(turret.registers.tolist()) for kind, turret in self.turrets.items()}
        return FirmwareState(self.baud, self.reply_baud, self.running, self._reader.partial_line, turrets)

    def set_state(self, state: FirmwareState) -> None:
        """Restore a state.

        Raises:
            ValueError: It has other turrets, or a register is outside its range.
        """
        sizes = {kind.name: len(turret.registers) for kind, turret in self.turrets.items()}
        if (state_sizes := {name: len(registers) for name, registers in state.turrets.items()}) != sizes:
            raise ValueError(f"turrets with registers {state_sizes}; expected {sizes}")
        _check_ranges("registers", self.register_view, _RANGES, _LARGEST)
        for kind in self.turrets:
            _check_ranges(f"registers of {kind.name}", state.turrets[kind.name], kind.ranges, 2**63)
        if state.running not in ("", DEMO) or self._processor[kernel.DEMO] != (state.running == DEMO):
            raise ValueError(
                f"ROM function {state.running!r}, flag {self._processor[kernel.DEMO]} of the demonstration; "
                f"expected '' and 0, or {DEMO!r} and 1"
            )
        for kind, turret in self.turrets.items():
            turret.registers[:] = state.turrets[kind.name]
        self.baud, self.reply_baud, self.running = state.baud, state.reply_baud, state.running
        self._reader.partial_line = state.partial_line

    def request_length(self, data: bytearray) -> int:
        """Return how many of the next bytes complete a request; more than their number if they do not."""
        return LINES.length(data, to_robot=True)

    def receive(self, data: bytes) -> bytes:
        """Read bytes from the line; return the replies to the commands that they complete."""
        if not self.powered:
            return b""
        self.reply_baud = self.baud
        return b"".join(self._answer(parse(line)) for line in self._reader.feed(data))

    def forget_line(self) -> None:
        """Discard the incomplete line."""
        self._reader.clear()

    def tick(self, left_pulses: int, right_pulses: int) -> None:
        """Run one control period of 10 ms, with the encoders' counts since power-up [pulses]."""
        kernel.run(self.register_view, self._processor, left_pulses, right_pulses)
        self.tick_turrets()

    def tick_turrets(self) -> None:
        """Run one control period of the turrets."""
        if self.powered:
            for turret in self.turrets.values():
                turret.tick()

    def baud_rate_hint(self, baud: int) -> str:
        """Return a hint for setting the robot's line to a host's baud rate."""
        if self._mode.baud == baud:
            return f"'restart' brings the robot back to {baud} baud"
        if (mode := self._rom.find_mode(baud)) is not None:
            return f"for {baud} baud: serve --mode {mode}, or khep://...?mode={mode}"
        if (mode := ROMS["khepera2"].find_mode(baud)) is not None:
            options = f"serve --model khepera2 --mode {mode}, or khep://...?model=khepera2&mode={mode}"
            return f"for {baud} baud, of a Khepera II: {options}"
        return f"no running mode has {baud} baud: expected {self.baud} at the host"

    def forget(self) -> None:
        """Clear the state besides registers, as a reset does: line, turrets, baud rate and function."""
        self._reader.clear()
        for turret in self.turrets.values():
            turret.reset()
        self.baud = self.reply_baud = self._mode.baud
        self._set_running("")

    def reset(self) -> bytes:
        """Reset the board, as at power-up; return the banner.

        A processor without power cannot start: nothing changes, and the banner is empty.
        """
        if not self.powered:
            return b""
        kernel.reset(self.register_view)
        self.forget()
        banner = b"".join(line.encode("ascii") + END for line in self._rom.banner)
        return banner + self._start_function(self._mode.function)

    def _answer(self, request: Request) -> bytes:
        match request:
            case Malformed():
                return request.reply
            case Command():
                return _COMMANDS[request.letter](self, *request.arguments)
            case TurretMessage():
                turret = self._turrets_by_number.get(request.turret)
                return TURRET_REFUSAL if turret is None else turret.receive(request.message)
            case Tool():
                return self._run_tool(request)

    def _run_tool(self, tool: Tool) -> bytes:
        tool_result = bios.run_tool(
            tool, bios.ToolContext(self._rom, self.running, tuple(self.turrets), DESCRIPTIONS)
        )
        if tool_result.restart:
            return self.reset()
        self.baud = tool_result.baud or self.baud
        return tool_result.reply + self._start_function(tool_result.function)

    def _start_function(self, function: str) -> bytes:
        """Start a function of the ROM; return its output."""
        if function == SELF_TEST:
            return bios.self_test(
                are_sensors_alive=any(self.register_view[register] for register in kernel.AMBIENT)
            )
        self._set_running(function or self.running)
        return b""

    def _set_running(self, function: str) -> None:
        self.running = function
        self._processor[kernel.DEMO] = function == DEMO

    def _read_wheels(self, register: Wheel) -> tuple[int, int]:
        """Return a register of the left and of the right wheel."""
        return self.register_view[LEFT + register], self.register_view[RIGHT + register]

    def _set_gains(self, first_register: Board, gains: tuple[int, ...]) -> None:
        for offset, gain in enumerate(gains):
            self.register_view[first_register + offset] = min(max(gain, 0), GAIN_LIMIT)

    @_command("A", "configure the speed controller")
    def _configure_speed_pid(self, kp: int, ki: int, kd: int) -> bytes:
        self._set_gains(Board.SPEED_KP, (kp, ki, kd))
        return reply("A")

    @_command("B", "read the software versions")
    def _versions(self) -> bytes:
        return reply("B", self._rom.bios, self._rom.protocol)

    @_command("C", "set a position to be reached")
    def _go_to_position(self, left: int, right: int) -> bytes:
        kernel.set_target(self.register_view, LEFT, kernel.clip(left, TARGET_LIMIT_PULSES))
        kernel.set_target(self.register_view, RIGHT, kernel.clip(right, TARGET_LIMIT_PULSES))
        return reply("C")

    @_command("D", "set the speed")
    def _set_speed(self, left: int, right: int) -> bytes:
        kernel.set_speed(self.register_view, LEFT, kernel.clip(left, SPEED_LIMIT_PULSES))
        kernel.set_speed(self.register_view, RIGHT, kernel.clip(right, SPEED_LIMIT_PULSES))
        return reply("D")

    @_command("E", "read the speed")
    def _read_speed(self) -> bytes:
        return reply("E", *self._read_wheels(Wheel.SPEED))

    @_command("F", "configure the position controller")
    def _configure_position_pid(self, kp: int, ki: int, kd: int) -> bytes:
        self._set_gains(Board.POSITION_KP, (kp, ki, kd))
        return reply("F")

    @_command("G", "set the position counters")
    def _set_position(self, left: int, right: int) -> bytes:
        kernel.set_position(self.register_view, LEFT, kernel.wrap(left))
        kernel.set_position(self.register_view, RIGHT, kernel.wrap(right))
        return reply("G")

    @_command("H", "read the position counters")
    def _read_position(self) -> bytes:
        return reply("H", *self._read_wheels(Wheel.POSITION))

    @_command("I", "read an A/D input")
    def _read_converter(self, channel: int) -> bytes:
        if not 0 <= channel < N_CONVERTER_CHANNELS:
            return PROTOCOL_ERROR
        # Channels 1 and 2 follow the sensor that was converted last; nothing is wired to 3, 4 and 5.
        last = (self.register_view[Board.SCAN] - 1) % N_SENSORS
        sources = {0: Board.SUPPLY, 1: Board.PROXIMITY + last, 2: Board.AMBIENT + last, 6: Board.CURRENT}
        return reply("I", self.register_view[sources[channel]] if channel in sources else 0)

    @_command("J", "configure the speed profile")
    def _configure_profile(
        self, left_speed: int, left_acceleration: int, right_speed: int, right_acceleration: int
    ) -> bytes:
        profiles = ((LEFT, left_speed, left_acceleration), (RIGHT, right_speed, right_acceleration))
        for wheel, speed, acceleration in profiles:
            self.register_view[wheel + Wheel.MAX_SPEED] = min(max(speed, 0), SPEED_LIMIT_PULSES)
            self.register_view[wheel + Wheel.ACCELERATION] = min(max(acceleration, 1), ACCELERATION_LIMIT)
        return reply("J")

    @_command("K", "read the status of the motion controller")
    def _read_status(self) -> bytes:
        status: list[int] = []
        for wheel in (LEFT, RIGHT):
            mode = self.register_view[wheel + Wheel.MODE]
            on_target = self.register_view[wheel + Wheel.ON_TARGET]
            status += [on_target, self._rom.mode_codes[mode], self.register_view[wheel + Wheel.ERROR]]
        return reply("K", *status)

    @_command("L", "change the LED state")
    def _set_led(self, led: int, action: int) -> bytes:
        if led not in (0, 1) or action not in (0, 1, 2):
            return PROTOCOL_ERROR
        register = Board.LED_0 + led
        self.register_view[register] = 1 - self.register_view[register] if action == 2 else action
        return reply("L")

    @_command("N", "read the proximity sensors")
    def _read_proximity(self) -> bytes:
        return reply("N", *self.register_view[_PROXIMITY])

    @_command("O", "read the ambient light sensors")
    def _read_ambient(self) -> bytes:
        return reply("O", *self.register_view[_AMBIENT])

    @_command("P", "set the PWM")
    def _set_duty(self, left: int, right: int) -> bytes:
        kernel.set_duty(self.register_view, LEFT, kernel.clip(left, DUTY_LIMIT))
        kernel.set_duty(self.register_view, RIGHT, kernel.clip(right, DUTY_LIMIT))
        return reply("P")

    @_command("R", "read a byte on the extension bus")
    def _read_bus(self, address: int) -> bytes:
        return reply("R", 255) if 0 <= address < 64 else PROTOCOL_ERROR

    @_command("W", "write a byte on the extension bus")
    def _write_bus(self, data: int, address: int) -> bytes:
        return reply("W") if 0 <= data < 256 and 0 <= address < 64 else PROTOCOL_ERROR


ARGUMENT_COUNTS: Mapping[str, int] = {
    letter: len(inspect.signature(execute).parameters) - 1 for letter, execute in _COMMANDS.items()
}
"""Number of arguments of each command. The eighteenth command, T, passes its arguments to a turret."""

DESCRIPTIONS: Mapping[str, str] = dict(sorted(_DESCRIPTIONS.items()))
"""Descriptions of all commands, by letter, as the tools of the ROM print them."""


def _check_ranges(
    name: str, values: Iterable[int], ranges: Mapping[int, tuple[int, int]], limit: int
) -> None:
    """Check registers of a snapshot; those without a range go from -`limit` to `limit`."""
    for register, value in enumerate(values):
        low, high = ranges.get(register, (-limit, limit))
        if not low <= value <= high:
            raise ValueError(f"{name}[{register}] = {value}; expected {low} to {high}")


@lru_cache(maxsize=1024)
def parse(line: bytes) -> Request:
    """Parse a line without its ending, as `protocol.parse` does."""
    return protocol.parse(line, ARGUMENT_COUNTS)
