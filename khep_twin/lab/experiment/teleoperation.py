"""Teleoperation: a loop that drives a robot by keys and reads its sensors.

It has a dead-man's switch. A terminal reports that a key is pressed, and repeats it while it is held, but
never reports its release. So each press drives the robot for a short time only. The loop runs in a separate
thread: if the terminal hangs, no key arrives and the motors stop. The screen consists of lines of characters.
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
from khep_twin.robots.registry import default_model
from khep_twin.units import CONVERTER_COUNTS_PER_VOLT, N_SENSORS, SENSOR_LABELS, speed

FIRST_HOLD = 0.7
"""Driving time of a first press [s]: most keyboards wait 0.25 to 0.66 s before they repeat a key."""

REPEAT_HOLD = 0.25
"""Driving time of each repeat [s]: keys are repeated each 0.03 to 0.1 s, later over a slow network."""

FASTEST = 40
"""Highest speed of teleoperation [pulses/10 ms]: 320 mm/s."""

TIMEOUT = 0.6
"""Time-out of a reply [s]."""

_BARS = default_model().bars
_CYCLE = 0.05
"""Shortest cycle of the loop [s]."""
_SUPPLY_INTERVAL = 5.0
"""Shortest time between two readings of the supply voltage [s]."""

_NO_SPEED = Speeds(0, 0)
_NO_COUNTS = SensorCounts(*(0,) * N_SENSORS)

_LEDS = ((0, 0), (1, 0), (0, 1), (1, 1))
"""States of the lateral and the frontal LED, in the order of switching."""


class Direction(Enum):
    """Direction of driving: factors of the left and right wheel's speed. Turns have half the speed."""

    STOP = (0.0, 0.0)
    FORWARD = (1.0, 1.0)
    BACK = (-1.0, -1.0)
    LEFT = (-0.5, 0.5)
    RIGHT = (0.5, -0.5)

    def speeds(self, speed: int) -> Speeds:
        """Return the wheels' speeds [pulses/10 ms]; a wheel that turns has a speed of at least 1."""
        return Speeds(*(_round_away_from_zero(factor * speed) for factor in self.value))


@dataclass(frozen=True, slots=True)
class DriveState:
    """State of a teleoperated robot.

    Attributes:
        speed: Selected speed of the wheels [pulses/10 ms].
        direction: Direction of driving.
        measured: Measured speeds of the wheels [pulses/10 ms].
        proximity: Proximity readings [counts].
        ambient: Ambient readings [counts].
        leds: Last commands to the lateral and the frontal LED, 0 off or 1 on.
        supply: Supply voltage [V]; None if the robot does not report it.
        lost: Number of missing or invalid replies.
    """

    speed: int
    direction: Direction = Direction.STOP
    measured: Speeds = _NO_SPEED
    proximity: SensorCounts = _NO_COUNTS
    ambient: SensorCounts = _NO_COUNTS
    leds: tuple[int, int] = (0, 0)
    supply: float | None = None
    lost: int = 0


class DeadManSwitch:
    """Dead-man's switch: a key press drives for a short time, and its repetitions prolong it."""

    def __init__(self) -> None:
        self._direction = Direction.STOP
        self._release_time = 0.0

    def press(self, direction: Direction, now: float) -> None:
        """Handle the press or repetition of a key at this time [s]."""
        is_repeated = direction is self.direction(now)
        self._direction, self._release_time = direction, now + (REPEAT_HOLD if is_repeated else FIRST_HOLD)

    def direction(self, now: float) -> Direction:
        """Return the direction of driving at this time [s]."""
        return self._direction if now < self._release_time else Direction.STOP


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
        self._state = DriveState(speed)
        self._sent_speeds: Speeds | None = None
        self._leds = _LEDS[0]
        self._sent_leds: tuple[int, int] | None = None
        self._supply_time: float | None = now()
        self._was_unanswered = False

    # From any thread -----------------------------------------------------------------------------------

    @property
    def state(self) -> DriveState:
        """Latest state."""
        with self._lock:
            return self._state

    def press(self, direction: Direction) -> None:
        """Handle the press or repetition of a direction's key; STOP stops."""
        with self._lock:
            self._switch.press(direction, self._now())
        self._wake.set()

    def set_speed(self, speed: int) -> None:
        """Set the speed, 1 to FASTEST [pulses/10 ms]."""
        self._update(speed=min(max(speed, 1), FASTEST))

    def switch_leds(self) -> None:
        """Switch the LEDs to the next state: none, lateral, frontal, both, none."""
        with self._lock:
            self._leds = _LEDS[(_LEDS.index(self._leds) + 1) % len(_LEDS)]
        self._wake.set()

    # The robot's thread --------------------------------------------------------------------------------

    def run(self, stop: Callable[[], bool]) -> None:
        """Drive until `stop` returns true, then stop the motors.

        Raises:
            PortError: The connection is lost.
        """
        is_simulated = hasattr(self._robot.port, "time_ns")
        try:
            while not stop():
                start, robot_start = self._now(), self._robot.time
                self.cycle()
                self._wake.wait(max(_CYCLE - (self._now() - start), 0.0))
                self._wake.clear()
                if is_simulated:
                    # Simulated time advances only while the host waits; keep it in step with the wall clock.
                    lag = (self._now() - start) - (self._robot.time - robot_start)
                    self._robot.sleep(lag) if lag > 0 else time.sleep(-lag)
        finally:
            self._robot.set_speed(0, 0)

    def cycle(self) -> None:
        """Send the commands that the keys request, and read the sensors.

        Raises:
            PortError: The connection is lost, or two cycles in a row got no reply.
        """
        with self._lock:
            direction, leds, state = self._switch.direction(self._now()), self._leds, self._state
        speeds = direction.speeds(state.speed)
        batch: list[HostCommand[object]] = (
            [commands.set_speed(*speeds)] if speeds != self._sent_speeds else []
        )
        if leds != self._sent_leds:
            batch += [commands.set_led(led, action) for led, action in enumerate(leds)]
        try:
            *_, proximity, ambient, measured = self._robot.burst(
                *batch, commands.proximity(), commands.ambient(), commands.speed()
            )
        except (PortTimeout, ProtocolError):
            # The robot may have missed any command; the next cycle sends all of them again.
            self._sent_speeds = self._sent_leds = None
            self._update(lost=state.lost + 1)
            if self._was_unanswered:
                raise
            self._was_unanswered = True
            return
        self._was_unanswered = False
        self._sent_speeds, self._sent_leds = speeds, leds
        self._update(direction=direction, leds=leds, proximity=proximity, ambient=ambient, measured=measured)
        if self._supply_time is not None and direction is Direction.STOP and self._now() >= self._supply_time:
            self._read_supply()

    def _read_supply(self) -> None:
        """Read the supply voltage, twice that of the converter's channel 0; stop asking after a refusal."""
        self._supply_time = self._now() + _SUPPLY_INTERVAL
        try:
            counts = self._robot.converter(0)
        except ProtocolError:
            self._supply_time = None
        else:
            self._update(supply=2 * counts / CONVERTER_COUNTS_PER_VOLT)

    def _update(self, **changes: Any) -> None:
        with self._lock:
            self._state = replace(self._state, **changes)


def _round_away_from_zero(value: float) -> int:
    """Round to the nearest integer, halves away from 0."""
    return int(value + 0.5) if value >= 0 else -int(-value + 0.5)


WIDTH, HEIGHT = 64, 18
"""Size of the smallest terminal [characters]."""

_LABEL_WIDTH, _COUNTS_WIDTH, _GAP_WIDTH = 12, 5, 3  # [characters]
_ON_OFF = ("off", "on")

KEYS = (
    "arrows or WASD drive while held   space stops   q ends",
    "+ - or 1 to 9 choose the speed    L switches the LEDs",
)


def draw(state: DriveState, name: str, width: int, height: int) -> list[str]:
    """Return the lines of the screen, of at most `width` characters."""
    if width < WIDTH or height < HEIGHT:
        line = f"{width} x {height} characters; expected at least {WIDTH} x {HEIGHT}; q ends"
        return [line[: max(width - 1, 0)]]
    bar_width = (width - _LABEL_WIDTH - 2 * _COUNTS_WIDTH - _GAP_WIDTH - 1) // 2
    left, right = (1e3 * speed(pulses) for pulses in state.measured)
    supply = "" if state.supply is None else f"   supply about {state.supply:.1f} V"
    lost = f"   {state.lost} replies lost" if state.lost else ""
    column_width = bar_width + _COUNTS_WIDTH + _GAP_WIDTH
    lines = [
        f"khep-twin drive  {name}",
        "",
        f"{'':{_LABEL_WIDTH}}{'proximity':{column_width}}{_BARS['light'].legend}",
        *(
            f"{sensor:{_LABEL_WIDTH}}"
            f"{_draw_bar('proximity', proximity, bar_width)}{proximity:{_COUNTS_WIDTH}}{'':{_GAP_WIDTH}}"
            f"{_draw_bar('light', ambient, bar_width)}{ambient:{_COUNTS_WIDTH}}"
            for sensor, proximity, ambient in zip(SENSOR_LABELS, state.proximity, state.ambient, strict=True)
        ),
        "",
        f"{'wheels':{_LABEL_WIDTH}}left {state.measured.left:4}  right {state.measured.right:4} pulses/10 ms"
        f"   ({left:.0f}, {right:.0f} mm/s)",
        f"{'drives':{_LABEL_WIDTH}}{state.direction.name.lower()}, speed {state.speed}{lost}",
        f"{'LEDs':{_LABEL_WIDTH}}lateral {_ON_OFF[state.leds[0]]:3}  frontal {_ON_OFF[state.leds[1]]:3}"
        f"{supply}",
        "",
        *KEYS,
    ]
    return [line[: width - 1] for line in lines]


def _draw_bar(name: str, value: float, width: int) -> str:
    """Return a bar of `width` characters, filled in proportion to a reading of a quantity in `_BARS`."""
    n_filled = round(_BARS[name].filled_part(value) * width)
    return "#" * n_filled + "." * (width - n_filled)
