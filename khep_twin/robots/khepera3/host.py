"""`Khepera3`: a Khepera III at the other end of a serial port, real or simulated.

    from khep_twin.host import Khepera3

    with Khepera3("khep://arena3") as robot:
        robot.set_speed(0.1, 0.1)
        robot.sleep(1)
        print(robot.ultrasonic().front, robot.proximity().front_left)

The robot's firmware answers, or kh3server on a KoreBot. Before firmware 3.0 robots have another gear: the
first use of speeds or positions asks for the version.
"""

import math
from collections.abc import Iterable, Sequence
from dataclasses import replace
from typing import NamedTuple

from khep_twin.host.host_command import HostCommand, order, query, split_reply
from khep_twin.host.profile_robot import ProfileRobot, to_units
from khep_twin.host.results import Distances
from khep_twin.robots.body import Body
from khep_twin.robots.khepera3.model import KHEPERA_3, KHEPERA_3_V2
from khep_twin.robots.khepera3.registers import PULSES_PER_SPEED, PWM_LIMIT, SETTINGS, ULTRASONIC, Setting

_FIELDS = [(name.replace(" ", "_"), int) for name in KHEPERA_3.body.sensors]
InfraredReadings = NamedTuple("InfraredReadings", _FIELDS)
"""Commands N and O: eleven counts, 0 to 4095, around the robot and of the ground below it.

Proximity is about 3980 at white paper; noise may be below 0. Ambient counts are about 4000 in the dark.
"""


class Echo(NamedTuple):
    """Command G: an echo.

    Distance [m], amplitude [counts], and time since the robot's start or `reset_timer` [s].
    """

    distance: float
    amplitude: int
    time: float


_NO_ECHO = Echo(math.inf, 0, 0.0)


class Khepera3(ProfileRobot[InfraredReadings]):
    """A Khepera III behind a serial port, see `ProfileRobot`.

    Speeds are about 0.2 m/s at most, 0.3 before firmware 3.0.
    """

    counts = InfraredReadings
    zero_request = "I", "l0", "l0"
    model = KHEPERA_3
    leds = ("green", "red")
    speed_pulse_time = 1 / PULSES_PER_SPEED
    arrival_pulses = 60  # ten times the margin
    number_prefix = "l"
    _active_mask = SETTINGS[Setting.ULTRASONIC]

    @property
    def body(self) -> Body:
        """Body of the robot's generation, by its version if the model is unknown."""
        if "model" not in vars(self):
            self.model = KHEPERA_3 if self.version() >= (3, 0) else KHEPERA_3_V2
        return self.model.body

    def version(self) -> tuple[int, int]:
        """Return version and revision of the firmware (command B)."""
        return self._run(query("B", 2, lambda values: (values[0], values[1])))

    # Motors --------------------------------------------------------------------------------------------

    def set_duty(self, left: float, right: float) -> None:
        """Drive the motors with a part of their voltage, -1 to 1, uncontrolled (command L)."""
        self._run(self._wheel_order("L", to_units("duty", 1 / PWM_LIMIT, (left, right))))

    def configure_speed_controller(self, kp: int, ki: int, kd: int) -> None:
        """Set the gains of the speed controller; 620, 10, 3 at the start (command H)."""
        self._configure_controller(0, kp, ki, kd)

    def configure_position_controller(self, kp: int, ki: int, kd: int) -> None:
        """Set the gains of the position controller; 600, 30, 20 at the start (command H)."""
        self._configure_controller(1, kp, ki, kd)

    def configure_profile(self, speed: float, acceleration: int) -> None:
        """Set speed [m/s] and acceleration, 0 to 255, of `move`, `turn` and `set_target` (command J)."""
        (units,) = to_units("speed", self.speed_unit, [speed])
        self._run(order("J", f"l{units}", f"d{acceleration}", repeatable=True))

    def wander(self) -> None:
        """Let the robot's vehicle drive and avoid obstacles, until `stop_wandering` (command A)."""
        self.stop_wandering()  # kh3server starts a second vehicle in the first one
        super().wander()

    # Sensors, LEDs and other commands ------------------------------------------------------------------

    def infrared_time(self) -> float:
        """Return the time of the infrared readings since the start or `reset_timer` [s] (command N)."""
        return self._run(query("N", 12, lambda values: values[-1] / 1000))

    def echoes(self, sensor: int) -> list[Echo]:
        """Return the echoes of an ultrasonic sensor, 0 left to 4 right, the nearest first (command G)."""
        if sensor not in range(len(ULTRASONIC)):
            raise ValueError(f"sensor = {sensor}; expected 0 to 4")
        return self._run(query("G", 17, _echoes, sensor + 1))

    def ultrasonic(self) -> Distances:
        """Return distances of the nearest echoes [m] (command G, once for each active sensor)."""
        distances = (
            min(self.echoes(sensor), default=_NO_ECHO).distance if self._active_mask >> sensor & 1 else None
            for sensor in range(len(ULTRASONIC))
        )
        return Distances._make(distances)

    def configure_ultrasonic(self, sensors: Iterable[int] = range(5), n_echoes: int = 3) -> None:
        """Make these ultrasonic sensors active, and set their number of echoes (command C).

        They measure in turn, 0 left to 4 right. At the robot's start only the front one is active.

        Args:
            sensors: None, one, or neighbours.
            n_echoes: Largest number of echoes, 1 to 5.
        """
        active = sorted({*sensors})
        if active and active != [*range(max(active[0], 0), min(active[-1], 4) + 1)]:
            raise ValueError(f"sensors = {active}; expected neighbours among 0 to 4")
        if not 1 <= n_echoes <= 5:
            raise ValueError(f"n_echoes = {n_echoes}; expected 1 to 5")
        mask = sum(1 << sensor for sensor in active)
        for setting, value in ((Setting.ULTRASONIC, mask), (Setting.N_ECHOES, n_echoes)):
            self._run(order("C", setting.value, f"d{value}", repeatable=True))
        self._active_mask = mask

    def reset_timer(self) -> None:
        """Set the time of readings to 0 (command Z)."""
        self._run(order("Z", repeatable=True))

    def light_leds(self, are_lit: Sequence[bool]) -> None:
        """Switch the green and the red LED on or off (command K)."""
        for led, is_lit in enumerate(are_lit):
            self._run(order("K", led, int(is_lit), repeatable=True))

    def _read_command(self, request: tuple[str, int]) -> HostCommand[Sequence[int]]:
        """Return a read, of N with signs also from kh3server, which sends unsigned counts."""
        command = super()._read_command(request)

        def read(reply: str) -> Sequence[int]:
            *counts, time_ms = command.read(reply)
            return [*(count - 0x10000 if count >= 0x8000 else count for count in counts), time_ms]

        return replace(command, read=read) if request[0] == "N" else command

    def _battery_value(self, kind: int, reply: str) -> float:
        parts = 10 if kind == 4 else 10_000  # of a degree, a volt or an ampere (manual)
        integer, *fraction = split_reply("v", 1 if kind in (3, 5) else 2, reply)
        size = abs(int(integer)) + sum(map(int, fraction)) / parts
        return -size if integer.startswith("-") else size

    def _configure_controller(self, kind: int, *gains: int) -> None:
        self._run(order("H", *(f"d{value}" for value in (kind, *gains)), repeatable=True))


def _echoes(values: Sequence[int]) -> list[Echo]:
    starts = range(1, 1 + 3 * values[0], 3)
    return [Echo(values[i] / 100, values[i + 1], values[i + 2] / 1000) for i in starts]
