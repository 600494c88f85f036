"""The protocol's commands as values: request, parser of the reply, and whether the command may be repeated.

`Khepera` has a method for each; a burst sends several together:

    proximity, positions = robot.burst(commands.proximity(), commands.position())
"""

from collections.abc import Sequence
from functools import cache

from khep_twin.board.rom import ROMS
from khep_twin.host.host_command import HostCommand as HostCommand
from khep_twin.host.host_command import order, query, split_reply
from khep_twin.host.results import (
    MotionStatus,
    MotorMode,
    Positions,
    SensorCounts,
    Speeds,
    Versions,
    WheelStatus,
)
from khep_twin.units import N_SENSORS


def mode_codes(bios: str) -> tuple[int, int, int]:
    """Return command K's numbers of speed, position and PWM mode: as ROM 4.06 before BIOS version 5."""
    return ROMS["4.06" if bios.partition(".")[0].zfill(4) < "0005" else "5.02"].mode_codes


@cache
def versions() -> HostCommand[Versions]:
    """Return command B: versions of the BIOS and of the protocol."""
    return HostCommand("B", lambda reply: Versions(*split_reply("b", 2, reply)), repeatable=True)


@cache
def speed() -> HostCommand[Speeds]:
    """Return command E: measured speeds [pulses/10 ms]."""
    return query("E", 2, Speeds._make)


@cache
def position() -> HostCommand[Positions]:
    """Return command H: position counters [pulses]."""
    return query("H", 2, Positions._make)


@cache
def proximity() -> HostCommand[SensorCounts]:
    """Return command N: eight proximity counts."""
    return query("N", N_SENSORS, SensorCounts._make)


@cache
def ambient() -> HostCommand[SensorCounts]:
    """Return command O: eight ambient counts."""
    return query("O", N_SENSORS, SensorCounts._make)


def converter(channel: int) -> HostCommand[int]:
    """Return command I: one channel of the analogue-to-digital converter [counts]."""
    return query("I", 1, lambda values: values[0], channel)


def status(codes: tuple[int, int, int] = ROMS["5.02"].mode_codes) -> HostCommand[MotionStatus]:
    """Return command K: motion control; `codes` as `mode_codes` returns them."""

    def read(values: Sequence[int]) -> MotionStatus:
        left, right = (_wheel_status(*values[start : start + 3], codes=codes) for start in (0, 3))
        return MotionStatus(left, right)

    return query("K", 6, read)


def set_speed(left: int, right: int) -> HostCommand[None]:
    """Return command D: speeds [pulses/10 ms]. Only a stop is repeatable."""
    return order("D", left, right, repeatable=left == right == 0)


def set_target(left: int, right: int) -> HostCommand[None]:
    """Return command C: targets [pulses]."""
    return order("C", left, right)


def set_duty(left: int, right: int) -> HostCommand[None]:
    """Return command P: duties, -255 to 255."""
    return order("P", left, right)


def set_position(left: int, right: int) -> HostCommand[None]:
    """Return command G: position counters [pulses]. A repetition would lose the pulses in between."""
    return order("G", left, right)


def configure_speed_controller(kp: int, ki: int, kd: int) -> HostCommand[None]:
    """Return command A: gains of the speed controller."""
    return order("A", kp, ki, kd, repeatable=True)


def configure_position_controller(kp: int, ki: int, kd: int) -> HostCommand[None]:
    """Return command F: gains of the position controller."""
    return order("F", kp, ki, kd, repeatable=True)


def configure_profile(
    left_speed: int, left_acceleration: int, right_speed: int, right_acceleration: int
) -> HostCommand[None]:
    """Return command J: profile of moves, by wheel: speed [pulses/10 ms], acceleration [3.125 mm/s^2]."""
    return order("J", left_speed, left_acceleration, right_speed, right_acceleration, repeatable=True)


def set_led(led: int, action: int) -> HostCommand[None]:
    """Return command L: LED 0 (lateral) or 1 (frontal); action 0 off, 1 on, 2 toggle."""
    return order("L", led, action, repeatable=action != 2)


def read_bus(address: int) -> HostCommand[int]:
    """Return command R: read a byte of the extension bus; not repeatable, as reads may have effects."""
    return query("R", 1, lambda values: values[0], address, repeatable=False)


def write_bus(data: int, address: int) -> HostCommand[None]:
    """Return command W: write a byte to the extension bus."""
    return order("W", data, address)


def turret(number: int, message: str) -> HostCommand[str]:
    """Return command T: message to a turret; the value is its answer without the head "t,1,"."""
    head = f"t,{number},"

    def read(reply: str) -> str:
        if not reply.startswith(head):
            raise ValueError(f"expected {head!r} and the turret's answer")
        return reply.removeprefix(head)

    return HostCommand(f"T,{number},{message}", read)


def _wheel_status(on_target: int, mode: int, error: int, *, codes: tuple[int, int, int]) -> WheelStatus:
    if mode not in codes:
        raise ValueError(f"expected a mode of {', '.join(map(str, sorted(codes)))}")
    return WheelStatus(bool(on_target), MotorMode(codes.index(mode)), error)
