"""`Khepera`: a robot at the other end of a serial port, real or simulated.

The port is a URL of pyserial: `/dev/ttyUSB0` is a robot on a cable, the link of `khep-twin serve` a twin in
real time, `socket://` and `rfc2217://` a robot or twin over a network, `khep://default` a twin in this
process, in lock-step.

    from khep_twin.host import Khepera

    with Khepera("khep://default") as robot:
        robot.set_speed(5, 5)
        robot.sleep(1)
        print(robot.proximity())
"""

import math
from collections.abc import Sequence
from typing import Any, Literal, TypeVar, overload

import serial

from khep_twin.errors import MoveError
from khep_twin.files.paths import StrPath
from khep_twin.host import commands
from khep_twin.host.commands import HostCommand
from khep_twin.host.host_robot import HostRobot
from khep_twin.host.moves import TARGET_LIMIT_PULSES, turn_pulses, way_pulses
from khep_twin.host.results import MotionStatus as MotionStatus
from khep_twin.host.results import MotorMode, Positions, SensorCounts, Speeds, Versions
from khep_twin.host.results import WheelStatus as WheelStatus
from khep_twin.robots.khepera.model import KHEPERA_1
from khep_twin.units import CONVERTER_COUNTS_PER_VOLT, WHEEL_BASE

A = TypeVar("A")
B = TypeVar("B")
C = TypeVar("C")
D = TypeVar("D")

BURST_LENGTH = 7
"""Number of commands that are sent before the first reply, as in public host programs."""

_POLL_INTERVAL_S = 0.05
"""Time between two reads of the wheels in a move [s]."""


class Khepera(HostRobot):
    """A Khepera behind a serial port, a `HostRobot` with a method for each command.

    Args:
        url: URL of the port, or an open port of pyserial, which keeps its timeout. timeout: Longest wait for
        a silent robot [s], in the port's time: half of it for a reply, half for a probe; by default 0.5 s for
        a reply and 5 s in all. baudrate: Baud rate, 9600 in the robot's running mode 1; "auto" tries all.
        retries: Number of repetitions of a read; more than one lengthen the wait for a silent robot.
        wheel_base: Distance of the wheels [m], for `turn`.

    Raises:
        PortError: The port cannot be opened, or there is no reply with "auto".
        ValueError: A duration, distance or number is out of range.
    """

    model = KHEPERA_1
    burst_length = BURST_LENGTH
    leds = ("lateral", "frontal")

    def __init__(
        self,
        url: StrPath | serial.SerialBase,
        timeout: float | None = None,
        baudrate: int | Literal["auto"] = 9600,
        *,
        retries: int = 1,
        wheel_base: float = WHEEL_BASE,
    ) -> None:
        if not 0 < wheel_base < math.inf:
            raise ValueError(f"wheel_base = {wheel_base}; expected a number above 0")
        super().__init__(url, timeout, baudrate, retries=retries)
        self._wheel_base = wheel_base
        self._mode_codes: tuple[int, int, int] | None = None

    # Motors --------------------------------------------------------------------------------------------

    def set_speed(self, left: int, right: int) -> None:
        """Drive the wheels at these speeds [pulses/10 ms = 8 mm/s], -127 to 127 (command D)."""
        self._run(commands.set_speed(left, right))

    def set_target(self, left: int, right: int) -> None:
        """Move the wheels to these positions [pulses of 0.08 mm]; return immediately (command C)."""
        self._run(commands.set_target(left, right))

    def set_duty(self, left: int, right: int) -> None:
        """Drive the motors with a fixed duty, -255 to 255, uncontrolled (command P)."""
        self._run(commands.set_duty(left, right))

    def set_position(self, left: int, right: int) -> None:
        """Set the position counters [pulses] (command G)."""
        self._run(commands.set_position(left, right))

    def reset_position(self) -> None:
        """Set the position counters to 0 (command G)."""
        self.set_position(0, 0)

    def speed(self) -> Speeds:
        """Return the measured speed of the left and right wheel [pulses/10 ms] (command E)."""
        return self._run(commands.speed())

    def position(self) -> Positions:
        """Return the position counters of the left and right wheel [pulses] (command H)."""
        return self._run(commands.position())

    def status(self) -> MotionStatus:
        """Return the motion control status of the left and right wheel (command K).

        The first call also requests B, as the numbers of the modes depend on the ROM's version.
        """
        if self._mode_codes is None:
            self._mode_codes = commands.mode_codes(self.versions().bios)
        return self._run(commands.status(self._mode_codes))

    def configure_speed_controller(self, kp: int, ki: int, kd: int) -> None:
        """Set the gains of the speed controller; 3800, 800, 100 after a reset (command A)."""
        self._run(commands.configure_speed_controller(kp, ki, kd))

    def configure_position_controller(self, kp: int, ki: int, kd: int) -> None:
        """Set the gains of the position controller; 3000, 20, 4000 after a reset (command F)."""
        self._run(commands.configure_position_controller(kp, ki, kd))

    def configure_profile(
        self, left_speed: int, left_acceleration: int, right_speed: int, right_acceleration: int
    ) -> None:
        """Set the profile of `set_target`: speed [pulses/10 ms], acceleration [3.125 mm/s^2] (command J)."""
        self._run(commands.configure_profile(left_speed, left_acceleration, right_speed, right_acceleration))

    # Blocking moves ------------------------------------------------------------------------------------

    def move(self, distance: float, timeout: float = 30.0) -> Positions:
        """Drive straight by a distance [m], backwards if it is below 0; return on arrival.

        Raises:
            MoveError: Not on target after `timeout` [s], and stopped; or beyond the counters' range.
        """
        pulses = way_pulses(distance)
        return self._drive_by(pulses, pulses, timeout)

    def turn(self, angle: float, timeout: float = 30.0) -> Positions:
        """Turn in place by an angle [rad], left if it is above 0; return on arrival.

        Raises:
            MoveError: Not on target after `timeout` [s], and stopped; or beyond the counters' range.
        """
        pulses = turn_pulses(angle, self._wheel_base)
        return self._drive_by(-pulses, pulses, timeout)

    def wait_for_target(self, timeout: float = 30.0) -> None:
        """Wait until both wheels are at the target of `set_target`.

        Raises:
            MoveError: Not on target after `timeout` [s], or there is no target.
        """
        end = self.time + timeout
        while not (status := self.status()).on_target:
            named_wheels = zip(("left", "right"), status, strict=True)
            moving_wheels = [(name, wheel) for name, wheel in named_wheels if not wheel.on_target]
            for name, wheel in moving_wheels:
                if wheel.mode != MotorMode.POSITION:
                    raise MoveError(
                        f"{self.name}: the {name} wheel goes to no target but is in {wheel.mode.name} mode; "
                        "expected set_target before"
                    )
            if not self.time <= end:
                names = " and ".join(name for name, _ in moving_wheels)
                raise MoveError(f"{self.name}: not on target after {timeout:g} s ({names} wheel)")
            self.sleep(_POLL_INTERVAL_S)

    # Sensors, LEDs and other commands ------------------------------------------------------------------

    def proximity(self) -> SensorCounts:
        """Return eight proximity counts, 0 to 1023 (command N).

        Left 90, 45, 10, right 10, 45, 90, back right, back left.
        """
        return self._run(commands.proximity())

    def ambient(self) -> SensorCounts:
        """Return eight ambient counts as ordered in `proximity`, 500 (dark) to 50 (bright) (command O)."""
        return self._run(commands.ambient())

    def supply_voltage(self) -> float:
        """Return the voltage of the supply [V], twice that at the converter's channel 0."""
        return 2 * self.converter(0) / CONVERTER_COUNTS_PER_VOLT

    def converter(self, channel: int) -> int:
        """Return one channel of the 10-bit analogue-to-digital converter, 1024 = 4.09 V (command I)."""
        return self._run(commands.converter(channel))

    def versions(self) -> Versions:
        """Return the versions of BIOS and protocol, e.g. ("5.02", "5.01") (command B)."""
        return self._run(commands.versions())

    def set_led(self, led: int, action: int) -> None:
        """Switch LED 0 (lateral) or 1 (frontal); action 0 off, 1 on, 2 toggle (command L)."""
        self._run(commands.set_led(led, action))

    def light_leds(self, are_lit: Sequence[bool]) -> None:
        """Switch the lateral and the frontal LED on or off."""
        self.burst(*(commands.set_led(led, int(is_lit)) for led, is_lit in enumerate(are_lit)))

    def read_bus(self, address: int) -> int:
        """Return a byte of the extension bus, addresses 0 to 63 (command R)."""
        return self._run(commands.read_bus(address))

    def write_bus(self, data: int, address: int) -> None:
        """Write a byte to the extension bus (command W)."""
        self._run(commands.write_bus(data, address))

    def turret(self, number: int, message: str) -> str:
        """Send a message, for example "D,0", to a turret; return its answer without "t,1," (command T)."""
        return self._run(commands.turret(number, message))

    @overload
    def burst(self, first: HostCommand[A], /) -> tuple[A]: ...
    @overload
    def burst(self, first: HostCommand[A], second: HostCommand[B], /) -> tuple[A, B]: ...
    @overload
    def burst(
        self, first: HostCommand[A], second: HostCommand[B], third: HostCommand[C], /
    ) -> tuple[A, B, C]: ...
    @overload
    def burst(
        self, first: HostCommand[A], second: HostCommand[B], third: HostCommand[C], fourth: HostCommand[D], /
    ) -> tuple[A, B, C, D]: ...
    @overload
    def burst(self, /, *host_commands: HostCommand[object]) -> tuple[Any, ...]: ...
    def burst(self, /, *host_commands: HostCommand[object]) -> tuple[object, ...]:
        """Send several commands of `khep_twin.host.commands` together and return their values.

        The next command is sent while a reply arrives, which saves transmission time. A burst is repeated as
        a whole, if all its commands are repeatable; after an error some may have been executed.
        """
        return tuple(self._run_all(host_commands))

    def _drive_by(self, left: int, right: int, timeout: float) -> Positions:
        """Move the wheels by numbers of pulses; return their positions on arrival."""
        start = self.position()
        target = start.left + left, start.right + right
        if max(map(abs, target)) > TARGET_LIMIT_PULSES:
            raise MoveError(
                f"{self.name}: from counters {tuple(start)} to {target} pulses; "
                f"expected a target within {TARGET_LIMIT_PULSES} of 0"
            )
        self.set_target(*target)
        try:
            self.wait_for_target(timeout)
        except MoveError as error:
            self.set_speed(0, 0)
            position = self.position()
            raise MoveError(f"{error}; stopped at {tuple(position)} of {target} pulses") from None
        return self.position()
