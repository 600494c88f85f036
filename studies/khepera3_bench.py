"""Recordings of a Khepera III's infrared sensors before a white obstacle, and a twin of their bench.

The recordings are a table of means and standard deviations of ten readings at steps away from the obstacle,
above a black and a white floor. Size and place of the obstacle are not recorded: `khepera3_fits` fits the
place.
"""

import math
from dataclasses import asdict, dataclass
from pathlib import Path

import mujoco
import numpy as np
from numpy.typing import NDArray

from khep_twin import playpen
from khep_twin.playpen_to_mjcf import to_spec
from khep_twin.sensing import calibration
from khep_twin.sensing.mujoco_scene import MujocoScene
from khep_twin.sensing.optics import proximity_counts
from khep_twin.sensing.robot_indices import RobotIndices
from khep_twin.sensing.seen_surfaces import Upright
from khep_twin.sensors import robot_sensors

Floats = NDArray[np.float64]

WIDTH, DEPTH, HEIGHT = 0.4, 0.04, 0.05
"""Size of the obstacle [m] (assumed: this height and widths from 250 mm fit best)."""

FRONT = 0.0675
"""Distance of the robot's front edge from the axle [m]."""

PEN = """version = 1
name = "recording"
[arena]
width_mm = 4000
height_mm = 4000
[[block]]
x_mm = {x_mm}
y_mm = {y_mm}
angle_deg = {angle_deg}
length_mm = 40
width_mm = 400
height_mm = 50
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
"""Playpen with the obstacle, whose place is relative to a robot at x = 3 m."""


@dataclass(frozen=True, slots=True)
class Recording:
    """Readings of the sensors around the robot, above one floor.

    Attributes:
        positions: Numbers of the positions (n,).
        gaps: Distances from the first position (n,) [mm].
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

    @property
    def tolerances(self) -> Floats:
        """10 % or three standard deviations (n, 9) [counts]."""
        return np.maximum(0.1 * self.means, 3 * self.deviations)

    def is_met(self, sensor: int, counts: Floats) -> NDArray[np.bool_]:
        """Return whether counts of a sensor are within the tolerances (n,)."""
        return np.abs(counts - self.means[:, sensor]) <= self.tolerances[:, sensor]


@dataclass(frozen=True, slots=True)
class Bench:
    """Place of the obstacle before the robot at the first position.

    Attributes:
        gap_mm: Gap from the robot's front edge [mm].
        angle_deg: Direction of the perpendicular from the axle to the obstacle, to the left of the heading.
        left_mm: Distance of the left edge from the foot of the perpendicular [mm].
    """

    gap_mm: float
    angle_deg: float
    left_mm: float

    @property
    def shape(self) -> Upright:
        """Obstacle in the robot's frame at the first position."""
        angle, left = math.radians(self.angle_deg), self.left_mm * 1e-3 - WIDTH / 2
        c, s, distance = math.cos(angle), math.sin(angle), FRONT + self.gap_mm * 1e-3 + DEPTH / 2
        centre = distance * c - left * s, distance * s + left * c
        return centre, (c, s), (DEPTH / 2, WIDTH / 2), (0.0, HEIGHT)

    def pen(self, floor: str) -> playpen.Playpen:
        """Return the playpen with the obstacle on a floor."""
        (x, y), *_ = self.shape
        return playpen.parse(
            PEN.format(x_mm=3000 + 1e3 * x, y_mm=2000 + 1e3 * y, floor=floor, **asdict(self)), "recording"
        )


BENCHES = {"black": Bench(0.4, 2.3, 66.1), "white": Bench(1.5, 2.9, 95.3)}
"""Place of the obstacle in the recording above each floor, as fitted."""


def scene_counts(gaps: Floats, floor: str, draw: float = 0.0) -> dict[int, Floats]:
    """Return the readings of the robot in MuJoCo's scene, by sensor, each (n,) [counts].

    Args:
        gaps: Distances from the first position (n,) [mm].
        floor: Surface of the floor, which has a recording.
        draw: Draw of the noise, in standard deviations.
    """
    pen = BENCHES[floor].pen(floor)
    model = to_spec(pen).compile()
    data = mujoco.MjData(model)
    indices = RobotIndices.of(model, "khepera0")
    sensors = robot_sensors(model, indices, calibration.read(pen.robots[0].calibration)[0])
    readings: dict[int, list[int]] = {sensor: [] for sensor in range(9)}
    for gap in gaps.tolist():
        data.qpos[indices.pose] = 3.0 - gap * 1e-3
        mujoco.mj_forward(model, data)
        scene = MujocoScene(model, data)
        for sensor, values in readings.items():
            noise = draw * sensors.proximity.noise[sensor]
            values.append(proximity_counts(scene, sensors, sensor, noise, 0, 1.0, 0.0))
    return {sensor: np.array(values, np.float64) for sensor, values in readings.items()}
