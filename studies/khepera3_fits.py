"""Fit of the infrared optics of a Khepera III to recordings before a white obstacle, and a comparison.

The recordings are a table of means and standard deviations of ten readings at steps away from the obstacle,
above a black and a white floor. It is not part of the project; the first argument is its path.

Only rows above the black floor are fitted, without each third position. Of those above the white floor, the
ones far from the obstacle give the light of the floor. The obstacle's size is not recorded: readings fall as
before a low one, and heights from 45 to 70 mm fit about as well. `--compare` compares all rows with a robot
of the shipped calibration in MuJoCo's scene.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from khep_twin import playpen
from khep_twin.playpen.surfaces import BUILT_IN_SURFACES
from khep_twin.playpen_to_mjcf import to_spec
from khep_twin.robots.registry import find_model
from khep_twin.sensing import calibration, lobes
from khep_twin.sensing.mujoco_scene import MujocoScene
from khep_twin.sensing.optics import proximity_counts
from khep_twin.sensing.reflection import Lobe, reflected_light
from khep_twin.sensing.robot_indices import RobotIndices
from khep_twin.sensing.seen_surfaces import N_COLUMNS, N_SURFACES, Chip, add_upright
from khep_twin.sensors import robot_sensors
from tools.command_table import command_line

Floats = NDArray[np.float64]

PAIRS = ((2, 5), (3, 4))
"""Sensors that see the obstacle, at 45 degrees and in front. A pair has one offset."""

LENGTH, HEIGHT = 0.4, 0.05
"""Size of the obstacle [m]: as high as a wall of a playpen (both assumed)."""

FRONT = 0.0675
"""Distance of the robot's front edge from the axle [m]."""

FAR_MM = 300.0
"""Distance from which on readings are those of the floor alone [mm]."""

LOBE, ELEVATION, MIRROR = 6.0, 7, 2.0
"""Exponents in azimuth and in elevation, and weight of the images in a white floor, which mirrors on the way
there and on the way back: assumed. Exponents from 2 to 6 and from 5 to 7 fit about as well; sensors at 77
degrees, which see nothing of the obstacle, require a narrow lobe."""

MODEL = find_model("khepera3")
HEADINGS_DEG = calibration.read(MODEL.calibration)[0].heading_deg
BLACK = BUILT_IN_SURFACES["black"].reflectance
_LIMIT, _DEPTH = 3980, 0.02

PEN = """version = 1
name = "recording"
[arena]
width_mm = 4000
height_mm = 4000
[[block]]
x_mm = {x_mm}
y_mm = 2000
length_mm = {depth_mm}
width_mm = {length_mm}
height_mm = {height_mm}
surface = "white"
[[patch]]
x_mm = 2000
y_mm = 2000
length_mm = 4000
width_mm = 4000
surface = "{floor}"
[[robot]]
model = "khepera3"
x_mm = 1000
y_mm = 2000
heading_deg = 0
"""
"""Playpen with the obstacle, 1 m ahead of the robot."""


@dataclass(frozen=True, slots=True)
class Recording:
    """Readings of the sensors around the robot, above one floor.

    Attributes:
        positions: Numbers of the positions (n,).
        gaps: Distances from the first position, where the front edge meets the obstacle (assumed) (n,) [mm].
        means: Mean readings (n, 9) [counts].
        deviations: Standard deviations of one reading (n, 9) [counts].
    """

    positions: NDArray[np.int64]
    gaps: Floats
    means: Floats
    deviations: Floats

    @classmethod
    def read(cls, path: Path, floor: str) -> "Recording":
        """Read the rows of a floor."""
        table = np.genfromtxt(path, delimiter=",", names=True, dtype=None, encoding="utf-8")
        rows = table[table["floor"] == floor]
        means, deviations = (
            np.column_stack([rows[f"s{sensor}_{kind}"] for sensor in range(9)]).astype(np.float64)
            for kind in ("mean", "sd")
        )
        return cls(rows["position"].astype(np.int64), rows["steps_from_first_mm"] * 1.0, means, deviations)

    def __getitem__(self, rows: NDArray[np.bool_]) -> "Recording":
        """Return a part of the rows."""
        return Recording(self.positions[rows], self.gaps[rows], self.means[rows], self.deviations[rows])

    @property
    def is_fitted(self) -> NDArray[np.bool_]:
        """Whether a row may be fitted: each third one is not (n,)."""
        return self.positions % 3 != 0

    def is_met(self, sensor: int, counts: Floats) -> NDArray[np.bool_]:
        """Return whether counts are within 10 % or three standard deviations of a sensor's means (n,)."""
        means = self.means[:, sensor]
        return np.abs(counts - means) <= np.maximum(0.1 * means, 3 * self.deviations[:, sensor])


@dataclass(frozen=True, slots=True)
class Optics:
    """Optics of a sensor: gain [counts m^2], offset [m], and counts of the floor."""

    gain: float
    offset: float
    rest: float


def light(sensor: int, optics: Optics, gaps: Floats, reflectance: float) -> Floats:
    """Return the light from the obstacle to a sensor above a floor (n,) [1/m^2].

    Args:
        sensor: Number of the sensor.
        optics: Its optics.
        gaps: Distances of the obstacle from the robot's front edge (n,) [mm].
        reflectance: Reflectance of the floor.
    """
    body, heading = MODEL.body, math.radians(HEADINGS_DEG[sensor])
    (x, y), c, s = body.sensor_positions[sensor], math.cos(heading), math.sin(heading)
    chip = Chip(x - optics.offset * c, y - optics.offset * s, c, s, body.sensor_height, 5.0)
    norm, narrowing = lobes.norm(LOBE), ELEVATION // 2 - 1
    width, table = lobes.width(LOBE) / norm, lobes.table(LOBE)
    lobe = Lobe(int(LOBE), LOBE % 1, norm, width, table, narrowing, MIRROR * reflectance)
    buffer, lights = [0.0] * (N_SURFACES * N_COLUMNS), list[float]()
    for gap in gaps.tolist():
        centre = FRONT + gap * 1e-3 + _DEPTH, 0.0
        shape = centre, (1.0, 0.0), (_DEPTH, LENGTH / 2), (0.0, HEIGHT)
        count = add_upright(buffer, 0, chip, shape, 1.0)
        lights.append(reflected_light(buffer, count, chip, lobe) if count else 0.0)
    return np.array(lights)


def counts(sensor: int, optics: Optics, gaps: Floats, reflectance: float) -> Floats:
    """Return the mean readings of a sensor (n,) [counts]; the arguments are those of `light`."""
    level = np.maximum(optics.gain * light(sensor, optics, gaps, reflectance) + optics.rest, 0)
    return level / (1 + (level / _LIMIT) ** 4) ** 0.25


def fit(black: Recording) -> dict[int, Optics]:
    """Return the optics of the sensors that see the obstacle, from rows above the black floor."""
    # Half of 10 %, and twice the noise; far rows are many and alike.
    used = black[(black.gaps < 120) | (black.positions % 5 == 0)]
    rests = black[black.gaps >= FAR_MM].means.mean(axis=0)
    fitted: dict[int, Optics] = {}
    for pair in PAIRS:

        def split(x: Floats, pair: Sequence[int] = pair) -> dict[int, Optics]:
            return {s: Optics(x[1 + i], x[0] * 0.01, rests[s] + x[3 + i]) for i, s in enumerate(pair)}

        def residuals(x: Floats, pair: Sequence[int] = pair) -> Floats:
            errors: list[Floats] = []
            for sensor, optics in split(x, pair).items():
                means = used.means[:, sensor]
                errors.append(
                    (counts(sensor, optics, used.gaps, BLACK) - means) / np.maximum(0.05 * means, 6)
                )
            squares = np.concatenate(errors) ** 2
            # The square root of a loss that is linear for outliers.
            return np.concatenate([np.sqrt(2 * (np.sqrt(1 + squares) - 1)), [0.2 * (x[0] - 0.5)], x[3:]])

        start = [0.4, 1.0, 1.0, 0.0, 0.0]
        low, high = [0.05, 0.1, 0.1, -5, -5], [2.5, 20, 20, 5, 5]
        fitted |= split(least_squares(residuals, start, bounds=(low, high), diff_step=1e-3).x)
    return dict(sorted(fitted.items()))


def floors(optics: Mapping[int, Optics], black: Recording, white: Recording) -> tuple[Floats, Floats]:
    """Return the counts of a white floor, and of a black one, without an obstacle, each (9,)."""
    rests: list[Floats] = []
    for recording, reflectance in ((white, 1.0), (black, BLACK)):
        far = recording[recording.gaps >= FAR_MM]
        rest = far.means.mean(axis=0)
        for sensor, fitted in optics.items():
            rest[sensor] -= fitted.gain * light(sensor, fitted, far.gaps, reflectance).mean()
        rests.append(rest)
    return rests[0], rests[1]


def scene_counts(gaps: Floats, floor: str, draw: float = 0.0) -> dict[int, Floats]:
    """Return the readings of the robot in MuJoCo's scene, by sensor, each (n,) [counts].

    Args:
        gaps: Distances of the obstacle from the robot's front edge (n,) [mm].
        floor: Surface of the floor.
        draw: Draw of the noise, in standard deviations.
    """
    sizes = {"depth_mm": 2e3 * _DEPTH, "length_mm": 1e3 * LENGTH, "height_mm": 1e3 * HEIGHT}
    pen = playpen.parse(PEN.format(x_mm=3000 + 1e3 * _DEPTH, floor=floor, **sizes), "recording")
    model = to_spec(pen).compile()
    data = mujoco.MjData(model)
    indices = RobotIndices.of(model, "khepera0")
    sensors = robot_sensors(model, indices, calibration.read(pen.robots[0].calibration)[0])
    readings: dict[int, list[int]] = {sensor: [] for sensor in range(9)}
    for gap in gaps.tolist():
        data.qpos[indices.pose] = 3.0 - FRONT - gap * 1e-3
        mujoco.mj_forward(model, data)
        scene = MujocoScene(model, data)
        for sensor, values in readings.items():
            noise = draw * sensors.proximity.noise[sensor]
            values.append(proximity_counts(scene, sensors, sensor, noise, 0, 1.0, 0.0))
    return {sensor: np.array(values, np.float64) for sensor, values in readings.items()}


def show_shares(title: str, recording: Recording, readings: Mapping[int, Floats]) -> None:
    """Print the share of rows that readings meet, by sensor and in all."""
    shares = {sensor: recording.is_met(sensor, values).mean() for sensor, values in readings.items()}
    text = ", ".join(f"{sensor} {share:.0%}" for sensor, share in shares.items())
    print(f"{title:24} {text}, all {np.mean(list(shares.values())):.1%}")


def show_calibration(optics: Mapping[int, Optics], rests: tuple[Floats, Floats]) -> None:
    """Print the values of the calibration; other sensors are like those at 45 degrees."""
    floor_light = (rests[0] - rests[1]) / (1 - BLACK)
    pair = {sensor: optics[sensor] for sensor in PAIRS[0]}
    gain = math.exp(np.mean([math.log(known.gain / floor_light[s]) for s, known in pair.items()]))
    offset = optics[PAIRS[0][0]].offset
    every = [optics.get(s, Optics(gain * light, offset, 0)) for s, light in enumerate(floor_light)]
    print("gain_counts_mm2 =", [round(float(known.gain) * 1e6, -3) for known in every])
    print("threshold_counts =", (-np.round(rests[0], 1)).tolist())
    print("floor_light_counts =", np.round(floor_light, 1).tolist())
    print("offset_mm =", [round(float(known.offset) * 1e3, 1) for known in every])


def main() -> None:
    parser = command_line(__doc__)
    parser.add_argument("recordings", type=Path, help="table of the recordings")
    parser.add_argument("--compare", action="store_true", help="compare all rows with a scene in MuJoCo")
    options = parser.parse_args()
    recordings = {floor: Recording.read(options.recordings, floor) for floor in ("black", "white")}
    if options.compare:
        for floor, recording in recordings.items():
            readings = scene_counts(recording.gaps, floor)
            for title, rows in (("fitted", recording.is_fitted), ("held out", ~recording.is_fitted)):
                part = {sensor: values[rows] for sensor, values in readings.items()}
                show_shares(f"{floor} floor, {title}", recording[rows], {s: part[s] for s in (2, 3, 4, 5)})
                show_shares(f"{floor} floor, {title}", recording[rows], part)
        return
    black, white = (recording[recording.is_fitted] for recording in recordings.values())
    optics = fit(black)
    rests = floors(optics, black, white)
    show_calibration(optics, rests)
    show_shares("black floor", black, {s: counts(s, o, black.gaps, BLACK) for s, o in optics.items()})
    above_white = {s: Optics(o.gain, o.offset, rests[0][s]) for s, o in optics.items()}
    show_shares("white floor", white, {s: counts(s, o, white.gaps, 1.0) for s, o in above_white.items()})
