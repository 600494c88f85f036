"""Study of the intervals that `khep-twin fit` prints.

Random robots around a calibration are recorded by the planar models of the sensors. A person with a ruler has
placed the objects, with errors of 0.5 mm and 1.5 degrees (standard deviations). The study prints the share of
fitted 95 % intervals that contain the robot's true values. With `--sessions` the robots are twins in MuJoCo
that `khep-twin calibrate` measures, including motors and all effects that the planar models omit.
"""

import math
from collections import defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from khep_twin import playpen
from khep_twin.files.toml_files import TomlTable, dump
from khep_twin.host import Khepera
from khep_twin.lab.fit.fit_inputs import FitTests, SensorData, fit_inputs
from khep_twin.lab.fit.infrared_fit import mean_counts
from khep_twin.lab.fit.lamp_fit import LampPositions, ambient_counts
from khep_twin.lab.fit.least_squares import CONFIDENCE, Floats
from khep_twin.lab.fit.placement import FittedValue, Misplacement, Placement, Readings, Ruler
from khep_twin.lab.fit.robot_fit import fit_robot
from khep_twin.lab.fit.session import CalibrationSession
from khep_twin.lab.fit.session_people import SimulatedPerson
from khep_twin.lab.fit.session_steps import LAMPS_MM, steps
from khep_twin.lab.fit.wheel_fit import Drive
from khep_twin.lab.sensor_test.sensor_test import SensorRun, SensorTest
from khep_twin.ports.protocol_khep import Serial
from khep_twin.ports.twin import TwinOptions, open_twin
from khep_twin.randomness import stream
from khep_twin.robots.registry import default_model
from khep_twin.sensing import calibration
from khep_twin.sensing.calibration import Calibration
from khep_twin.units import BULB_RADIUS, N_SENSORS, PULSES_PER_TURN, SENSOR_HEIGHT
from tools.command_table import command_line

ROBOTS = 40
STRAIGHT_MM, TURNS = 800.0, 5
POWER_W, FILAMENT = 2.0, 0.015

SPREADS = {"heading_deg": 3.0, "lobe_exponent": 0.3, "dark_counts": 8.0, "diffuse": 0.02, "base_mm": 0.6}
"""Standard deviations of values around the calibration's (assumed)."""

FACTORS = {
    "gain_counts_mm2": 0.13,
    "threshold_counts": 0.14,
    "noise_counts": 0.1,
    "gain_counts_mm2_per_w": 0.055,
    "radius_mm": 0.01,
}
"""Relative ones: as among the sampled robot's sensors; noise and wheels are assumed."""

MOTORS = 0.08
"""Relative standard deviation of the motors' values (assumed)."""

BENCH = (
    'version = 1\nname = "bench"\n[arena]\nwidth_mm = 2000\nheight_mm = 2000\n'
    "[[robot]]\nx_mm = 500\ny_mm = 500\nheading_deg = 0\n"
)

PERIOD, _SPEED = 0.05, 1
"""Time between two readings [s], and speed of the wheels in a turn [pulses/10 ms]."""


def draw_robot(start: Calibration, rng: np.random.Generator) -> Calibration:
    """Return a robot drawn around a calibration."""
    headings = np.array(start.heading_deg) + SPREADS["heading_deg"] * rng.standard_normal(N_SENSORS)
    update: dict[str, object] = {"heading_deg": tuple(headings.tolist())}
    for name in ("wheels", "proximity", "ambient"):
        table = getattr(start, name)
        update[name] = table.model_copy(update=_draw_table(table, rng))
    return start.model_copy(update=update)


def _draw_table(table: TomlTable, rng: np.random.Generator) -> dict[str, object]:
    update: dict[str, object] = {}
    for key in type(table).model_fields:
        value = np.array(getattr(table, key), np.float64)
        draws = rng.standard_normal(value.shape)
        if key in SPREADS:
            value = np.maximum(value + SPREADS[key] * draws, 0.0 if key != "heading_deg" else -np.inf)
            if key == "dark_counts":
                value = np.minimum(value, table.model_dump()["ceiling_counts"] - 1)
        elif key in FACTORS:
            value = value * (1 + FACTORS[key] * draws)
        else:
            continue
        update[key] = tuple(value.tolist()) if value.shape else float(value)
    return update


@dataclass(frozen=True, slots=True)
class Person:
    """Person with a ruler, and a robot.

    Attributes:
        robot: Calibration of the robot.
        ruler: Precision of the ruler.
        rng: Random stream of the errors and of the readings' noise.
        period: Time between two readings [s].
    """

    robot: Calibration
    ruler: Ruler
    rng: np.random.Generator
    period: float = PERIOD

    def tests(self) -> FitTests:
        """Return a whole session's tests."""
        return FitTests(
            wheels=tuple(self._drives()),
            objects=tuple(self._turn(f"wall@{mm:g}mm", mm) for mm in default_model().fit_bench.walls_mm),
            lamps=tuple(self._turn(f"lamp@{mm:g}mm", mm, POWER_W) for mm in LAMPS_MM),
        )

    def _drives(self) -> Iterator[Drive]:
        pulse, base = self._pulse, self.robot.wheels.base_mm / 1e3
        count = round(STRAIGHT_MM / 1e3 / pulse)
        yield Drive("straight", count, count, distance=pulse * count + self._error_m())
        for sign in (1, -1):
            count = sign * round(TURNS * math.pi * base / pulse)
            yield Drive("spin", -count, count, turn=2 * pulse * count / base + self._error_rad())

    def _turn(self, name: str, distance_mm: float, power: float | None = None) -> SensorData:
        rate = 2 * _SPEED * 100 * self._pulse / (self.robot.wheels.base_mm / 1e3)
        times = np.arange(0, 2 * math.pi / rate, self.period)
        pulses = np.round(times * _SPEED * 100).astype(np.int64)
        # A reading is up to 20 ms older than the answer, which comes 20 ms after the counters'.
        ages = self.rng.uniform(0, 0.02, len(times))
        poses = np.column_stack([np.zeros((len(times), 2)), rate * (times + ages)])
        place = Placement(poses, distance_mm / 1e3, 0.0 if power is None else BULB_RADIUS)
        misplacement = Misplacement(self._error_m(), self._error_rad())
        counts = self._read(Readings(name, place, np.empty(0), power, FILAMENT - SENSOR_HEIGHT), misplacement)
        kind = "proximity" if power is None else "light"
        test = SensorTest(kind, rotate_deg=360, speed=_SPEED)
        dv = np.column_stack([-pulses, pulses, counts.astype(np.int64)])
        return SensorData(name, SensorRun(test, dv, times), distance_mm / 1e3, power=power, height=FILAMENT)

    def _read(self, test: Readings, misplacement: Misplacement) -> Floats:
        near, ambient = self.robot.proximity, self.robot.ambient
        if test.power is None:
            level = mean_counts(test.placement, self.robot, misplacement)
            level += near.noise_counts * self.rng.standard_normal(level.shape)
            idle = self.rng.exponential(near.idle_counts, level.shape)
            return np.rint(np.clip(level, idle, near.limit_counts))
        lamp = LampPositions.of(test, misplacement)
        level = np.column_stack([ambient_counts(lamp, sensor, ambient) for sensor in range(N_SENSORS)])
        level += ambient.noise_counts * self.rng.standard_normal(level.shape)
        return np.rint(np.clip(level, 0, ambient.ceiling_counts))

    @property
    def _pulse(self) -> float:
        """Distance of a wheel per pulse [m]."""
        return 2 * math.pi * self.robot.wheels.radius_mm / 1e3 / PULSES_PER_TURN

    def _error_m(self) -> float:
        return self.ruler.distance_mm / 1e3 * float(self.rng.standard_normal())

    def _error_rad(self) -> float:
        return math.radians(self.ruler.bearing_deg * float(self.rng.standard_normal()))


def value_in(robot: Calibration, fitted: FittedValue) -> float:
    """Return the value of a calibration at the place of a fitted value."""
    table, key, *sensor = fitted.path
    values = np.atleast_1d(getattr(getattr(robot, table) if table else robot, str(key)))
    return float(values[sensor[0] if len(values) > 1 else 0])


def study(
    start: Calibration, robots: int, seed: int = 0, period: float = PERIOD
) -> Iterator[list[tuple[FittedValue, float]]]:
    """Yield the fitted values of each robot, each with its true value."""
    for number in range(robots):
        robot = draw_robot(start, stream(seed, "fit_intervals", number, "robot"))
        person = Person(robot, Ruler(), stream(seed, "fit_intervals", number, "person"), period)
        yield [(value, value_in(robot, value)) for value in fit_robot(person.tests(), start, Ruler()).values]


def sessions(start: Calibration, robots: int, seed: int = 0) -> Iterator[list[tuple[FittedValue, float]]]:
    """Yield the same of twins that were calibrated in guided sessions."""
    for number in range(robots):
        rng = stream(seed, "fit_intervals", number, "robot")
        robot = draw_robot(start, rng)
        motors = start.motors.model_dump(exclude={"supply_v"})  # not fitted
        drawn = {key: value * (1 + MOTORS * rng.standard_normal()) for key, value in motors.items()}
        robot = robot.model_copy(update={"motors": start.motors.model_copy(update=drawn)})
        with TemporaryDirectory() as folder:
            path = Path(folder) / "hidden.toml"
            path.write_text(dump(robot), encoding="utf-8")
            twin = open_twin(
                playpen.parse(f"{BENCH}calibration = '{path}'\n", "bench"), TwinOptions(seed=number)
            )
            session = CalibrationSession(Path(folder) / "session")
            with Khepera(Serial.of(twin, timeout=1.0)) as host:
                person = SimulatedPerson(twin, Ruler(), lambda _: None)
                todo = steps(default_model().fit_bench.walls_mm, None, POWER_W, FILAMENT * 1e3)
                session.run(todo, host, person, lambda _: None, lambda: False)
            fit = fit_robot(fit_inputs(session.words_with_folder), start, Ruler())
        yield [(value, value_in(robot, value)) for value in fit.values]


def errors(values: Sequence[tuple[FittedValue, float]]) -> Iterator[tuple[str, float]]:
    """Yield the error of each value in its fitted standard deviation, with its key in the calibration."""
    for value, true in values:
        yield ".".join(filter(None, value.path[:2])), (value.value - true) / (value.interval / CONFIDENCE)


def main(arguments: Sequence[str] | None = None) -> None:
    parser = command_line(__doc__)
    parser.add_argument("--robots", type=int, default=ROBOTS, help="number of hidden robots")
    parser.add_argument("--start", default="khepera1", help="calibration that they are drawn around")
    parser.add_argument("--seed", type=int, default=0, help="seed of the robots")
    parser.add_argument("--sessions", action="store_true", help="calibrate twins in MuJoCo")
    options = parser.parse_args(arguments)
    errors_by_value: dict[str, list[float]] = defaultdict(list)
    widths: dict[str, list[tuple[float, float]]] = defaultdict(list)
    run_study = sessions if options.sessions else study
    for values in run_study(calibration.read(options.start)[0], options.robots, options.seed):
        for name, error in errors(values):
            errors_by_value[name].append(error)
        for value, true in values:
            widths[".".join(filter(None, value.path[:2]))].append(
                (value.interval, value.interval / abs(true))
            )
    print(f"{'value':36}{'number':>8}{'within 95 %':>14}{'rms error/sd':>14}{'95 %, median':>24}")
    errors_by_value["all"] = [error for series in errors_by_value.values() for error in series]
    for name, value_errors in errors_by_value.items():
        within = np.mean(np.abs(value_errors) <= CONFIDENCE)
        width = "{:14.3g} or {:6.1%}".format(*np.median(widths[name], axis=0)) if name in widths else ""
        print(
            f"{name:36}{len(value_errors):8}{within:14.1%}{np.sqrt(np.mean(np.square(value_errors))):14.2f}{width}"
        )
