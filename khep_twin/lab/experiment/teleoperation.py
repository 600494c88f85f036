"""Teleoperation: a loop that drives a robot by keys and reads its sensors.

It has a dead-man's switch. A terminal reports that a key is pressed, and repeats it while it is held, but
never reports its release. So each press drives the robot for a short time only. The loop runs in a separate
thread: if the terminal hangs, no key arrives and the motors stop. The screen consists of lines of characters.
"""

import threading
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from enum import Enum
from typing import Any

from khep_twin.errors import PortTimeout, ProtocolError
from khep_twin.host.host_robot import HostRobot
from khep_twin.robots.model import Bar, RobotModel

FIRST_HOLD = 0.7
"""Driving time of a first press [s]: most keyboards wait 0.25 to 0.66 s before they repeat a key."""

REPEAT_HOLD = 0.25
"""Driving time of each repeat [s]: keys are repeated each 0.03 to 0.1 s, later over a slow network."""

FASTEST, N_STEPS = 40, 20
"""Highest speed of teleoperation, and the top speed of tasks (`Interface.top_speed`) [steps]: 40 steps are
a Khepera's 320 mm/s."""

TIMEOUT = 0.6
"""Time-out of a reply [s]."""

_CYCLE = 0.05
"""Shortest cycle of the loop [s]."""
_SUPPLY_INTERVAL = 5.0
"""Shortest time between two readings of the supply voltage [s]."""


class Direction(Enum):
    """Direction of driving: factors of the left and right wheel's speed. Turns have half the speed."""

    STOP = (0.0, 0.0)
    FORWARD = (1.0, 1.0)
    BACK = (-1.0, -1.0)
    LEFT = (-0.5, 0.5)
    RIGHT = (0.5, -0.5)

    def speeds(self, speed: int) -> tuple[int, int]:
        """Return the wheels' speeds [steps]; a wheel that turns has a speed of at least 1."""
        left, right = (_round_away_from_zero(factor * speed) for factor in self.value)
        return left, right


@dataclass(frozen=True, slots=True)
class DriveState:
    """State of a teleoperated robot.

    Attributes:
        model: Model of the robot.
        speed: Selected speed of the wheels [steps].
        direction: Direction of driving.
        measured: Measured speeds of the wheels [register].
        proximity: Proximity readings [counts].
        ambient: Ambient readings [counts].
        leds: Whether each LED is lit.
        supply: Supply voltage [V]; None if the robot does not report it.
        lost: Number of missing or invalid replies.
    """

    model: RobotModel
    speed: int
    direction: Direction = Direction.STOP
    measured: tuple[int, int] = (0, 0)
    proximity: Sequence[int] = ()
    ambient: Sequence[int] = ()
    leds: Mapping[str, bool] = field(default_factory=dict[str, bool])
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
        speed: Initial speed [steps].
        now: Wall clock [s].
    """

    def __init__(self, robot: HostRobot, speed: int, now: Callable[[], float] = time.monotonic) -> None:
        self._robot = robot
        self._now = now
        self._lock = threading.Lock()
        self._wake = threading.Event()
        self._switch = DeadManSwitch()
        self._interface = robot.model.episode_interface
        self._n_led_states = 2 ** len(robot.leds)
        n_sensors = len(robot.model.body.sensors)
        zeros, leds = (0,) * n_sensors, dict.fromkeys(robot.leds, False)
        self._state = DriveState(robot.model, speed, proximity=zeros, ambient=zeros, leds=leds)
        self._sent_speeds: tuple[int, int] | None = None
        self._led_state = 0
        self._sent_led_state: int | None = None
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
        """Set the speed, 1 to FASTEST [steps]."""
        self._update(speed=min(max(speed, 1), FASTEST))

    def switch_leds(self) -> None:
        """Switch the LEDs to the next state: none, the first, the second, both, and so on."""
        with self._lock:
            self._led_state = (self._led_state + 1) % self._n_led_states
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
            self._robot.stop()

    def cycle(self) -> None:
        """Send the commands that the keys request, and read the sensors.

        Raises:
            PortError: The connection is lost, or two cycles in a row got no reply.
        """
        with self._lock:
            direction, led_state, state = self._switch.direction(self._now()), self._led_state, self._state
        step = self._interface.top_speed / N_STEPS
        left, right = (round(step * speed) for speed in direction.speeds(state.speed))
        are_lit = [bool(led_state >> number & 1) for number in range(len(self._robot.leds))]
        try:
            if (left, right) != self._sent_speeds:
                self._robot.set_setpoints(left, right)
                self._sent_speeds = left, right
            if led_state != self._sent_led_state:
                self._robot.light_leds(are_lit)
                self._sent_led_state = led_state
            panel = self._robot.read_panel()
        except (PortTimeout, ProtocolError):
            # The robot may have missed any command; the next cycle sends all of them again.
            self._sent_speeds = self._sent_led_state = None
            self._update(lost=state.lost + 1)
            if self._was_unanswered:
                raise
            self._was_unanswered = True
            return
        self._was_unanswered = False
        self._update(
            direction=direction,
            leds=dict(zip(self._robot.leds, are_lit, strict=True)),
            proximity=panel["proximity"],
            ambient=panel["ambient"],
            measured=(panel["speed"][0], panel["speed"][1]),
        )
        if self._supply_time is not None and direction is Direction.STOP and self._now() >= self._supply_time:
            self._read_supply()

    def _read_supply(self) -> None:
        """Read the supply voltage; stop asking after a refusal."""
        self._supply_time = self._now() + _SUPPLY_INTERVAL
        try:
            supply = self._robot.supply_voltage()
        except ProtocolError:
            supply = None
        if supply is None:
            self._supply_time = None
        else:
            self._update(supply=supply)

    def _update(self, **changes: Any) -> None:
        with self._lock:
            self._state = replace(self._state, **changes)


def _round_away_from_zero(value: float) -> int:
    """Round to the nearest integer, halves away from 0."""
    return int(value + 0.5) if value >= 0 else -int(-value + 0.5)


WIDTH, _N_FIXED_LINES = 64, 10
"""Width of the smallest terminal [characters], and the number of lines besides those of the sensors."""

_LABEL_WIDTH, _COUNTS_WIDTH, _GAP_WIDTH = 12, 5, 3  # [characters]

KEYS = (
    "arrows or WASD drive while held   space stops   q ends",
    "+ - or 1 to 9 choose the speed    L switches the LEDs",
)


def draw(state: DriveState, name: str, width: int, height: int) -> list[str]:
    """Return the lines of the screen, of at most `width` characters."""
    model, bars, interface = state.model, state.model.bars, state.model.episode_interface
    least_height = len(state.proximity) + _N_FIXED_LINES
    if width < WIDTH or height < least_height:
        line = f"{width} x {height} characters; expected at least {WIDTH} x {least_height}; q ends"
        return [line[: max(width - 1, 0)]]
    speeds = [1e5 * model.body.pulse_length * speed / interface.speed_per_pulse for speed in state.measured]
    unit = model.channels["speed"][0][1]
    label_width = max(_LABEL_WIDTH, *(len(sensor) + 1 for sensor in model.body.sensors))
    bar_width = (width - label_width - 2 * _COUNTS_WIDTH - _GAP_WIDTH - 1) // 2
    supply = "" if state.supply is None else f"   supply about {state.supply:.1f} V"
    lost = f"   {state.lost} replies lost" if state.lost else ""
    column_width = bar_width + _COUNTS_WIDTH + _GAP_WIDTH
    leds = "  ".join(f"{name} {'on' if is_lit else 'off':3}" for name, is_lit in state.leds.items())
    lines = [
        f"khep-twin drive  {name}",
        "",
        f"{'':{label_width}}{'proximity':{column_width}}{bars['light'].legend}",
        *(
            f"{sensor:{label_width}}"
            f"{_draw_bar(bars['proximity'], counts, bar_width)}{counts:{_COUNTS_WIDTH}}{'':{_GAP_WIDTH}}"
            f"{_draw_bar(bars['light'], ambient, bar_width)}{ambient:{_COUNTS_WIDTH}}"
            for sensor, counts, ambient in zip(
                model.body.sensors, state.proximity, state.ambient, strict=True
            )
        ),
        "",
        f"{'wheels':{label_width}}left {state.measured[0]:4}  right {state.measured[1]:4} {unit}"
        f"   ({speeds[0]:.0f}, {speeds[1]:.0f} mm/s)",
        f"{'drives':{label_width}}{state.direction.name.lower()}, speed {state.speed}{lost}",
        f"{'LEDs':{label_width}}{leds or 'none'}{supply}",
        "",
        *KEYS,
    ]
    return [line[: width - 1] for line in lines]


def _draw_bar(bar: Bar, value: float, width: int) -> str:
    """Return a bar of `width` characters, filled in proportion to a reading."""
    n_filled = round(bar.filled_part(value) * width)
    return "#" * n_filled + "." * (width - n_filled)
