"""Fit of one robot's motors to recorded drives with fixed duties (a Khepera's command P), by simulating them.

A twin receives the host's lines of a log at their times; its speeds and counters are compared with the
robot's replies. Steady speeds at two duties determine no-load speed and gear friction; the rise time
determines the stall torque. The speed and position controllers hide these parameters.
The phase of the controller's 10 ms ticks is not in the log; the one with the smallest residuals is used.
"""

import re
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple, Self

import mujoco
import numpy as np
from numpy.typing import NDArray

from khep_twin import playpen
from khep_twin.errors import FitError
from khep_twin.files.toml_files import dump
from khep_twin.lab.experiment.measures import parse_values
from khep_twin.lab.fit.least_squares import Floats, Parameter, least_squares
from khep_twin.lab.fit.placement import KHEPERA, FittedValue
from khep_twin.lab.fit.wheel_fit import read_transcript
from khep_twin.robots.model import RobotModel
from khep_twin.sensing.calibration import Calibration, MotorCalibration
from khep_twin.units import TICK_NS
from khep_twin.world import World

_PHASES_NS, _FINE_STEPS_NS = range(0, TICK_NS, TICK_NS // 10), (TICK_NS // 20, TICK_NS // 40, TICK_NS // 80)
"""Times of a log's first line after a tick, and steps of their refinement around the best one [ns]."""

_MAX_ROUNDS = 4
"""Limit of the rounds, each a fit of the motors and then of the phases."""

_MIN_REPLIES = 20  # to E and H
_OPEN_FLOOR_TEXT = 'version = 1\nname = "field"\n[arena]\nwidth_mm = 10000\nheight_mm = 10000\n'
_DERIVATIVE_STEP = 0.1
"""Step of the numeric derivatives in each parameter's scale; large, as slipping tyres add noise."""


_KEYS = ("no_load_speed_rad_s", "stall_torque_n_m", "friction_torque_n_m")
"""Keys of the fitted values in a calibration."""


@dataclass(frozen=True, slots=True)
class DutyDrive:
    """Recorded drive on open floor, from rest.

    Attributes:
        name: Name in messages.
        requests: Time at which the robot received each line of the host [ns], and the line.
        times_ns: Times of the requests of speeds and positions (n,) [ns].
        is_position: True for positions (n,).
        values: Speeds and positions, left and right (n, 2).
        model: Model of the robot.
    """

    name: str
    requests: tuple[tuple[int, str], ...]
    times_ns: NDArray[np.int64]
    is_position: NDArray[np.bool_]
    values: NDArray[np.int64]
    model: RobotModel = KHEPERA

    def speeds(self, values: NDArray[np.int64] | Floats) -> Floats:
        """Return speeds from the replies: speeds unchanged, then the rates of positions (m, 2)."""
        ticks = np.diff(self.times_ns[self.is_position]) / TICK_NS
        rates = np.diff(values[self.is_position], axis=0) / ticks[:, None]
        return np.concatenate([values[~self.is_position], rates], dtype=np.float64)

    def shift_times(self, shift_ns: int) -> Self:
        """Return the drive with all times shifted [ns]."""
        requests = tuple((time_ns + shift_ns, text) for time_ns, text in self.requests)
        return replace(self, requests=requests, times_ns=self.times_ns + shift_ns)

    @property
    def speed_times_s(self) -> Floats:
        """Times of the rows of `speeds` (m,) [s]."""
        return np.concatenate([self.times_ns[~self.is_position], self.times_ns[self.is_position][1:]]) / 1e9


class MotorFit(NamedTuple):
    """Fit of the motors.

    Attributes:
        motors: Fitted calibration.
        values: Fitted values: no-load speed [rad/s], stall torque and friction torque [N m].
        drives: Drives in phase with the controller.
    """

    motors: MotorCalibration
    values: tuple[FittedValue, ...]
    drives: Sequence[DutyDrive]


def _expected_data(model: RobotModel) -> str:
    bench, reads = model.fit_bench, model.dialect.reads
    steps = f"steps of duty ({bench.duty_command}) of up to {bench.duty_limit} and of half a second and more"
    return f"{steps}, while polling {' or '.join(reads[poll].request for poll in bench.polls)}"


def read_drive(log: Path, model: RobotModel = KHEPERA) -> DutyDrive:
    """Read the drive of a log with one robot of a model.

    Raises:
        LogError: There is no log.
        FitError: The log has no steps of duty, or too few replies.
    """
    lines, framing = read_transcript(log, model), model.dialect.framing
    bench, requirement = model.fit_bench, _expected_data(model)
    requests = tuple((line.time_ns, line.text) for line in lines if line.name == "host")
    reads = {read.request: read for read in map(model.dialect.reads.__getitem__, bench.polls)}
    queries = [(time_ns, text) for time_ns, text in requests if text in reads]
    replies = [
        (read.request, *values[:2])
        for line in lines
        for read in reads.values()
        if line.name == "robot"
        and framing.answers(read.request, line.text)
        and len(values := parse_values(framing, line.text)) == read.n_values
    ]
    duties = [text for _, text in requests if text.startswith(f"{bench.duty_command},")]
    if not duties:
        raise FitError(
            f"{log}: the motors cannot be determined: no drive with a fixed duty; expected {requirement}"
        )
    if too_high := next((text for text in duties if _largest_duty(text) > bench.duty_limit), ""):
        raise FitError(f"{log}: {too_high}: the tyres may slip at this duty; expected {requirement}")
    if len(replies) < _MIN_REPLIES:
        raise FitError(
            f"{log}: the motors cannot be determined: {len(replies)} answers to {' and '.join(reads)}; "
            f"expected at least {_MIN_REPLIES}, from {requirement}"
        )
    if [text for _, text in queries] != [request for request, *_ in replies]:
        raise FitError(f"{log}: some {' or '.join(reads)} were not answered; expected a drive with none lost")
    return DutyDrive(
        str(log),
        requests,
        np.array([time_ns for time_ns, _ in queries]),
        np.array([text == model.dialect.reads["position"].request for _, text in queries]),
        np.array([values for _, *values in replies]),
        model,
    )


def fit_motors(drives: Sequence[DutyDrive], start: Calibration) -> MotorFit:
    """Fit the motors to the drives; `start` has the initial values and the robot's other parameters.

    Raises:
        FitError: The drives do not determine a parameter.
    """
    drives = [align(drive, start) for drive in drives]
    fit = _fit_aligned_drives(drives, start)
    for _ in range(_MAX_ROUNDS):
        previous_starts_ns = [drive.requests[0][0] for drive in drives]
        drives = [align(drive, start.model_copy(update={"motors": fit.motors})) for drive in drives]
        if [drive.requests[0][0] for drive in drives] == previous_starts_ns:
            break
        fit = _fit_aligned_drives(drives, start)
    return fit


def align(drive: DutyDrive, robot: Calibration) -> DutyDrive:
    """Return a drive with its times shifted to the phase at which a robot's twin fits its replies best."""

    def mean_square(candidate: DutyDrive) -> float:
        return float(np.mean((simulate(candidate, robot) - candidate.speeds(candidate.values)) ** 2))

    # One additional tick, so that no line precedes the start of the world.
    first_ns = drive.requests[0][0] - TICK_NS
    phases = (drive.shift_times(phase_ns - first_ns) for phase_ns in _PHASES_NS)
    candidates = {mean_square(candidate): candidate for candidate in phases}
    for step_ns in _FINE_STEPS_NS:
        best = candidates[min(candidates)]
        candidates |= {mean_square(drive): drive for drive in map(best.shift_times, (-step_ns, step_ns))}
    return candidates[min(candidates)]


def _fit_aligned_drives(drives: Sequence[DutyDrive], start: Calibration) -> MotorFit:
    """Fit the motors to drives that are in phase with the controller."""
    measured_speeds = np.concatenate([drive.speeds(drive.values) for drive in drives])
    initial, speed = start.motors, start.motors.no_load_speed_rad_s
    parameters = [
        Parameter("no-load speed", speed, speed / 5, speed / 30, " rad/s", speed / 8, speed * 7),
        Parameter("stall torque", initial.stall_torque_n_m * 1e3, 3, 2, " mN m", 0.5, 200),
        Parameter("gear friction", initial.friction_torque_n_m * 1e3, 0.3, 0.3, " mN m", 0, 50),
    ]

    def residuals(x: Floats) -> Floats:
        robot = start.model_copy(update={"motors": _motor_calibration(initial, x.tolist())})
        twin_speeds = np.concatenate([simulate(drive, robot) for drive in drives])
        return (twin_speeds - measured_speeds).ravel()

    estimate = least_squares(residuals, parameters, _expected_data(drives[0].model), step=_DERIVATIVE_STEP)
    motors = _motor_calibration(initial, estimate.values.tolist())
    intervals = (estimate.intervals / [1, 1e3, 1e3]).tolist()
    values = [
        FittedValue(("motors", key), getattr(motors, key), interval)
        for key, interval in zip(_KEYS, intervals, strict=True)
    ]
    return MotorFit(motors, tuple(values), drives)


def simulate(drive: DutyDrive, robot: Calibration) -> Floats:
    """Return the speeds of a robot's twin on a drive, in the form of `DutyDrive.speeds` (m, 2)."""
    with TemporaryDirectory(prefix="khep-twin-") as folder:
        path = Path(folder) / "robot.toml"
        path.write_text(dump(robot), encoding="utf-8")
        robot_text = f"[[robot]]\nx_mm = 5000\ny_mm = 5000\nheading_deg = 0\ncalibration = '{path}'\n"
        robot_text += f"model = '{drive.model.name}'\n"
        world = World(playpen.parse(_OPEN_FLOOR_TEXT + robot_text, "field"), noise=False, unpaced=True)
    # Proximity is not needed and would take half of the time.
    world.model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_SENSOR
    world.code.switch_if_ready()
    wheel_qpos = list(world.robots[0].indices.wheel_qpos)
    pending_requests = deque(drive.requests)
    angles: list[Floats] = []
    for tick in range(int(drive.times_ns[-1]) // TICK_NS + 1):
        angles.append(world.data.qpos[wheel_qpos].copy())
        while pending_requests and pending_requests[0][0] < (tick + 1) * TICK_NS:
            time_ns, text = pending_requests.popleft()
            world.advance_to(max(time_ns, world.time_ns))
            world.robots[0].send(text.encode("latin-1") + b"\n")
        world.advance_to((tick + 1) * TICK_NS)
    # The board reads the counters of the last tick, in whole pulses; the fit needs a smooth function.
    pulses = np.array(angles) * (drive.model.body.pulses_per_turn / (2 * np.pi))
    ticks = drive.times_ns // TICK_NS
    changes = pulses[ticks] - pulses[np.maximum(ticks - 1, 0)]
    return drive.speeds(np.where(drive.is_position[:, None], pulses[ticks], changes))


def _motor_calibration(initial: MotorCalibration, values: Sequence[float]) -> MotorCalibration:
    """Return motors with a no-load speed [rad/s], stall torque and friction torque [mN m]."""
    speed, stall, friction = values
    rounded_values = round(speed, 2), round(stall / 1e3, 6), round(friction / 1e3, 6)
    return initial.model_copy(update=dict(zip(_KEYS, rounded_values, strict=True)))


def _largest_duty(command: str) -> int:
    """Return the larger duty of a command P."""
    return max(abs(int(field)) for field in re.findall(r"-?\d+", command))
