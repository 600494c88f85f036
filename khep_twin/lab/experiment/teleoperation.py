"""Driving a robot by hand: a loop that tells it what the keys want and asks what it senses.

It has a dead-man's switch. A terminal tells that a key is pressed, and again and again while it is held, but
never that it is released; so each press lets the robot drive for a moment only. The loop has a thread of its
own: where the terminal hangs, no key comes through, and the motors stop.
"""

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from enum import Enum
from typing import Any

from khep_twin.errors import PortTimeout, ProtocolError
from khep_twin.host import Khepera, SensorCounts, Speeds, commands
from khep_twin.host.commands import Command
from khep_twin.units import CONVERTER_COUNTS_PER_VOLT, N_SENSORS

FIRST_HOLD = 0.7
"""The first press drives for so long [s]: most keyboards wait 0.25 to 0.66 s before they repeat a key."""

REPEAT_HOLD = 0.25
"""Each repeat drives on for so long [s]: keys are repeated each 0.03 to 0.1 s, later over a slow network."""

FASTEST = 40
"""Highest speed by hand [pulses/10 ms]: 320 mm/s."""

TIMEOUT = 0.6
"""Longest wait for a silent robot [s]."""

_CYCLE = 0.05
"""The robot is asked no more often than this [s]."""

_SUPPLY_EVERY = 5.0
"""The supply voltage is asked for no more often than this [s]."""

_REST = Speeds(0, 0)
_NOTHING = SensorCounts(*(0,) * N_SENSORS)

_LEDS = ((0, 0), (1, 0), (0, 1), (1, 1))
"""Lateral and frontal LED, one after the other."""


class Way(Enum):
    """Where to drive: factors of the left and right wheel's speed. Turns go at half the speed."""

    STOP = (0.0, 0.0)
    FORWARD = (1.0, 1.0)
    BACK = (-1.0, -1.0)
    LEFT = (-0.5, 0.5)
    RIGHT = (0.5, -0.5)

    def speeds(self, speed: int) -> Speeds:
        """Of the wheels [pulses/10 ms]; a wheel that turns does so with at least 1."""
        left, right = (_away_from_zero(factor * speed) for factor in self.value)
        return Speeds(left, right)


@dataclass(frozen=True, slots=True)
class View:
    """What is to be seen of a robot that is driven by hand.

    Attributes:
        speed: chosen for the wheels [pulses/10 ms].
        way: where it drives.
        measured: speeds of the wheels [pulses/10 ms].
        proximity: counts.
        ambient: counts.
        leds: lateral and frontal, 0 off or 1 on, as last sent.
        supply: voltage, if the robot tells it [V].
        lost: replies that were missing or wrong.
    """

    speed: int
    way: Way = Way.STOP
    measured: Speeds = _REST
    proximity: SensorCounts = _NOTHING
    ambient: SensorCounts = _NOTHING
    leds: tuple[int, int] = (0, 0)
    supply: float | None = None
    lost: int = 0


class DeadManSwitch:
    """Lets a key drive for a moment, and longer only while it is repeated."""

    def __init__(self) -> None:
        self._way = Way.STOP
        self._until = 0.0

    def press(self, way: Way, now: float) -> None:
        """A key is pressed or repeated at this time [s]."""
        repeated = way is self.way(now)
        self._way, self._until = way, now + (REPEAT_HOLD if repeated else FIRST_HOLD)

    def way(self, now: float) -> Way:
        """Where to drive at this time [s]."""
        return self._way if now < self._until else Way.STOP


class Teleoperation:
    """A robot that is driven by hand.

    Args:
        robot: that is driven, by the thread that calls `run` only.
        speed: to begin with [pulses/10 ms].
        now: the clock on the wall [s].
    """

    def __init__(self, robot: Khepera, speed: int, now: Callable[[], float] = time.monotonic) -> None:
        self._robot = robot
        self._now = now
        self._lock = threading.Lock()
        self._wake = threading.Event()
        self._switch = DeadManSwitch()
        self._view = View(speed)
        self._sent: Speeds | None = None
        self._leds = _LEDS[0]
        self._sent_leds: tuple[int, int] | None = None
        self._supply_at: float | None = now()
        self._failed = False

    # From any thread -----------------------------------------------------------------------------------

    @property
    def view(self) -> View:
        """What was seen last."""
        with self._lock:
            return self._view

    def press(self, way: Way) -> None:
        """A key for a way is pressed or repeated; STOP stops."""
        with self._lock:
            self._switch.press(way, self._now())
        self._wake.set()

    def choose(self, speed: int) -> None:
        """Sets the speed, 1 to FASTEST [pulses/10 ms]."""
        self._change(speed=min(max(speed, 1), FASTEST))

    def switch_leds(self) -> None:
        """None, lateral, frontal, both, none."""
        with self._lock:
            self._leds = _LEDS[(_LEDS.index(self._leds) + 1) % len(_LEDS)]
        self._wake.set()

    # The robot's thread --------------------------------------------------------------------------------

    def run(self, stop: Callable[[], bool]) -> None:
        """Drives until `stop` says so, and stops the motors.

        Raises:
            PortError: the line is lost.
        """
        simulated = hasattr(self._robot.port, "time_ns")
        try:
            while not stop():
                start, start_there = self._now(), self._robot.time
                self.cycle()
                self._wake.wait(max(_CYCLE - (self._now() - start), 0.0))
                self._wake.clear()
                if simulated:
                    # Its time passes only while somebody waits for it: as much as on the wall.
                    lag = (self._now() - start) - (self._robot.time - start_there)
                    self._robot.sleep(lag) if lag > 0 else time.sleep(-lag)
        finally:
            self._robot.set_speed(0, 0)

    def cycle(self) -> None:
        """Tells the robot what the keys want, and asks what it senses.

        Raises:
            PortError: the line is lost; or nothing came through for the second time running.
        """
        with self._lock:
            way, leds, view = self._switch.way(self._now()), self._leds, self._view
        speeds = way.speeds(view.speed)
        orders: list[Command[Any]] = [] if speeds == self._sent else [commands.set_speed(*speeds)]
        if leds != self._sent_leds:
            orders += [commands.set_led(led, action) for led, action in enumerate(leds)]
        try:
            *_, proximity, ambient, measured = self._robot.burst(
                *orders, commands.proximity(), commands.ambient(), commands.speed()
            )
        except (PortTimeout, ProtocolError):
            # What has been carried out is not known: next time all is sent again.
            self._sent = self._sent_leds = None
            self._change(lost=view.lost + 1)
            if self._failed:
                raise
            self._failed = True
            return
        self._failed = False
        self._sent, self._sent_leds = speeds, leds
        self._change(way=way, leds=leds, proximity=proximity, ambient=ambient, measured=measured)
        if self._supply_at is not None and way is Way.STOP and self._now() >= self._supply_at:
            self._ask_for_supply()

    def _ask_for_supply(self) -> None:
        """Channel 0 of the converter is half the supply voltage; a robot that refuses is not asked again."""
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
    """Rounded to the whole number that is no nearer to 0."""
    return int(value + 0.5) if value >= 0 else -int(-value + 0.5)
