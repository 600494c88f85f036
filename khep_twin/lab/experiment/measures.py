"""Metrics of a run.

Metrics of the host's exchanges, each a command and its reply, are available on every port, robot or twin.
Metrics of the ground truth, the simulated state, need a twin in this process. Shares of the readings are
equal on all ports that return the same replies. Times are in the port's time.
"""

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from khep_twin.episodes.fitness import TOP_SPEED_PULSES, obstacle_avoidance
from khep_twin.lab.experiment import run_statistics as statistics
from khep_twin.observers import Observer
from khep_twin.playpen import Playpen
from khep_twin.playpen.polygon import contains
from khep_twin.robots.framing import Framing
from khep_twin.robots.model import RobotModel
from khep_twin.sensing import calibration
from khep_twin.world import World

CELL_SIZE = 0.05
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
"""Unit of each metric by its name; those from `distance_m` on are of the ground truth."""


class HostMetrics:
    """Metrics of the exchanges between a host and its robot in one run, by the registers of its model."""

    def __init__(self, model: RobotModel) -> None:
        self._model = model
        self._interface = model.episode_interface
        self._drive = model.dialect.framing.command(model.dialect.drive(0, 0))
        self._speed = (0, 0)
        self._proximity = np.zeros(0, np.int64)
        self._proximity_readings: list[NDArray[np.int64]] = []
        self._ambient_readings: list[NDArray[np.int64]] = []
        self._cycle_values: list[tuple[float, float]] = []
        self._command_values: list[tuple[float, float]] = []

    def __call__(self, request: str, reply: str) -> None:
        """Add one request and its reply."""
        framing, reads = self._model.dialect.framing, self._model.dialect.reads
        if not framing.answers(request, reply):
            return
        if framing.command(request) == self._drive:
            if len(speeds := parse_values(framing, request)) == 2:
                self._speed = speeds[0], speeds[1]
                if not self._cycle_values:
                    self._command_values.append(self._fitness_and_speed())
            return
        values = parse_values(framing, reply)
        registers: dict[int, int] = {}
        for read in reads.values():
            if (read.request, read.n_values) == (request, len(values)):
                registers |= zip(read.registers, [values[index] for index in read.values], strict=True)
        if self._interface.proximity[0] in registers:
            self._proximity = np.array([registers[index] for index in range(*self._interface.proximity)])
            self._proximity_readings.append(self._proximity)
        if self._interface.ambient[0] in registers:
            counts = np.array([registers[index] for index in range(*self._interface.ambient)])
            self._ambient_readings.append(counts)

    def end_cycle(self) -> None:
        """End a cycle of the controller, at which its fitness is computed."""
        self._cycle_values.append(self._fitness_and_speed())

    def _fitness_and_speed(self) -> tuple[float, float]:
        """Return the current fitness and mean speed [pulses/10 ms]."""
        interface, (left, right) = self._interface, self._speed
        scale, (none, full) = TOP_SPEED_PULSES / interface.top_speed, interface.counts
        nearest = (self._proximity.max(initial=none) - none) / (full - none)
        fitness = obstacle_avoidance(left * scale, right * scale, float(nearest))
        return float(fitness), (left + right) / 2 / interface.speed_per_pulse

    def metrics(self) -> dict[str, float]:
        """Return the metrics by name, without those of sensors that were not read.

        A `LoopingController` has no cycle callback, so each of its speed commands counts as a cycle.
        """
        metrics: dict[str, float] = {}
        if cycles := self._cycle_values or self._command_values:
            fitnesses, speeds = zip(*cycles, strict=True)
            metrics["fitness"] = math.fsum(fitnesses) / len(fitnesses)
            metrics["speed_mean"] = math.fsum(speeds) / len(speeds)
        if self._proximity_readings:
            counts = np.array(self._proximity_readings)
            metrics["near_share"] = float((counts.max(axis=1) > self._model.body.near_counts).mean())
            metrics["proximity_mean"], metrics["proximity_max"] = float(counts.mean()), float(counts.max())
        if self._ambient_readings:
            counts = np.array(self._ambient_readings)
            metrics["ambient_mean"], metrics["ambient_min"] = float(counts.mean()), float(counts.min())
        return {name: metrics[name] for name in UNITS if name in metrics}


class GroundTruthMetrics(Observer):
    """Observer that records the ground truth of one robot from its creation to `end`."""

    def __init__(self, world: World, robot_index: int) -> None:
        self._world = world
        self._robot_index = robot_index
        self._times_ns: list[int] = []
        self._poses: list[tuple[float, float, float]] = []
        self._counts: list[NDArray[np.int64]] = []
        channels = {channel.name: channel.registers for channel in world.robots[robot_index].sampled}
        self._sensor_registers = [*channels["proximity"], *channels["ambient"]]
        self._n_around = len(world.playpen.robots[robot_index].body.sensor_positions)
        # Read the calibration before a controller may change the working directory.
        robot_entry = world.playpen.robots[robot_index]
        self._dark = np.array(calibration.read(robot_entry.calibration)[0].ambient.dark_counts)
        world.add_observer(self)
        self.sample(world)

    def sample(self, world: World) -> None:
        """Record the robot's pose and sensor values."""
        if self._times_ns and self._times_ns[-1] == world.time_ns:
            return
        robot = world.robots[self._robot_index]
        self._times_ns.append(world.time_ns)
        self._poses.append(robot.pose)
        self._counts.append(robot.registers[self._sensor_registers])  # a copy

    def end(self) -> None:
        """Record the last sample and remove the observer."""
        self._world.observers.remove(self)
        self.sample(self._world)

    def metrics(self) -> dict[str, float]:
        """Return the metrics by name."""
        times_s, pose = np.array(self._times_ns) / 1e9, np.array(self._poses)
        all_counts = np.hsplit(np.array(self._counts), 2)
        proximity, ambient = (counts[:, : self._n_around] for counts in all_counts)
        playpen = self._world.playpen
        body = playpen.robots[self._robot_index].body
        motion = statistics.motion(times_s, pose)
        collisions = statistics.collisions(times_s, pose, playpen, body.radius)
        return {
            "distance_m": motion.distance,
            "mean_speed_m_per_s": motion.mean_speed,
            "turn_rate_rad_per_s": (motion.left_turn + motion.right_turn) / (motion.duration_s or math.inf),
            "near_s": statistics.near(times_s, proximity, body.near_counts).total_s,
            "collisions": float(len(collisions.times_s)),
            "collision_s": collisions.total_s,
            "light_gained": statistics.light(times_s, ambient, self._dark).mean,
            "coverage": coverage(pose[:, :2], playpen, body.radius),
        }


def coverage(positions: statistics.Floats, playpen: Playpen, radius: float) -> float:
    """Return the visited share of the cells whose centre has room for the robot; positions (n, 2) [m]."""
    xs, ys = (np.array(coordinates) / 1e3 for coordinates in zip(*playpen.arena.corners, strict=True))
    n_cells = [max(1, math.ceil(float(np.ptp(coordinates)) / CELL_SIZE - 1e-9)) for coordinates in (xs, ys)]
    corner = np.array([xs.min(), ys.min()])
    columns, rows = np.meshgrid(np.arange(n_cells[0]), np.arange(n_cells[1]), indexing="ij")
    cells = np.column_stack([columns.ravel(), rows.ravel()]).astype(np.float64)
    centres = corner + (cells + 0.5) * CELL_SIZE
    inside = np.array([contains(playpen.arena.corners, x * 1e3, y * 1e3) for x, y in centres.tolist()])
    free = inside & (statistics.clearance(centres, playpen) >= radius)
    cell_indices = np.clip(((positions - corner) // CELL_SIZE).astype(np.int64), 0, np.array(n_cells) - 1)
    visited = np.unique(cell_indices[:, 0] * n_cells[1] + cell_indices[:, 1])
    return float(free[visited].sum() / free.sum()) if free.any() else 0.0


def parse_values(framing: Framing, text: str) -> Sequence[int]:
    """Return the numbers in a message; none for a garbled one."""
    try:
        return framing.values(text)
    except ValueError:
        return ()
