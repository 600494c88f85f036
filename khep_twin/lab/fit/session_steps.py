"""Steps of a calibration session: the instruction to the person, and the recording of the robot.

    straight                 command C over 60 cm, measured with a ruler     straight.mcap
    turns                    command C, five turns on the spot, counted      turns.mcap
    duty                     steps of command P on open floor                duty.mcap
    wall, cylinder, lamp     a sensor test, one turn on the spot             wall-12.csv

A word is a recording's name and a measurement, such as straight.mcap=598mm, in the form of `fit_inputs`.
"""

import math
from collections.abc import Callable, Generator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

from khep_twin.clock import NS_PER_S
from khep_twin.errors import FitError
from khep_twin.host import Khepera
from khep_twin.lab.fit.fit_inputs import FILAMENT_MM
from khep_twin.lab.sensor_test.sensor_files import save
from khep_twin.lab.sensor_test.sensor_test import SensorTest, drive_to, reset_motors, sense
from khep_twin.log.line_recorder import LineRecorder
from khep_twin.units import BITS_PER_BYTE, PULSE_LENGTH, WHEEL_BASE

STRAIGHT_MM, TURNS = 600, 5
"""Nominal length of the straight drive [mm], and number of turns on the spot."""

WALLS_MM = (6.0, 12.0, 17.0, 21.0, 25.0, 29.0)
CYLINDERS_MM = (6.0, 12.0, 18.0)
LAMPS_MM = (60.0, 150.0)
"""Distances of objects from the robot's edge [mm], at which its readings are not clipped."""

DUTIES = (40, 0, -40, 0, 30, -10, 0)
_DUTY_S = 0.75
"""Steps of duty, and the duration of each [s]."""
_SPEED, _ACCELERATION = 10, 32
"""Values of command J on measured drives [pulses/10 ms, 3.125 mm/s^2]: slow, so that no tyre slips."""

_SETTLE_S = 0.5
"""Settling time after a drive [s]."""


@dataclass(frozen=True, slots=True)
class Step:
    """Test of a session.

    Attributes:
        kind: Kind of the test.
        distance_mm: Distance from the robot's edge to the object [mm].
        radius_mm: Radius of the cylinder [mm].
        power_w: Power of the lamp [W].
        height_mm: Height of the lamp's filament above the floor [mm].
        sign: Direction of the turn, 1 for counter-clockwise.
    """

    kind: Literal["straight", "turns", "duty", "wall", "cylinder", "lamp"]
    distance_mm: float = 0.0
    radius_mm: float = 0.0
    power_w: float = 0.0
    height_mm: float = FILAMENT_MM
    sign: int = 1

    @property
    def has_object(self) -> bool:
        """True if an object stands in front of the robot."""
        return self.kind in ("wall", "cylinder", "lamp")

    @property
    def file_name(self) -> str:
        """Name of the recording."""
        return f"{self.kind}-{self.distance_mm:g}.csv" if self.has_object else f"{self.kind}.mcap"

    @property
    def instruction(self) -> str:
        """Instruction to the person."""
        near = f"its front {self.distance_mm:g} mm from"
        return {
            "straight": f"Put the robot on open floor with {STRAIGHT_MM + 100} mm free ahead, and mark where "
            "it stands. It will drive straight on; measure how far.",
            "turns": "Put the robot where it can turn, and mark the floor straight ahead of it. It will make "
            f"about {TURNS} turns counter-clockwise; count them.",
            "duty": "Put the robot on open floor with 300 mm free before and behind. It drives to and fro.",
            "wall": f"Put the robot with {near} a flat white wall, looking straight at it.",
            "cylinder": f"Put the robot with {near} a white cylinder of {self.radius_mm:g} mm radius, "
            "looking straight at it.",
            "lamp": f"Darken the room. Put the robot with {near} the glass of a bulb of {self.power_w:g} W, "
            f"filament {self.height_mm:g} mm above the floor, looking straight at it.",
        }[self.kind]

    def make_word(self, measurement: float) -> str:
        """Return the name of the recording and a measurement, as `fit_inputs` reads them.

        Args:
            measurement: Length of the drive [mm], number of turns, or distance of the object [mm].
        """
        value = f"{measurement:.4f}".rstrip("0").rstrip(".")
        value_text = {
            "straight": f"{value}mm",
            "turns": f"{value}turns",
            "duty": "duty",
            "wall": f"wall@{value}mm",
            "cylinder": f"cylinder:{self.radius_mm:g}mm@{value}mm",
            "lamp": f"lamp:{self.power_w:g}W:{self.height_mm:g}mm@{value}mm",
        }[self.kind]
        return f"{self.file_name}={value_text}"


def steps(
    walls_mm: Sequence[float], cylinder_mm: float | None, lamp_w: float | None, lamp_height_mm: float
) -> list[Step]:
    """Return the steps of a session, with a cylinder and a lamp unless they are None.

    Raises:
        FitError: A value is out of range, or a distance is given twice.
    """
    for name, values, low, high in (
        ("wall", walls_mm, 1, 60),
        ("cylinder", [] if cylinder_mm is None else [cylinder_mm], 2, 1000),
        ("lamp", [] if lamp_w is None else [lamp_w], 0.01, 1000),
        ("lamp height", [lamp_height_mm], 1, 1000),
    ):
        if invalid := [value for value in values if not low <= value <= high]:
            raise FitError(f"{name} = {invalid[0]:g}; expected {low:g} to {high:g}")
    if len({f"{distance:g}" for distance in walls_mm}) < len(walls_mm):
        raise FitError("wall: a distance is given twice; expected different ones")
    session_steps = [Step("straight"), Step("turns"), Step("duty")]
    session_steps += [Step("wall", distance) for distance in walls_mm]
    if cylinder_mm is not None:
        session_steps += [Step("cylinder", distance, radius_mm=cylinder_mm) for distance in CYLINDERS_MM]
    if lamp_w is not None:
        session_steps += [Step("lamp", near, power_w=lamp_w, height_mm=lamp_height_mm) for near in LAMPS_MM]
    # With turns to both sides, the lag of readings behind the counters averages out.
    return [replace(step, sign=1 - 2 * (number % 2)) for number, step in enumerate(session_steps)]


def record(robot: Khepera, step: Step, path: Path, stop: Callable[[], bool]) -> bool:
    """Drive a step and write its recording; return False, without a recording, if `stop` returns True.

    Raises:
        SensorTestError: A wheel is blocked.
        PortError: The port failed.
    """
    if step.has_object:
        kind = "light" if step.kind == "lamp" else "proximity"
        run = sense(robot, SensorTest(kind, rotate_deg=360.0 * step.sign, speed=1), stop=stop)
        if not stop():
            save(path, run)
        return not stop()
    with _record_exchanges(robot, path, stop):
        try:
            if step.kind == "duty":
                _drive_duties(robot, stop)
            else:
                _drive_measured(robot, step, stop)
        finally:
            reset_motors(robot)
    return not stop()


def _drive_measured(robot: Khepera, step: Step, stop: Callable[[], bool]) -> None:
    """Drive straight or turn on the spot, by command C, and read the counters before and after."""
    length = STRAIGHT_MM / 1e3 if step.kind == "straight" else TURNS * math.pi * WHEEL_BASE
    pulses = round(length / PULSE_LENGTH)
    robot.set_position(0, 0)
    robot.configure_profile(_SPEED, _ACCELERATION, _SPEED, _ACCELERATION)
    robot.position()
    drive_to(robot, (pulses if step.kind == "straight" else -pulses, pulses), None, stop)
    robot.sleep(_SETTLE_S)
    robot.position()


def _drive_duties(robot: Khepera, stop: Callable[[], bool]) -> None:
    """Drive with each duty of `DUTIES` by command P, and request the speeds repeatedly."""
    for duty in DUTIES:
        robot.set_duty(duty, duty)
        end = robot.time + _DUTY_S
        while robot.time < end and not stop():
            robot.speed()


@contextmanager
def _record_exchanges(robot: Khepera, path: Path, stop: Callable[[], bool]) -> Generator[None]:
    """Record the exchanges with a robot in a log; write none after an error, or if `stop` returns True."""
    start, byte_ns = robot.time, BITS_PER_BYTE * NS_PER_S // robot.port.baudrate
    now_ns, is_kept = 0, False
    recorder = LineRecorder(path, {"port": robot.name}, lambda: now_ns)

    def listen(request: str, reply: str) -> None:
        nonlocal now_ns
        end_ns = round((robot.time - start) * NS_PER_S)
        # The robot had received the request when its reply, with two bytes of line end, started.
        now_ns = max(now_ns, end_ns - (len(reply) + 2) * byte_ns)
        recorder.on_bytes(True, f"{request}\n".encode("latin-1"))
        now_ns = max(now_ns, end_ns)
        recorder.on_bytes(False, f"{reply}\r\n".encode("latin-1"))

    previous_listener = robot.listen(listen)
    try:
        yield
        is_kept = not stop()
    finally:
        robot.listen(previous_listener)
        if is_kept:
            recorder.close()
        else:
            recorder.discard()
