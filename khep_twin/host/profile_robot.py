"""`ProfileRobot`: a robot behind a serial port whose wheels move along a profile, in SI units."""

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from functools import partial
from typing import Generic, TypeVar

import serial

from khep_twin.errors import MoveError
from khep_twin.files.paths import StrPath
from khep_twin.host.host_command import HostCommand, order, query, split_reply
from khep_twin.host.host_robot import HostRobot
from khep_twin.host.moves import check_finite
from khep_twin.host.results import Battery, Wheels
from khep_twin.robots.body import Body

Counts = TypeVar("Counts", bound=tuple[int, ...])

_POLL_INTERVAL_S = 0.05
"""Time between two reads of the wheels in a move [s]."""


class ProfileRobot(HostRobot, ABC, Generic[Counts]):
    """A robot with the commands A, D, E, F, M, N, O, R and V of a Khepera IV.

    Leaving it as a context stops the motors. Errors are those of `Khepera`: reads are repeated, commands that
    move the robot never.

    Args:
        url, timeout, baudrate, retries: See `Khepera`; `baudrate` is by default that of the model.
        wheel_base: Distance of the wheels [m], for `turn`; None for that of the model.

    Attributes:
        counts: Class of the results of N and O.
        zero_request: Letter and arguments of the command that sets the positions to 0.
        speed_pulse_time: Time of one pulse at a speed of 1 [s].
        arrival_pulses: Distance from the target at which stopped wheels count as arrived.
        number_prefix: Prefix of speeds and positions in requests.

    Raises:
        PortError: The port cannot be opened, or its twin is of another kind.
        ValueError: A duration, distance or number is out of range.
    """

    counts: Callable[..., Counts]
    zero_request: tuple[str, ...]
    speed_pulse_time: float
    arrival_pulses: int
    number_prefix = ""

    def __init__(
        self,
        url: StrPath | serial.SerialBase,
        timeout: float | None = None,
        baudrate: int | None = None,
        *,
        retries: int = 1,
        wheel_base: float | None = None,
    ) -> None:
        if wheel_base is not None and not 0 < wheel_base < math.inf:
            raise ValueError(f"wheel_base = {wheel_base}; expected a number above 0")
        super().__init__(url, timeout, baudrate, retries=retries)
        self._wheel_base = wheel_base
        self._target = (0, 0)

    @property
    def body(self) -> Body:
        """Body of the robot."""
        return self.model.body

    @property
    def speed_unit(self) -> float:
        """Speed of one unit [m/s]."""
        return self.body.pulse_length / self.speed_pulse_time

    def set_speed(self, left: float, right: float) -> None:
        """Drive the wheels at these speeds [m/s] (command D)."""
        speeds = to_units("speed", self.speed_unit, (left, right))
        self._run(self._wheel_order("D", speeds, repeatable=not any(speeds)))

    def set_target(self, left: float, right: float) -> None:
        """Move the wheels to these positions [m] along the profile; return immediately (command F)."""
        self._send_target(*to_units("position", self.body.pulse_length, (left, right)))

    def speed(self) -> Wheels:
        """Return the measured speeds of the wheels [m/s] (command E)."""
        unit = self.speed_unit
        return self._run(query("E", 2, lambda pulses: Wheels._make(n * unit for n in pulses)))

    def position(self) -> Wheels:
        """Return the positions of the wheels [m] (command R)."""
        unit = self.body.pulse_length
        return self._run(query("R", 2, lambda pulses: Wheels._make(n * unit for n in pulses)))

    def reset_position(self) -> None:
        """Set the positions of the wheels to 0 (command I)."""
        self._run(order(*self.zero_request))

    def reset_motors(self) -> None:
        """Set gains and profile as at the start of the robot's program, with idle motors (command M)."""
        self._run(order("M", repeatable=True))

    def proximity(self) -> Counts:
        """Return the proximity counts (command N)."""
        return self.counts(*self.read_channels("proximity")["proximity"])

    def ambient(self) -> Counts:
        """Return the ambient counts, which are high in the dark (command O)."""
        return self.counts(*self.read_channels("ambient")["ambient"])

    def supply_voltage(self) -> float:
        """Return the voltage of the battery [V] (command V)."""
        return self._read_battery(0)

    def battery(self) -> Battery:
        """Return the state of the battery (command V, once for each value)."""
        *values, percent = map(self._read_battery, range(6))
        return Battery._make([*values, percent / 100, None])

    def move(self, distance: float, timeout: float = 30.0) -> Wheels:
        """Drive straight by a distance [m], backwards if it is below 0; return on arrival.

        Raises:
            MoveError: Not on target after `timeout` [s]; the motors are stopped.
        """
        return self._drive_by(distance, distance, timeout)

    def turn(self, angle: float, timeout: float = 30.0) -> Wheels:
        """Turn in place by an angle [rad], left if it is above 0; return on arrival.

        Raises:
            MoveError: Not on target after `timeout` [s]; the motors are stopped.
        """
        distance = angle * (self._wheel_base or self.body.wheel_base) / 2
        return self._drive_by(-distance, distance, timeout)

    def wait_for_target(self, timeout: float = 30.0) -> None:
        """Wait until both wheels stand at the target of `set_target`.

        Raises:
            MoveError: Not on target after `timeout` [s].
        """
        end, last_positions = self.time + timeout, ()
        while True:
            positions = self._run(query("R", 2, tuple))
            errors = [abs(target - now) for target, now in zip(self._target, positions, strict=True)]
            if positions == last_positions and max(errors) <= self.arrival_pulses:
                return
            if not self.time <= end:
                raise MoveError(f"{self.name}: not on target after {timeout:g} s")
            last_positions = positions
            self.sleep(_POLL_INTERVAL_S)

    def wander(self) -> None:
        """Let the robot's vehicle drive and avoid obstacles, until `stop_wandering` (command A)."""
        self._run(order("A", 0))

    def stop_wandering(self) -> None:
        """Stop the robot's vehicle, if it drives (command A)."""
        self._run(HostCommand("A,2", lambda reply: split_reply("a", 0, reply), repeatable=True))

    def _read_battery(self, kind: int) -> float:
        return self._run(HostCommand(f"V,{kind}", partial(self._battery_value, kind), repeatable=True))

    @abstractmethod
    def _battery_value(self, kind: int, reply: str) -> float:
        """Return a value of `Battery` by the reply to V, the level in percent."""

    def _wheel_order(
        self, letter: str, numbers: Sequence[int], repeatable: bool = False
    ) -> HostCommand[None]:
        """Return a command with numbers of the left and right wheel."""
        prefixed_numbers = (f"{self.number_prefix}{number}" for number in numbers)
        return order(letter, *prefixed_numbers, repeatable=repeatable)

    def _send_target(self, left_pulses: int, right_pulses: int) -> None:
        self._target = left_pulses, right_pulses
        self._run(self._wheel_order("F", self._target))

    def _drive_by(self, left: float, right: float, timeout: float) -> Wheels:
        """Move the wheels by distances [m]; return their positions on arrival [m]."""
        distances = to_units("distance", self.body.pulse_length, (left, right))
        positions = self._run(query("R", 2, tuple))
        self._send_target(positions[0] + distances[0], positions[1] + distances[1])
        try:
            self.wait_for_target(timeout)
        except MoveError as error:
            self.set_speed(0, 0)
            raise MoveError(f"{error}; stopped at {tuple(self.position())} m") from None
        return self.position()


def to_units(name: str, unit: float, values: Sequence[float]) -> list[int]:
    """Divide values by a unit and round them; raise ValueError with the name unless they are finite."""
    return [round(check_finite(name, value) / unit) for value in values]
