"""Teleoperation: a loop that drives a robot by keys and reads its sensors.

It has a dead-man's switch. A terminal reports that a key is pressed, and repeats it while it is held, but
never that it is released; so each press drives the robot for a short time. The loop runs in a thread of its
own: if the terminal hangs, no key arrives and the motors stop. The screen is plain lines of characters.
"""

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from enum import Enum
from typing import Any

from khep_twin.errors import PortTimeout, ProtocolError
from khep_twin.host import Khepera, SensorCounts, Speeds, commands
from khep_twin.host.commands import HostCommand
from khep_twin.sensing.bars import BARS
from khep_twin.units import CONVERTER_COUNTS_PER_VOLT, N_SENSORS, SENSOR_LABELS, speed

FIRST_HOLD = 0.7
"""Driving time of a first press [s]: most keyboards wait 0.25 to 0.66 s before they repeat a key."""

REPEAT_HOLD = 0.25
"""Driving time of each repeat [s]: keys are repeated each 0.03 to 0.1 s, later over a slow network."""

FASTEST = 40
"""Highest speed by hand [pulses/10 ms]: 320 mm/s."""

TIMEOUT = 0.6
"""Longest wait for a reply [s]."""

_CYCLE = 0.05
"""Shortest cycle of the loop [s]."""

_SUPPLY_EVERY = 5.0
"""Shortest time between two readings of the supply voltage [s]."""

_REST = Speeds(0, 0)
_NOTHING = SensorCounts(*(0,) * N_SENSORS)

_LEDS = ((0, 0), (1, 0), (0, 1), (1, 1))
"""States of the lateral and the frontal LED, in the order of switching."""


class Direction(Enum):
    """Direction of driving: factors of the left and right wheel's speed. Turns go at half the speed."""

    STOP = (0.0, 0.0)
    FORWARD = (1.0, 1.0)
    BACK = (-1.0, -1.0)
    LEFT = (-0.5, 0.5)
    RIGHT = (0.5, -0.5)

    def speeds(self, speed: int) -> Speeds:
        """Return the wheels' speeds [pulses/10 ms]; a wheel that turns does so with at least 1."""
        return Speeds(*(_away_from_zero(factor * speed) for factor in self.value))


@dataclass(frozen=True, slots=True)
class DriveView:
    """State of a robot that is driven by hand.

    Attributes:
        speed: Speed chosen for the wheels [pulses/10 ms].
        direction: Direction of driving.
        measured: Measured speeds of the wheels [pulses/10 ms].
        proximity: Proximity readings [counts].
        ambient: Ambient readings [counts].
        leds: Lateral and frontal LED, 0 off or 1 on, as last sent.
        supply: Supply voltage [V], None if the robot does not report it.
        lost: Number of missing or wrong replies.
    """

    speed: int
    direction: Direction = Direction.STOP
    measured: Speeds = _REST
    proximity: SensorCounts = _NOTHING
    ambient: SensorCounts = _NOTHING
    leds: tuple[int, int] = (0, 0)
    supply: float | None = None
    lost: int = 0


class DeadManSwitch:
    """Dead-man's switch: a key drives for a short time, and longer only while it is repeated."""

    def __init__(self) -> None:
        self._direction = Direction.STOP
        self._until = 0.0

    def press(self, direction: Direction, now: float) -> None:
        """Press or repeat a key at this time [s]."""
        repeated = direction is self.direction(now)
        self._direction, self._until = direction, now + (REPEAT_HOLD if repeated else FIRST_HOLD)

    def direction(self, now: float) -> Direction:
        """Return the direction of driving at this time [s]."""
        return self._direction if now < self._until else Direction.STOP


class Teleoperation:
    """Teleoperation of a robot.

    Args:
        robot: Robot to drive, used only by the thread that calls `run`.
        speed: Initial speed [pulses/10 ms].
        now: Wall clock [s].
    """

    def __init__(self, robot: Khepera, speed: int, now: Callable[[], float] = time.monotonic) -> None:
        self._robot = robot
        self._now = now
        self._lock = threading.Lock()
        self._wake = threading.Event()
        self._switch = DeadManSwitch()
        self._view = DriveView(speed)
        self._sent: Speeds | None = None
        self._leds = _LEDS[0]
        self._sent_leds: tuple[int, int] | None = None
        self._supply_at: float | None = now()
        self._failed = False

    # From any thread -----------------------------------------------------------------------------------

    @property
    def view(self) -> DriveView:
        """Latest state."""
        with self._lock:
            return self._view

    def press(self, direction: Direction) -> None:
        """Press or repeat the key of a direction; STOP stops."""
        with self._lock:
            self._switch.press(direction, self._now())
        self._wake.set()

    def choose(self, speed: int) -> None:
        """Set the speed, 1 to FASTEST [pulses/10 ms]."""
        self._change(speed=min(max(speed, 1), FASTEST))

    def switch_leds(self) -> None:
        """Switch the LEDs to the next state: none, lateral, frontal, both, none."""
        with self._lock:
            self._leds = _LEDS[(_LEDS.index(self._leds) + 1) % len(_LEDS)]
        self._wake.set()

    # The robot's thread --------------------------------------------------------------------------------

    def run(self, stop: Callable[[], bool]) -> None:
        """Drive until `stop` returns true, then stop the motors.

        Raises:
            PortError: The line is lost.
        """
        simulated = hasattr(self._robot.port, "time_ns")
        try:
            while not stop():
                start, start_there = self._now(), self._robot.time
                self.cycle()
                self._wake.wait(max(_CYCLE - (self._now() - start), 0.0))
                self._wake.clear()
                if simulated:
                    # Simulated time advances only while the host waits: keep it level with the wall clock.
                    lag = (self._now() - start) - (self._robot.time - start_there)
                    self._robot.sleep(lag) if lag > 0 else time.sleep(-lag)
        finally:
            self._robot.set_speed(0, 0)

    def cycle(self) -> None:
        """Send what the keys demand and read the sensors.

        Raises:
            PortError: The line is lost, or two cycles in a row got no reply.
        """
        with self._lock:
            direction, leds, view = self._switch.direction(self._now()), self._leds, self._view
        speeds = direction.speeds(view.speed)
        orders: list[HostCommand[object]] = [] if speeds == self._sent else [commands.set_speed(*speeds)]
        if leds != self._sent_leds:
            orders += [commands.set_led(led, action) for led, action in enumerate(leds)]
        try:
            *_, proximity, ambient, measured = self._robot.burst(
                *orders, commands.proximity(), commands.ambient(), commands.speed()
            )
        except (PortTimeout, ProtocolError):
            # The robot may have missed any command: send all again.
            self._sent = self._sent_leds = None
            self._change(lost=view.lost + 1)
            if self._failed:
                raise
            self._failed = True
            return
        self._failed = False
        self._sent, self._sent_leds = speeds, leds
        self._change(direction=direction, leds=leds, proximity=proximity, ambient=ambient, measured=measured)
        if self._supply_at is not None and direction is Direction.STOP and self._now() >= self._supply_at:
            self._ask_for_supply()

    def _ask_for_supply(self) -> None:
        """Read the supply voltage, twice that of channel 0 of the converter; give up if it is refused."""
        self._supply_at = self._now() + _SUPPLY_EVERY
        try:
            counts = self._robot.converter(0)
        except ProtocolError:
            self._supply_at = None
        else:
            self._change(supply=2 * counts / CONVERTER_COUNTS_PER_VOLT)

    def _change(self, **changes: Any) -> None:
        with self._lock:
            self._view = replace(self._view, **changes)


def _away_from_zero(value: float) -> int:
    """Round to the nearest integer, halves away from 0."""
    return int(value + 0.5) if value >= 0 else -int(-value + 0.5)


WIDTH, HEIGHT = 64, 18
"""Size of the smallest terminal [characters]."""

_LABEL, _COUNTS, _GAP = 12, 5, 3
_ON = ("off", "on")

KEYS = (
    "arrows or WASD drive while held   space stops   q ends",
    "+ - or 1 to 9 choose the speed    L switches the LEDs",
)


def draw(view: DriveView, name: str, width: int, height: int) -> list[str]:
    """Return the lines of the screen, of at most `width` characters."""
    if width < WIDTH or height < HEIGHT:
        line = f"{width} x {height} characters; expected at least {WIDTH} x {HEIGHT}; q ends"
        return [line[: max(width - 1, 0)]]
    bar = (width - _LABEL - 2 * _COUNTS - _GAP - 1) // 2
    left, right = (1e3 * speed(pulses) for pulses in view.measured)
    supply = "" if view.supply is None else f"   supply about {view.supply:.1f} V"
    lost = f"   {view.lost} replies lost" if view.lost else ""
    column = bar + _COUNTS + _GAP
    lines = [
        f"khep-twin drive  {name}",
        "",
        f"{'':{_LABEL}}{'proximity':{column}}{BARS['light'].legend}",
        *(
            f"{sensor:{_LABEL}}"
            f"{_bar('proximity', near, bar)}{near:{_COUNTS}}{'':{_GAP}}"
            f"{_bar('light', dark, bar)}{dark:{_COUNTS}}"
            for sensor, near, dark in zip(SENSOR_LABELS, view.proximity, view.ambient, strict=True)
        ),
        "",
        f"{'wheels':{_LABEL}}left {view.measured.left:4}  right {view.measured.right:4} pulses/10 ms"
        f"   ({left:.0f}, {right:.0f} mm/s)",
        f"{'drives':{_LABEL}}{view.direction.name.lower()}, speed {view.speed}{lost}",
        f"{'LEDs':{_LABEL}}lateral {_ON[view.leds[0]]:3}  frontal {_ON[view.leds[1]]:3}{supply}",
        "",
        *KEYS,
    ]
    return [line[: width - 1] for line in lines]


def _bar(name: str, value: float, width: int) -> str:
    """Return a bar of this many characters, filled by a value."""
    full = round(BARS[name].filled(value) * width)
    return "#" * full + "." * (width - full)
