"""Metrics of a run.

Metrics of the host's exchanges are available on every port, robot or twin, those of the ground truth only for
a twin in this process. Metrics that depend on how many readings a host takes, such as a share of them, are
the same on any port that gives the same answers; times are the port's own.
"""

import math

import numpy as np
from numpy.typing import NDArray

from khep_twin import units
from khep_twin.board.kernel import AMBIENT, PROXIMITY
from khep_twin.episodes.fitness import obstacle_avoidance
from khep_twin.lab.experiment import run_statistics as statistics
from khep_twin.playpen import Playpen
from khep_twin.playpen.polygon import contains
from khep_twin.sensing import calibration
from khep_twin.world import Observer, World

CELL = 0.05
"""Side of a coverage cell [m]: about the robot's diameter."""

UNITS = {
    "fitness": "",
    "near_share": "of readings",
    "proximity_max": "counts",
    "proximity_mean": "counts",
    "ambient_mean": "counts",
    "ambient_min": "counts",
    "speed_mean": "pulses/10 ms",
    "distance_m": "m",
    "mean_speed_m_per_s": "m/s",
    "turn_rate_rad_per_s": "rad/s",
    "near_s": "s",
    "collisions": "",
    "collision_s": "s",
    "light_gained": "counts",
    "coverage": "of the floor",
}
"""Unit of each metric by its name; those of the ground truth begin with the distance."""


class HostMetrics:
    """Metrics of the exchanges between a host and its robot in one run."""

    def __init__(self) -> None:
        self._speed = (0, 0)
        self._proximity: tuple[int, ...] | None = None
        self._readings: list[tuple[int, ...]] = []
        self._lights: list[tuple[int, ...]] = []
        self._cycles: list[tuple[float, float]] = []
        self._commands: list[tuple[float, float]] = []

    def __call__(self, request: str, reply: str) -> None:
        """Add one exchange of the line."""
        if (speed := _numbers(request, "D", 2)) and reply == "d":
            self._speed = speed[0], speed[1]
            if not self._cycles:
                self._commands.append(self._driven())
        elif request == "N" and (counts := _numbers(reply, "n", 8)):
            self._proximity = counts
            self._readings.append(counts)
        elif request == "O" and (counts := _numbers(reply, "o", 8)):
            self._lights.append(counts)

    def end_cycle(self) -> None:
        """End a cycle of the controller, at which its fitness is computed."""
        self._cycles.append(self._driven())

    def _driven(self) -> tuple[float, float]:
        """Return fitness and mean speed [pulses/10 ms] of now."""
        left, right = self._speed
        nearest = max(self._proximity or (0,)) / units.COUNTS_LIMIT
        return obstacle_avoidance(left, right, nearest), (left + right) / 2

    def metrics(self) -> dict[str, float]:
        """Return the metrics by name; those of sensors that were not read are left out.

        A controller that loops by itself ends no cycle: each of its speed commands counts as one.
        """
        found: dict[str, float] = {}
        if cycles := self._cycles or self._commands:
            each_fitness, each_speed = zip(*cycles, strict=True)
            found["fitness"] = math.fsum(each_fitness) / len(each_fitness)
            found["speed_mean"] = math.fsum(each_speed) / len(each_speed)
        if self._readings:
            counts = np.array(self._readings)
            found["near_share"] = float((counts.max(axis=1) > statistics.NEAR_COUNTS).mean())
            found["proximity_mean"], found["proximity_max"] = float(counts.mean()), float(counts.max())
        if self._lights:
            counts = np.array(self._lights)
            found["ambient_mean"], found["ambient_min"] = float(counts.mean()), float(counts.min())
        return {name: found[name] for name in UNITS if name in found}


class GroundTruthMetrics(Observer):
    """Observer that records the ground truth of one run of one robot, from now on."""

    def __init__(self, world: World, index: int) -> None:
        self._world, self._index = world, index
        self._times_ns: list[int] = []
        self._poses: list[tuple[float, float, float]] = []
        self._counts: list[NDArray[np.int64]] = []
        self._columns = [*PROXIMITY, *AMBIENT]
        # Now, as a controller may go to another folder.
        entry = world.playpen.robots[index]
        self._dark = np.array(calibration.read(entry.calibration)[0].ambient.dark_counts)
        world.add_observer(self)
        self.sample(world)

    def sample(self, world: World) -> None:
        """Record the robot's pose and sensor values."""
        if self._times_ns and self._times_ns[-1] == world.time_ns:
            return
        robot = world.robots[self._index]
        self._times_ns.append(world.time_ns)
        self._poses.append(robot.pose)
        self._counts.append(robot.registers[self._columns])  # a copy

    def end(self) -> None:
        """Record the last sample and remove the observer."""
        self._world.observers.remove(self)
        self.sample(self._world)

    def metrics(self) -> dict[str, float]:
        """Return the metrics by name."""
        times_s, pose = np.array(self._times_ns) / 1e9, np.array(self._poses)
        proximity, ambient = np.hsplit(np.array(self._counts), 2)
        playpen = self._world.playpen
        entry = playpen.robots[self._index]
        radius = units.BODIES[entry.model].radius
        motion = statistics.motion(times_s, pose)
        collisions = statistics.collisions(times_s, pose, playpen, radius)
        return {
            "distance_m": motion.distance,
            "mean_speed_m_per_s": motion.mean_speed,
            "turn_rate_rad_per_s": (motion.left_turn + motion.right_turn) / (motion.duration_s or math.inf),
            "near_s": statistics.near(times_s, proximity).total_s,
            "collisions": float(len(collisions.times_s)),
            "collision_s": collisions.total_s,
            "light_gained": statistics.light(times_s, ambient, self._dark).mean,
            "coverage": coverage(pose[:, :2], playpen, radius),
        }


def coverage(positions: statistics.Floats, playpen: Playpen, radius: float) -> float:
    """Return the share of cells that a robot's centre visited, of those with room for it in their middle.

    The centre's positions (n, 2) and the robot's radius are in [m].
    """
    xs, ys = (np.array(each) / 1e3 for each in zip(*playpen.arena.corners, strict=True))
    counts = [max(1, math.ceil(float(np.ptp(each)) / CELL - 1e-9)) for each in (xs, ys)]
    corner = np.array([xs.min(), ys.min()])
    columns, rows = np.meshgrid(np.arange(counts[0]), np.arange(counts[1]), indexing="ij")
    cells = np.column_stack([columns.ravel(), rows.ravel()]).astype(np.float64)
    middles = corner + (cells + 0.5) * CELL
    inside = np.array([contains(playpen.arena.corners, x * 1e3, y * 1e3) for x, y in middles.tolist()])
    free = inside & (statistics.clearance(middles, playpen) >= radius)
    been = np.clip(((positions - corner) // CELL).astype(np.int64), 0, np.array(counts) - 1)
    visited = np.unique(been[:, 0] * counts[1] + been[:, 1])
    return float(free[visited].sum() / free.sum()) if free.any() else 0.0


def _numbers(line: str, letter: str, count: int) -> tuple[int, ...] | None:
    """Return a line's numbers, None for another or a garbled line."""
    head, *fields = line.split(",")
    if head != letter or len(fields) != count:
        return None
    try:
        return tuple(int(field) for field in fields)
    except ValueError:
        return None
