"""Motors of one robot, from recorded drives with a fixed duty (command P): by driving the twin likewise.

The host's lines of a log are sent to a twin at their times, and what the twin answers to E and H is compared
with what the robot did. The speed that a duty leads to tells the no-load speed, how soon it is reached the
stall torque. The controllers of D and C hide both, so a log with P is asked for.
"""

import re
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from khep_twin import playpen
from khep_twin.errors import FitError
from khep_twin.files.toml_files import dump
from khep_twin.lab.fit.least_squares import Parameter, estimate
from khep_twin.log.channels import Line
from khep_twin.log.reader import read
from khep_twin.sensing.calibration import Calibration, MotorCalibration
from khep_twin.units import PULSES_PER_TURN, TICK_NS
from khep_twin.world import World

Floats = NDArray[np.float64]

_WISH = "steps of duty (P) of up to 50 and of half a second and more, with E or H asked all the while"
_HIGHEST_DUTY = 50
"""Beyond it tyres slip, and what they do then tells little of the motors (measured on the twin)."""

_LEAST_ANSWERS = 20
_FIELD = 'version = 1\nname = "field"\n[arena]\nwidth_mm = 10000\nheight_mm = 10000\n'
_STEP = 0.1
"""Of a parameter's scale, over which slopes are taken: tyres that slip make rough ones."""


@dataclass(frozen=True, slots=True)
class DutyDrive:
    """A recorded drive on open floor, from rest.

    Attributes:
        name: what to call it.
        sent: the host's lines and when the robot had them [ns].
        times_ns: of those that were E or H (n,) [ns].
        ways: whether it was H (n,).
        values: what the robot answered, left and right (n, 2).
    """

    name: str
    sent: tuple[tuple[int, str], ...]
    times_ns: NDArray[np.int64]
    ways: NDArray[np.bool_]
    values: NDArray[np.int64]

    def speeds(self, values: NDArray[Any]) -> Floats:
        """What answers tell of the speed: E as it is, H by how far the wheels have gone on (m, 2)."""
        ticks = np.diff(self.times_ns[self.ways]) / TICK_NS
        gone = np.diff(values[self.ways], axis=0) / ticks[:, None]
        return np.concatenate([values[~self.ways], gone])

    @property
    def times(self) -> Floats:
        """Of the rows of `speeds` (m,) [s]."""
        return np.concatenate([self.times_ns[~self.ways], self.times_ns[self.ways][1:]]) / 1e9


@dataclass(frozen=True, slots=True)
class MotorFit:
    """Motors found.

    Attributes:
        motors: their calibration.
        speed_interval: half the width of the no-load speed's 95 % confidence interval [rad/s].
        torque_interval: that of the stall torque's [N m].
        rms: of what is left of the speeds [pulses/10 ms].
    """

    motors: MotorCalibration
    speed_interval: float
    torque_interval: float
    rms: float


def read_drive(log: Path) -> DutyDrive:
    """The drive of a log with one robot.

    Raises:
        LogError: there is no log.
        FitError: it holds no steps of duty, or too few replies.
    """
    robots = read(log).robots
    if len(robots) != 1:
        raise FitError(f"{log}: {len(robots)} robots; right is a log of one")
    (track,) = robots.values()
    sent = tuple((line.time_ns, line.text) for line in track.serial if line.name == "host")
    asked = [(time_ns, text) for time_ns, text in sent if text in ("E", "H")]
    answers = [values for line in track.serial if (values := _values(line))]
    duties = [text for _, text in sent if text.startswith("P,")]
    if not duties:
        raise FitError(f"{log}: the motors cannot be told: no drive with a fixed duty; right are {_WISH}")
    if too_high := next((text for text in duties if _highest(text) > _HIGHEST_DUTY), ""):
        raise FitError(f"{log}: {too_high}: with such a duty the tyres slip; right are {_WISH}")
    if len(answers) < _LEAST_ANSWERS:
        raise FitError(
            f"{log}: the motors cannot be told: {len(answers)} answers to E and H; right are "
            f"{_LEAST_ANSWERS} and more, as of {_WISH}"
        )
    if [text.lower() for _, text in asked] != [letter for letter, *_ in answers]:
        raise FitError(f"{log}: some E or H were not answered; right is a drive with none lost")
    return DutyDrive(
        str(log),
        sent,
        np.array([time_ns for time_ns, _ in asked]),
        np.array([text == "H" for _, text in asked]),
        np.array([values for _, *values in answers]),
    )


def fit_motors(drives: Sequence[DutyDrive], start: Calibration) -> MotorFit:
    """Finds the motors that the drives were made with.

    Args:
        drives: to be met.
        start: the rest of the robot.

    Raises:
        FitError: the drives cannot tell a parameter.
    """
    measured = np.concatenate([drive.speeds(drive.values) for drive in drives])
    begin = start.motors
    torque_mnm = begin.stall_torque_n_m * 1e3
    parameters = [
        Parameter("no-load speed", begin.no_load_speed_rad_s, 30, 5, " rad/s", 20, 1000),
        Parameter("stall torque", torque_mnm, 3, 2, " mN m", 0.5, 200),
    ]

    def left(x: Floats) -> Floats:
        motors = MotorCalibration(no_load_speed_rad_s=float(x[0]), stall_torque_n_m=float(x[1]) / 1e3)
        robot = start.model_copy(update={"motors": motors})
        twin = np.concatenate([driven(drive, robot) for drive in drives])
        return (twin - measured).ravel()

    found = estimate(left, parameters, _WISH, step=_STEP)
    no_load, torque_mnm = found.values
    motors = MotorCalibration(
        no_load_speed_rad_s=round(no_load, 2), stall_torque_n_m=round(torque_mnm / 1e3, 6)
    )
    return MotorFit(motors, found.intervals[0], found.intervals[1] / 1e3, found.rms)


def driven(drive: DutyDrive, robot: Calibration) -> Floats:
    """Speeds of a twin of a robot on a drive, as `DutyDrive.speeds` gives the robot's (m, 2)."""
    with TemporaryDirectory(prefix="khep-twin-") as folder:
        file = Path(folder) / "robot.toml"
        file.write_text(dump(robot), encoding="utf-8")
        place = f"[[robot]]\nx_mm = 5000\ny_mm = 5000\nheading_deg = 0\ncalibration = '{file}'\n"
        world = World(playpen.parse(_FIELD + place, "field"), noise=False, unpaced=True)
    # Proximity is of no interest here, and takes half of the time.
    world.model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_SENSOR
    axles = [int(world.model.joint(f"khepera0/{side}_axle").qposadr[0]) for side in ("left", "right")]
    waiting = deque(drive.sent)
    angles: list[Floats] = []
    for tick in range(int(drive.times_ns[-1]) // TICK_NS + 1):
        angles.append(world.data.qpos[axles].copy())
        while waiting and waiting[0][0] < (tick + 1) * TICK_NS:
            time_ns, text = waiting.popleft()
            world.advance_to(max(time_ns, world.time_ns))
            world.robots[0].send(text.encode("latin-1") + b"\n")
        world.advance_to((tick + 1) * TICK_NS)
    # The board knows of its wheels what the last tick has counted. Whole pulses are what it says, but parts
    # of them are what a search can go by.
    pulses = np.array(angles) * (PULSES_PER_TURN / (2 * np.pi))
    ticks = drive.times_ns // TICK_NS
    gone = pulses[ticks] - pulses[np.maximum(ticks - 1, 0)]
    return drive.speeds(np.where(drive.ways[:, None], pulses[ticks], gone))


def _values(line: Line) -> tuple[str, int, int] | None:
    """A robot's answer to E or H; None for anything else, and for noise."""
    letter, *fields = line.text.split(",")
    if line.name != "robot" or letter not in ("e", "h") or len(fields) != 2:
        return None
    try:
        return letter, int(fields[0]), int(fields[1])
    except ValueError:
        return None


def _highest(command: str) -> int:
    """The larger duty of a command P."""
    return max(abs(int(field)) for field in re.findall(r"-?\d+", command))
