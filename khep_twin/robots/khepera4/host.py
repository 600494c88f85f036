"""`Khepera4`: a Khepera IV on which kh4server runs, at the other end of a serial port, real or simulated.

The port is a URL of pyserial, as for a `Khepera`: `/dev/rfcomm0` is a robot over Bluetooth, the link of
`khep-twin serve arena4` a twin in real time, `khep://arena4` a twin in this process, in lock-step.

    from khep_twin.host import Khepera4

    with Khepera4("khep://arena4") as robot:
        robot.set_speed(0.1, 0.1)
        robot.sleep(1)
        print(robot.ultrasonic().front, robot.proximity().front)

Each command waits for its reply, as the server discards all input that arrives before it.
"""

import math
from collections.abc import Iterable, Sequence
from typing import NamedTuple

from khep_twin.host.host_command import HostCommand, order, query, split_reply
from khep_twin.host.profile_robot import ProfileRobot, to_units
from khep_twin.host.results import Battery, Distances
from khep_twin.robots.khepera4.model import KHEPERA_4, SONAR
from khep_twin.robots.khepera4.registers import COUNTS_PER_G, DEGREES_PER_COUNT, LEDS, PACKET_SIZE
from khep_twin.units import GRAVITY

_ACCELERATION_UNIT, _TURN_RATE_UNIT = GRAVITY / COUNTS_PER_G, math.radians(DEGREES_PER_COUNT)
"""Units of the accelerometer [m/s^2] and of the gyroscope [rad/s] (library)."""

Colour = tuple[int, int, int]
"""Red, green and blue, 0 to 63."""

_DISTANCES: dict[int, float | None] = dict(zip(SONAR.codes, (0.0, math.inf, None), strict=True))
"""Distances of ultrasonic readings that are codes."""

_FIELDS = [(name.replace(" ", "_"), int) for name in KHEPERA_4.body.sensors]
InfraredCounts = NamedTuple("InfraredCounts", _FIELDS)
"""Commands N and O: twelve counts, 0 to 1023, around the robot and of the ground below it.

Proximity is about 1020 at white paper, and about 100 without an object, from the floor's reflection. Ambient
counts are about 980 in the dark and 0 in bright light.
"""


class Vector3(NamedTuple):
    """A vector in the robot's frame, x forward, y left."""

    x: float
    y: float
    z: float


class Khepera4(ProfileRobot[InfraredCounts]):
    """A Khepera IV behind a serial port, see `ProfileRobot`.

    Speeds are about 0.8 m/s at most, steady above 0.003.
    """

    counts = InfraredCounts
    zero_request = ("I",)
    model = KHEPERA_4
    leds = LEDS
    speed_pulse_time = 0.01  # (manual)
    arrival_pulses = 200  # ten times the server's margin, as the wheels roll past it (1.4 mm)

    # Motors --------------------------------------------------------------------------------------------

    def set_duty(self, left: int, right: int) -> None:
        """Drive the motors with a fixed duty, -2940 to 2940, uncontrolled (command L)."""
        self._run(order("L", left, right))

    def configure_speed_controller(self, kp: int, ki: int, kd: int) -> None:
        """Set the gains of the speed controller, 0 to 255; 10, 5, 1 at the server's start (command H)."""
        self._run(order("H", kp, ki, kd, repeatable=True))

    def configure_profile(
        self,
        step_pulses: int = 3,
        divider: int = 0,
        least_accelerating_pulses: int = 20,
        least_decelerating_pulses: int = 1,
        speed_pulses: int = 400,
    ) -> None:
        """Set the profile of `set_target` and of the vehicle (command J); the defaults are the server's.

        Args:
            step_pulses: One change of the speed [pulses/10 ms].
            divider: Control periods of 10 ms from one change to the next, minus one.
            least_accelerating_pulses: Speed at which a ramp up starts [pulses/10 ms].
            least_decelerating_pulses: Speed at which a ramp down ends [pulses/10 ms].
            speed_pulses: Speed between the ramps [pulses/10 ms].
        """
        profile = step_pulses, divider, least_accelerating_pulses, least_decelerating_pulses, speed_pulses
        self._run(order("J", *profile, repeatable=True))

    def set_margin(self, margin: float) -> None:
        """Set the distance at which a target counts as reached [m]; 20 pulses at the start (command P)."""
        self._run(order("P", *to_units("margin", self.body.pulse_length, [margin]), repeatable=True))

    # Sensors, LEDs and other commands ------------------------------------------------------------------

    def ultrasonic(self) -> Distances:
        """Return five distances [m]: 0 below 0.25, inf without an echo, None if disabled (command G)."""
        return self._run(
            query("G", 5, lambda n_cm: Distances._make(_DISTANCES.get(n, n / 100) for n in n_cm))
        )

    def enable_ultrasonic(self, sensors: Iterable[int] = range(5)) -> None:
        """Enable these ultrasonic sensors, 0 left to 4 right, and disable the others (command U).

        They measure in turn, 20 ms each, so fewer sensors measure more often.
        """
        enabled = {*sensors}
        if not enabled <= {*range(5)}:
            raise ValueError(f"sensors = {sorted(enabled)}; expected some of 0 to 4")
        self._run(order("U", sum(1 << sensor for sensor in enabled), repeatable=True))

    def accelerations(self) -> tuple[Vector3, ...]:
        """Return the last ten values of the accelerometer, 10 ms apart, newest first [m/s^2] (command T).

        At rest x and y are 0 and z is -9.81.
        """
        return self._run(query("T", 3 * PACKET_SIZE, lambda values: _vectors(values, _ACCELERATION_UNIT)))

    def turn_rates(self) -> tuple[Vector3, ...]:
        """Return the last ten values of the gyroscope, newest first [rad/s]; z to the left (command S)."""
        return self._run(query("S", 3 * PACKET_SIZE, lambda values: _vectors(values, _TURN_RATE_UNIT)))

    def battery(self) -> Battery:
        """Return the state of the battery (command V, once for each value)."""
        return super().battery()._replace(is_charging=bool(self._read_battery(6)))

    def set_leds(self, left: Colour, right: Colour, back: Colour) -> None:
        """Set the colours of the LEDs front left, front right and back, 0 to 63 a colour (command K)."""
        values = [*left, *right, *back]
        if len(values) != 9 or not all(0 <= value < 64 for value in values):
            raise ValueError(f"colours {left}, {right}, {back}; expected three numbers from 0 to 63 each")
        self._run(order("K", *values, repeatable=True))

    def light_leds(self, are_lit: Sequence[bool]) -> None:
        """Switch the LEDs front left, front right and back to white or off."""
        left, right, back = (63 * is_lit for is_lit in are_lit)
        self.set_leds((left, left, left), (right, right, right), (back, back, back))

    def revision(self) -> str:
        """Return the revision of the microcontroller's firmware, for example "B0" (command B)."""
        return self._run(HostCommand("B", lambda reply: "".join(split_reply("b", 2, reply)), repeatable=True))

    def reset(self) -> None:
        """Reset the microcontroller: motors, LEDs and positions (command Z)."""
        self._run(order("Z"))

    def _battery_value(self, kind: int, reply: str) -> float:
        return float(split_reply("v", 1, reply)[0]) / (1000 if kind < 3 else 1)


def _vectors(values: Sequence[int], unit: float) -> tuple[Vector3, ...]:
    """Return the vectors of a reply, which lists all x, then all y, then all z."""
    axes = [values[start : start + PACKET_SIZE] for start in range(0, 3 * PACKET_SIZE, PACKET_SIZE)]
    return tuple(Vector3(x * unit, y * unit, z * unit) for x, y, z in zip(*axes, strict=True))
