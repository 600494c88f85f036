"""Steps of a calibration session: the instruction to the person, and the recording of the robot.

    straight                 60 cm, measured with a ruler                    straight.mcap
    turns                    five turns on the spot, counted                 turns.mcap
    duty                     steps of duty on open floor                     duty.mcap
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
from khep_twin.host.host_robot import HostRobot
from khep_twin.lab.fit.fit_inputs import FILAMENT_MM
from khep_twin.lab.fit.placement import KHEPERA
from khep_twin.lab.sensor_test.sensor_files import save
from khep_twin.lab.sensor_test.sensor_test import SensorTest, prepare_drive, reset_motors, sense
from khep_twin.log.line_recorder import LineRecorder
from khep_twin.robots.model import RobotModel
from khep_twin.units import BITS_PER_BYTE

STRAIGHT_MM, TURNS = 600, 5
"""Nominal length of the straight drive [mm], and number of turns on the spot."""

LAMPS_MM = (60.0, 150.0)
"""Distances of lamps from the robot's edge [mm], at which its readings are not clipped."""

_DUTY_S, _POLL_S = 0.75, 0.009
"""Duration of a step of duty; least time between two polls, whose values change every 10 ms [s]."""
_SPEED, _ACCELERATION = 10, 32
"""Values of command J on measured drives [8 mm/s, 3.125 mm/s^2]: slow, so that no tyre slips."""

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
        height_mm: Height of the lamp's filament, or least height of the wall, above the floor [mm].
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
            "wall": f"Put the robot with {near} a flat white wall, {self.height_mm:g} mm high or more, "
            "looking straight at it.",
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
    walls_mm: Sequence[float],
    cylinder_mm: float | None,
    lamp_w: float | None,
    lamp_height_mm: float,
    model: RobotModel = KHEPERA,
) -> list[Step]:
    """Return the steps of a session, with a cylinder and a lamp unless they are None.

    Raises:
        FitError: A value is out of range, or a distance is given twice.
    """
    bench = model.fit_bench
    for name, values, low, high in (
        ("wall", walls_mm, 1, 300),
        ("cylinder", [] if cylinder_mm is None else [cylinder_mm], 2, 1000),
        ("lamp", [] if lamp_w is None else [lamp_w], 0.01, 1000),
        ("lamp height", [lamp_height_mm], 1, 1000),
    ):
        if invalid := [value for value in values if not low <= value <= high]:
            raise FitError(f"{name} = {invalid[0]:g}; expected {low:g} to {high:g}")
    if len({f"{distance:g}" for distance in walls_mm}) < len(walls_mm):
        raise FitError("wall: a distance is given twice; expected different ones")
    session_steps = [Step("straight"), Step("turns"), Step("duty")]
    session_steps += [Step("wall", near, height_mm=bench.height_mm) for near in walls_mm]
    if cylinder_mm is not None:
        session_steps += [Step("cylinder", near, radius_mm=cylinder_mm) for near in bench.cylinders_mm]
    if lamp_w is not None:
        session_steps += [Step("lamp", near, power_w=lamp_w, height_mm=lamp_height_mm) for near in LAMPS_MM]
    # With turns to both sides, the lag of readings behind the counters averages out.
    return [replace(step, sign=1 - 2 * (number % 2)) for number, step in enumerate(session_steps)]


def record(robot: HostRobot, step: Step, path: Path, stop: Callable[[], bool]) -> bool:
    """Drive a step and write its recording; return False, without a recording, if `stop` returns True.

    Raises:
        SensorTestError: A wheel is blocked.
        PortError: The port failed.
    """
    if step.has_object:
        kind = "light" if step.kind == "lamp" else "proximity"
        test = SensorTest(kind, rotate_deg=360.0 * step.sign, speed=1, model=robot.model.name)
        run = sense(robot, test, stop=stop)
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


def _drive_measured(robot: HostRobot, step: Step, stop: Callable[[], bool]) -> None:
    """Drive straight or turn on the spot, and read the counters before and after."""
    body = robot.model.body
    length = STRAIGHT_MM / 1e3 if step.kind == "straight" else TURNS * math.pi * body.wheel_base
    pulses = round(length / body.pulse_length)
    drive = prepare_drive(robot, _SPEED, _ACCELERATION)
    robot.read_channels("position")
    drive((pulses if step.kind == "straight" else -pulses, pulses), None, stop)
    robot.sleep(_SETTLE_S)
    robot.read_channels("position")


def _drive_duties(robot: HostRobot, stop: Callable[[], bool]) -> None:
    """Drive with each duty, and poll the motion repeatedly."""
    bench = robot.model.fit_bench
    for duty in bench.duties:
        robot.ask(bench.duty.format(duty, duty))
        end = robot.time + _DUTY_S
        while robot.time < end and not stop():
            start = robot.time
            robot.read_channels(bench.polls[0])
            robot.sleep(max(start + _POLL_S - robot.time, 0))


@contextmanager
def _record_exchanges(robot: HostRobot, path: Path, stop: Callable[[], bool]) -> Generator[None]:
    """Record the exchanges with a robot in a log; write none after an error, or if `stop` returns True."""
    start, byte_ns = robot.time, BITS_PER_BYTE * NS_PER_S // robot.port.baudrate
    now_ns, is_kept = 0, False
    recorder = LineRecorder(path, {"port": robot.name}, lambda: now_ns, robot.model)

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
