"""Fit of one robot's motors to recorded drives with fixed duties (command P), by simulating them.

The host's lines of a log are sent to a twin at their times, and its answers to E and H are compared with the
robot's. Steady speeds at two duties determine the no-load speed and the gears' friction, the rise time the
stall torque. The controllers of D and C hide them, so the log must contain P. A host's log does not tell at
which part of its 10 ms the robot's controller ticks: the phase that meets its answers best is taken.
"""

import re
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Self

import mujoco
import numpy as np
from numpy.typing import NDArray

from khep_twin import playpen
from khep_twin.errors import FitError
from khep_twin.files.toml_files import dump
from khep_twin.lab.fit.least_squares import Floats, Parameter, least_squares
from khep_twin.lab.fit.wheel_fit import transcript
from khep_twin.log.channels import TextLine
from khep_twin.sensing.calibration import Calibration, MotorCalibration
from khep_twin.units import PULSES_PER_TURN, TICK_NS
from khep_twin.world import World

_WISH = "steps of duty (P) of up to 50 and of half a second and more, while polling E or H"
_HIGHEST_DUTY = 50
"""Largest duty; beyond it tyres slip and hide the motors' behaviour (measured on the twin)."""

_PHASES, _FINER = range(0, TICK_NS, TICK_NS // 10), (TICK_NS // 20, TICK_NS // 40, TICK_NS // 80)
"""Shifts of a log's times against the controller's ticks that are tried, and steps around the best [ns]."""

_ROUNDS = 4
"""Most rounds of fitting motors and shifts in turn."""

_LEAST_ANSWERS = 20
_FIELD = 'version = 1\nname = "field"\n[arena]\nwidth_mm = 10000\nheight_mm = 10000\n'
_STEP = 0.1
"""Step of the numeric derivatives in each parameter's scale; it is large, as slipping tyres add noise."""


@dataclass(frozen=True, slots=True)
class DutyDrive:
    """Recorded drive on open floor, from rest.

    Attributes:
        name: Name in messages.
        sent: Times at which the robot received the host's lines [ns], and the lines.
        times_ns: Times of those that were E or H (n,) [ns].
        ways: True where the answer was to H (n,).
        values: Answers of the robot, left and right (n, 2).
    """

    name: str
    sent: tuple[tuple[int, str], ...]
    times_ns: NDArray[np.int64]
    ways: NDArray[np.bool_]
    values: NDArray[np.int64]

    def speeds(self, values: NDArray[np.int64] | Floats) -> Floats:
        """Return speeds from the answers: E as it is, H by its difference to the one before (m, 2)."""
        ticks = np.diff(self.times_ns[self.ways]) / TICK_NS
        gone = np.diff(values[self.ways], axis=0) / ticks[:, None]
        return np.concatenate([values[~self.ways], gone], dtype=np.float64)

    def shifted(self, phase_ns: int) -> Self:
        """Return the drive with its first line so much after a tick of the controller [ns]."""
        # One whole tick first, so that no line comes before the world begins.
        return self.later(phase_ns + TICK_NS - self.sent[0][0])

    def later(self, shift_ns: int) -> Self:
        """Return the drive with all its times later [ns]."""
        sent = tuple((time_ns + shift_ns, text) for time_ns, text in self.sent)
        return replace(self, sent=sent, times_ns=self.times_ns + shift_ns)

    @property
    def times(self) -> Floats:
        """Times of the rows of `speeds` (m,) [s]."""
        return np.concatenate([self.times_ns[~self.ways], self.times_ns[self.ways][1:]]) / 1e9


@dataclass(frozen=True, slots=True)
class MotorFit:
    """Fit of the motors.

    Attributes:
        motors: Fitted calibration.
        speed_interval: Half of the no-load speed's 95 % confidence interval [rad/s].
        torque_interval: Half of the stall torque's 95 % confidence interval [N m].
        friction_interval: Half of the friction torque's 95 % confidence interval [N m].
        drives: Drives in phase with the controller.
    """

    motors: MotorCalibration
    speed_interval: float
    torque_interval: float
    friction_interval: float
    drives: tuple[DutyDrive, ...]


def read_drive(log: Path) -> DutyDrive:
    """Read the drive of a log with one robot.

    Raises:
        LogError: There is no log.
        FitError: It holds no steps of duty, or too few replies.
    """
    lines = transcript(log)
    sent = tuple((line.time_ns, line.text) for line in lines if line.name == "host")
    asked = [(time_ns, text) for time_ns, text in sent if text in ("E", "H")]
    answers = [values for line in lines if (values := _values(line))]
    duties = [text for _, text in sent if text.startswith("P,")]
    if not duties:
        raise FitError(
            f"{log}: the motors cannot be determined: no drive with a fixed duty; expected {_WISH}"
        )
    if too_high := next((text for text in duties if _highest(text) > _HIGHEST_DUTY), ""):
        raise FitError(f"{log}: {too_high}: the tyres slip at this duty; expected {_WISH}")
    if len(answers) < _LEAST_ANSWERS:
        raise FitError(
            f"{log}: the motors cannot be determined: {len(answers)} answers to E and H; expected "
            f"at least {_LEAST_ANSWERS}, from {_WISH}"
        )
    if [text.lower() for _, text in asked] != [letter for letter, *_ in answers]:
        raise FitError(f"{log}: some E or H were not answered; expected a drive with none lost")
    return DutyDrive(
        str(log),
        sent,
        np.array([time_ns for time_ns, _ in asked]),
        np.array([text == "H" for _, text in asked]),
        np.array([values for _, *values in answers]),
    )


def fit_motors(drives: Sequence[DutyDrive], start: Calibration) -> MotorFit:
    """Fit the motors to the drives; `start` has the rest of the robot, and the initial values.

    Raises:
        FitError: The drives do not determine a parameter.
    """
    drives = [aligned(drive, start) for drive in drives]
    found = _fit(drives, start)
    for _ in range(_ROUNDS):
        before = [drive.sent[0][0] for drive in drives]
        drives = [aligned(drive, start.model_copy(update={"motors": found.motors})) for drive in drives]
        if [drive.sent[0][0] for drive in drives] == before:
            break
        found = _fit(drives, start)
    return found


def aligned(drive: DutyDrive, robot: Calibration) -> DutyDrive:
    """Return a drive with its times shifted to where a robot's twin meets its answers best."""

    def left(shifted: DutyDrive) -> float:
        return float(np.mean((driven(shifted, robot) - shifted.speeds(shifted.values)) ** 2))

    tried = {left(each): each for each in map(drive.shifted, _PHASES)}
    for step_ns in _FINER:
        best = tried[min(tried)]
        tried |= {left(each): each for each in map(best.later, (-step_ns, step_ns))}
    return tried[min(tried)]


def _fit(drives: Sequence[DutyDrive], start: Calibration) -> MotorFit:
    """Fit the motors to drives whose times are in phase with the controller."""
    measured = np.concatenate([drive.speeds(drive.values) for drive in drives])
    begin = start.motors
    parameters = [
        Parameter("no-load speed", begin.no_load_speed_rad_s, 30, 5, " rad/s", 20, 1000),
        Parameter("stall torque", begin.stall_torque_n_m * 1e3, 3, 2, " mN m", 0.5, 200),
        Parameter("gear friction", begin.friction_torque_n_m * 1e3, 0.3, 0.3, " mN m", 0, 50),
    ]

    def left(x: Floats) -> Floats:
        robot = start.model_copy(update={"motors": _motors(x.tolist())})
        twin = np.concatenate([driven(drive, robot) for drive in drives])
        return (twin - measured).ravel()

    found = least_squares(left, parameters, _WISH, step=_STEP)
    speed_interval, torque_interval, friction_interval = found.intervals
    within = float(speed_interval), float(torque_interval) / 1e3, float(friction_interval) / 1e3
    return MotorFit(_motors(found.values.tolist()), *within, tuple(drives))


def driven(drive: DutyDrive, robot: Calibration) -> Floats:
    """Return the speeds of a robot's twin on a drive, as `DutyDrive.speeds` gives the robot's (m, 2)."""
    with TemporaryDirectory(prefix="khep-twin-") as folder:
        file = Path(folder) / "robot.toml"
        file.write_text(dump(robot), encoding="utf-8")
        position = f"[[robot]]\nx_mm = 5000\ny_mm = 5000\nheading_deg = 0\ncalibration = '{file}'\n"
        world = World(playpen.parse(_FIELD + position, "field"), noise=False, unpaced=True)
    # Proximity is not needed here and takes half of the time.
    world.model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_SENSOR
    world.code.switch_if_ready()
    axles = list(world.robots[0].indices.wheel_angles)
    waiting = deque(drive.sent)
    angles: list[Floats] = []
    for tick in range(int(drive.times_ns[-1]) // TICK_NS + 1):
        angles.append(world.data.qpos[axles].copy())
        while waiting and waiting[0][0] < (tick + 1) * TICK_NS:
            time_ns, text = waiting.popleft()
            world.advance_to(max(time_ns, world.time_ns))
            world.robots[0].send(text.encode("latin-1") + b"\n")
        world.advance_to((tick + 1) * TICK_NS)
    # The board reads the counters of the last tick. It rounds to whole pulses, but the fit needs a smooth
    # function.
    pulses = np.array(angles) * (PULSES_PER_TURN / (2 * np.pi))
    ticks = drive.times_ns // TICK_NS
    gone = pulses[ticks] - pulses[np.maximum(ticks - 1, 0)]
    return drive.speeds(np.where(drive.ways[:, None], pulses[ticks], gone))


def _motors(values: Sequence[float]) -> MotorCalibration:
    """Return motors of a no-load speed [rad/s], stall torque and friction torque [mN m]."""
    speed, stall, friction = values
    return MotorCalibration(
        no_load_speed_rad_s=round(speed, 2),
        stall_torque_n_m=round(stall / 1e3, 6),
        friction_torque_n_m=round(friction / 1e3, 6),
    )


def _values(line: TextLine) -> tuple[str, int, int] | None:
    """Return a robot's answer to E or H, None for anything else and for garbled lines."""
    letter, *fields = line.text.split(",")
    if line.name != "robot" or letter not in ("e", "h") or len(fields) != 2:
        return None
    try:
        return letter, int(fields[0]), int(fields[1])
    except ValueError:
        return None


def _highest(command: str) -> int:
    """Return the larger duty of a command P."""
    return max(abs(int(field)) for field in re.findall(r"-?\d+", command))
