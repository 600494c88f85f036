"""Sensor tests: a robot drives straight or turns on the spot while its sensors are read.

    dv = (left, right position counter, left 90, left 45, ... back left), a row for each reading

A reading is a reply to H and one to N or O, or to T,2,N, with 64 pixels instead of the sensors. The
counters are older by the duration of the second exchange, some 20 ms at 9600 baud (200 ms for an image): 3 mm
at speed 20, and 0.5 mm at speed 4. The counters measure the wheels' motion, including slip at a wall.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from functools import partial
from numbers import Integral
from operator import attrgetter
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from khep_twin.errors import KhepTwinError, SensorTestError
from khep_twin.host import Khepera, Vision
from khep_twin.host.host_robot import HostRobot
from khep_twin.log.decoding import printable
from khep_twin.robots.model import Feature
from khep_twin.robots.registry import default_model, find_family
from khep_twin.units import COUNTS_LIMIT, K213_PIXELS, PULSE_LENGTH, SENSOR_LABELS, WHEEL_BASE

QuantityName = Literal["proximity", "light", "vision"]
"""Name of a quantity: the key "what" in files, and the option --what."""


class Quantity(NamedTuple):
    """Quantity that is measured.

    Attributes:
        names: Names of the sensors or pixels, in the order of the reply.
        topic: Channel in logs.
        title: Name and unit of a reading.
        limit: Largest reading.
        lowest: Smallest reading.
        reader: Function that takes a robot and returns the function that reads all sensors.
    """

    names: tuple[str, ...]
    topic: str
    title: str
    limit: int
    reader: Callable[[Any], Callable[[], Sequence[int]]]
    lowest: int = 0


def _image_reader(robot: Khepera) -> Callable[[], Sequence[int]]:
    return Vision(robot).image


def _channel_reader(channel: str, robot: HostRobot) -> Callable[[], Sequence[int]]:
    return lambda: robot.read_channels(channel)[channel]


QUANTITIES: Mapping[QuantityName, Quantity] = {
    "proximity": Quantity(
        SENSOR_LABELS, "proximity", "proximity [counts]", COUNTS_LIMIT, attrgetter("proximity")
    ),
    "light": Quantity(SENSOR_LABELS, "ambient", "ambient [counts]", COUNTS_LIMIT, attrgetter("ambient")),
    "vision": Quantity(
        tuple(f"pixel {pixel}" for pixel in range(K213_PIXELS)),
        "vision",
        "line image [greys]",
        255,
        _image_reader,
    ),
}
"""Quantities by name."""

DEFAULT_SPEED, DEFAULT_ACCELERATION = 20, 64
"""Values of command J after a reset (manual, appendix A)."""

DEFAULT_SPEED_UNIT, CREEP_SPEED = PULSE_LENGTH / 0.01, 0.01
"""Unit of a test's speed, and lowest speed of a drive by speeds [m/s]."""

_SLOWING_S, _SETTLING_S = 0.5, 0.1
"""Time in which the rest of a way is driven at the present speed; time at the lowest one to a stop [s]."""

PAUSE = 5.0
"""Pause before the drive back [s], as in the Khepera Toolbox."""

BLOCK_TIME = 2.0
"""Time without progress to its target after which a wheel counts as blocked [s]."""

PULSES_PER_CM = 0.01 / PULSE_LENGTH
PULSES_PER_DEGREE = math.radians(1) * WHEEL_BASE / 2 / PULSE_LENGTH

_TOLERANCE_PULSES = 2
"""Largest decrease of a wheel's distance to its target that is not progress [pulses]."""
_DETECTION_COUNTS = 50
"""Proximity below which no object is detected [counts], far above the noise of the converter."""
_LAMP_COUNTS = 40
"""Smallest difference of ambient counts due to a lamp; smaller ones are noise and sensor tolerance."""
_NEAR_PULSES = 10
"""Distance to the target below which the status is read [pulses]; it takes the time of a reading."""


def check_quantity(name: str) -> QuantityName:
    """Return the name of a quantity.

    Raises:
        SensorTestError: The name is unknown.
    """
    for quantity in QUANTITIES:
        if name == quantity:
            return quantity
    setting = f"what = {printable(name)}"
    raise SensorTestError(setting, key="what", value=name, expected="proximity, light or vision")


@dataclass(frozen=True, slots=True)
class SensorTest:
    """Motion and readings of a test, with either `linear_cm` or `rotate_deg`.

    Attributes:
        what: Quantity to read, "proximity", "light" or "vision".
        linear_cm: Distance forwards, 5 to 60, or backwards, -5 to -60 [cm].
        rotate_deg: Turn on the spot, 15 to 360 counter-clockwise, or -15 to -360 [degrees].
        speed: Speed of command J, 1 to 127 [pulses/10 ms]; None if unknown.
        acceleration: Acceleration of command J, 1 to 255 [3.125 mm/s^2]; None if unknown.
        return_to_zero: True if the robot drives back afterwards.
        model: Model of the robot, or its family.
    """

    what: QuantityName = "proximity"
    linear_cm: float | None = None
    rotate_deg: float | None = None
    speed: int | None = DEFAULT_SPEED
    acceleration: int | None = DEFAULT_ACCELERATION
    return_to_zero: bool = False
    model: str = default_model().family

    def __post_init__(self) -> None:
        """Raise a `SensorTestError` if a value is out of range, or there is not exactly one motion."""
        check_quantity(self.what)
        if self.what == "vision" and Feature.TURRETS not in find_family(self.model).features:
            raise SensorTestError(f"what = 'vision': model = {self.model!r}; expected proximity or light")
        if (self.linear_cm is None) == (self.rotate_deg is None):
            number = "none" if self.linear_cm is None else "both"
            raise SensorTestError(f"linear and rotate: {number} given; expected one of them")
        if self.linear_cm is not None and not 5 <= abs(self.linear_cm) <= 60:
            raise SensorTestError(
                f"linear = {self.linear_cm:g} cm; expected 5 to 60, or -5 to -60 to drive backwards"
            )
        if self.rotate_deg is not None and not 15 <= abs(self.rotate_deg) <= 360:
            raise SensorTestError(
                f"rotate = {self.rotate_deg:g} degrees; expected 15 to 360, or -15 to -360 for clockwise"
            )
        for name, value, limit in (("speed", self.speed, 127), ("acceleration", self.acceleration, 255)):
            if value is not None and not (isinstance(value, Integral) and 1 <= value <= limit):
                raise SensorTestError(key=name, value=value, expected=f"an integer from 1 to {limit}")

    @property
    def quantity(self) -> Quantity:
        """Quantity that is measured."""
        quantity, model = QUANTITIES[self.what], find_family(self.model)
        if model.family == default_model().family:
            return quantity
        limit, reader = model.bars["proximity"].full, partial(_channel_reader, quantity.topic)
        # Proximity may be reflected less ambient light, with a sign.
        lowest = -limit if self.what == "proximity" else 0
        return quantity._replace(names=model.body.sensors, limit=limit, reader=reader, lowest=lowest)

    @property
    def pulses_per_unit(self) -> float:
        """Pulses of a wheel per centimetre or degree, by the kind of motion."""
        body = find_family(self.model).body
        distance = math.radians(1) * body.wheel_base / 2 if self.linear_cm is None else 0.01
        return distance / body.pulse_length

    @property
    def motion(self) -> Literal["linear", "rotational"]:
        """Kind of motion."""
        return "rotational" if self.linear_cm is None else "linear"

    @property
    def amount(self) -> float:
        """Distance [cm] or angle [degrees], by the kind of motion."""
        return (self.rotate_deg or 0.0) if self.linear_cm is None else self.linear_cm

    @property
    def unit(self) -> Literal["cm", "degrees"]:
        """Unit of `amount`."""
        return "degrees" if self.linear_cm is None else "cm"

    @property
    def target(self) -> tuple[int, int]:
        """Targets of the left and the right wheel [pulses]."""
        pulses = round(self.amount * self.pulses_per_unit)
        return (pulses, pulses) if self.motion == "linear" else (-pulses, pulses)


@dataclass(frozen=True, slots=True, eq=False)
class SensorRun:
    """Data of a test.

    Attributes:
        test: Settings of the test.
        dv: Left and right position counter [pulses] and the sensors in the order of the channel [counts]
            (n, 10), named and ordered as in the Khepera Toolbox; or the counters and 64 pixels (n, 66).
        times: Times of the rows since the start (n,) [s].
        text: Description, the toolbox's dlgstr.
    """

    test: SensorTest
    dv: NDArray[np.int64]
    times: NDArray[np.float64]
    text: str = ""

    def __post_init__(self) -> None:
        """Check the shapes; raise a `SensorTestError` for impossible values and unprintable text."""
        width = 2 + len(self.test.quantity.names)
        if self.dv.shape != (len(self.times), width) or self.times.ndim != 1:
            raise ValueError(f"shapes {self.dv.shape} and {self.times.shape}; expected (n, {width}) and (n,)")
        lowest, limit = self.test.quantity.lowest, self.test.quantity.limit
        is_invalid = (self.dv[:, 2:] < lowest) | (self.dv[:, 2:] > limit)
        if is_invalid.any():
            row, column = (int(indices[0]) for indices in np.nonzero(is_invalid))
            name, count = self.test.quantity.names[column], self.dv[row, 2 + column]
            raise SensorTestError(f"row {row + 1}: {name} = {count}; expected {lowest} to {limit}")
        if not np.isnan(self.times).all():
            is_unordered = ~np.isfinite(self.times) | (np.diff(self.times, prepend=0.0) < 0)
            if is_unordered.any():
                row = int(np.argmax(is_unordered))
                expected = "a time from 0 that is not before that of the row above, or nan in all rows"
                raise SensorTestError(f"row {row + 1}: time = {self.times[row]:g} s; expected {expected}")
        if symbol := next((char for char in self.text if not char.isprintable() and char not in "\n\t"), ""):
            raise SensorTestError(f"text: has the character {symbol!r}; expected plain text in lines")

    @property
    def travelled(self) -> NDArray[np.float64]:
        """Distance from the start in each row (n,), by the counters [cm or degrees]."""
        left, right = self.dv[:, 0], self.dv[:, 1]
        sum_of_both = left + right if self.test.motion == "linear" else right - left
        return sum_of_both / 2 / self.test.pulses_per_unit

    @property
    def warning(self) -> str:
        """Warning if the sensors have detected nothing; empty otherwise."""
        counts = self.dv[:, 2:]
        if not counts.size:
            return ""
        low, high = int(counts.min()), int(counts.max())
        if self.test.what == "proximity" and high < _DETECTION_COUNTS:
            return (
                f"Nothing was within reach: no proximity count is above {high}. Expected an object within "
                "a few cm of the robot's path."
            )
        if self.test.what == "light" and high - low < _LAMP_COUNTS:
            return (
                f"No lamp was within reach: all ambient counts are {low} to {high}. Expected a lamp that the "
                "sensors face on the path."
            )
        return ""


class BrokenOffError(SensorTestError):
    """Error that ended a test early; `run` has the data before it."""

    def __init__(self, message: str, run: SensorRun) -> None:
        super().__init__(message)
        self.run = run


class InterruptedTest(KeyboardInterrupt):
    """Ctrl-C during a test; `run` has the data before it."""

    def __init__(self, run: SensorRun) -> None:
        super().__init__(f"the test was interrupted after {len(run.dv)} rows")
        self.run = run


def sense(
    robot: HostRobot,
    test: SensorTest,
    *,
    text: str = "",
    progress: Callable[[float], None] | None = None,
    stop: Callable[[], bool] | None = None,
) -> SensorRun:
    """Run a test. The motors are stopped afterwards, even after an error.

    A Khepera drives by its position profile, robots of other models by speeds, which fall towards the target.

    Args:
        robot: Robot to drive, of the test's model; a Khepera's position counters are set to 0.
        test: Settings of the test.
        text: Description that is stored with the data.
        progress: Called with the completed fraction of the path, 0 to 1.
        stop: Called before each reading; returns whether to end early, with the rows so far.

    Raises:
        BrokenOffError: A wheel is blocked, or the port failed; its `run` has the rows so far.
        InterruptedTest: Ctrl-C was pressed; likewise.
        SensorTestError: The text cannot be stored.
    """
    recorder = _RowRecorder(robot, test, text, progress, test.quantity.reader(robot))
    recorder.run()
    should_stop = stop or (lambda: False)
    try:
        drive = prepare_drive(robot, test.speed or DEFAULT_SPEED, test.acceleration or DEFAULT_ACCELERATION)
        if drive(test.target, recorder.add_row, should_stop) and test.return_to_zero:
            _drive_back(robot, drive, should_stop)
        reset_motors(robot)
    except BaseException as error:
        # A further error while stopping the motors would hide the first one.
        with suppress(KhepTwinError):
            reset_motors(robot)
        if isinstance(error, KhepTwinError):
            raise BrokenOffError(f"{recorder.summary}: {error}", recorder.run()) from error
        if isinstance(error, KeyboardInterrupt):
            raise InterruptedTest(recorder.run()) from None
        raise
    return recorder.run()


@dataclass(slots=True)
class _RowRecorder:
    """Rows of a running test."""

    robot: HostRobot
    test: SensorTest
    text: str
    progress: Callable[[float], None] | None
    read: Callable[[], Sequence[int]]
    rows: list[tuple[int, ...]] = field(default_factory=list[tuple[int, ...]])
    times: list[float] = field(default_factory=list[float])
    start: float | None = None

    def add_row(self, position: tuple[int, int]) -> None:
        """Add a row, with counters that were just read."""
        if self.start is None:
            self.start = self.robot.time
        # A log stores whole nanoseconds.
        time = round(self.robot.time - self.start, 9)
        values = self.read()
        self.times.append(time)
        self.rows.append((*position, *values))
        if self.progress is not None:
            fraction = sum(map(abs, position)) / sum(map(abs, self.test.target))
            self.progress(min(fraction, 1.0))

    def run(self) -> SensorRun:
        """Return the data so far."""
        dv = np.array(self.rows, np.int64).reshape(len(self.rows), 2 + len(self.test.quantity.names))
        return SensorRun(self.test, dv, np.array(self.times, np.float64), self.text)

    @property
    def summary(self) -> str:
        """Description of the progress of the test."""
        travelled = self.run().travelled[-1] if self.rows else 0.0
        return f"the test broke off after {travelled:.1f} of {self.test.amount:g} {self.test.unit}"


def prepare_drive(robot: HostRobot, speed: int, acceleration: int) -> Callable[..., bool]:
    """Return the function that drives a robot to a target, which counts from here, as `drive_to` does."""
    if not isinstance(robot, Khepera):
        return SpeedDrive(robot, speed)
    robot.set_position(0, 0)
    robot.configure_profile(speed, acceleration, speed, acceleration)
    return partial(drive_to, robot)


def drive_to(
    robot: Khepera,
    target: tuple[int, int],
    on_position: Callable[[tuple[int, int]], None] | None,
    stop: Callable[[], bool],
) -> bool:
    """Send the wheels to a target and read the sensors meanwhile; return whether the target is reached."""
    robot.set_target(*target)
    min_distances, last_progress = [math.inf, math.inf], [robot.time] * 2
    while not stop():
        position = robot.position()
        if on_position is not None:
            on_position(position)
        distances = [abs(end - count) for end, count in zip(target, position, strict=True)]
        is_nearer = [new < old - _TOLERANCE_PULSES for new, old in zip(distances, min_distances, strict=True)]
        for wheel in (0, 1):
            if is_nearer[wheel]:
                min_distances[wheel], last_progress[wheel] = distances[wheel], robot.time
        if all(is_nearer) and max(distances) > _NEAR_PULSES:
            continue
        status = robot.status()
        if all(wheel.on_target for wheel in status):
            if on_position is not None:
                on_position(robot.position())
            return True
        for wheel, name in enumerate(("left", "right")):
            if not status[wheel].on_target and robot.time - last_progress[wheel] > BLOCK_TIME:
                raise SensorTestError(
                    f"the {name} wheel made no progress for {BLOCK_TIME:g} s, {position[wheel]} of "
                    f"{target[wheel]} pulses; expected a free path"
                )
    return False


class SpeedDrive:
    """Drives of a robot of any model, by speeds that fall towards the target.

    Args:
        robot: Robot, whose positions count from here.
        speed: Highest speed [8 mm/s].
    """

    def __init__(self, robot: HostRobot, speed: int) -> None:
        self._robot = robot
        body = robot.model.body
        self._top_pulses = speed * DEFAULT_SPEED_UNIT / body.pulse_length  # [1/s]
        self._scale = robot.model.episode_interface.speed_per_pulse * 0.01
        self._start = self._read()

    def __call__(
        self,
        target: tuple[int, int],
        on_position: Callable[[tuple[int, int]], None] | None,
        stop: Callable[[], bool],
    ) -> bool:
        """Drive to a target [pulses], as `drive_to`."""
        robot, best, last_progress = self._robot, math.inf, self._robot.time
        creep = CREEP_SPEED / robot.model.body.pulse_length
        tolerance = max(1.0, creep * _SETTLING_S)
        while not stop():
            left, right = (now - start for now, start in zip(self._read(), self._start, strict=True))
            if on_position is not None:
                on_position((left, right))
            remaining = target[0] - left, target[1] - right
            if (distance := max(map(abs, remaining))) <= tolerance:
                robot.stop()
                return True
            if distance < best - tolerance:
                best, last_progress = distance, robot.time
            if robot.time - last_progress > BLOCK_TIME:
                way = f"at ({left}, {right}) of {target} pulses"
                raise SensorTestError(f"no progress for {BLOCK_TIME:g} s, {way}; expected a free path")
            speed = min(max(distance / _SLOWING_S, creep), self._top_pulses)
            robot.set_setpoints(*(round(speed * part / distance * self._scale) for part in remaining))
        return False

    def _read(self) -> list[int]:
        return self._robot.read_channels("position")["position"][:2]


def _drive_back(robot: HostRobot, drive: Callable[..., bool], stop: Callable[[], bool]) -> None:
    end = robot.time + PAUSE
    while robot.time < end and not stop():
        robot.sleep(0.1)
    try:
        drive((0, 0), None, stop)
    except SensorTestError as error:
        raise SensorTestError(f"on the return {error}") from None


def reset_motors(robot: HostRobot) -> None:
    """Stop the motors and set a Khepera's values of command J to those of a reset."""
    robot.stop()
    if isinstance(robot, Khepera):
        robot.configure_profile(DEFAULT_SPEED, DEFAULT_ACCELERATION, DEFAULT_SPEED, DEFAULT_ACCELERATION)
