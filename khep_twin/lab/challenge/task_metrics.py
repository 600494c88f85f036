"""Metrics of challenges in addition to those of a series: wall following, brightness, goals."""

import math
from collections.abc import Sequence

import numpy as np

from khep_twin.clock import NS_PER_S
from khep_twin.episodes import fitness
from khep_twin.lab.experiment import measures
from khep_twin.observers import Observer
from khep_twin.sensing import calibration
from khep_twin.world import World

UNITS = {
    **measures.UNITS,
    "wall_following": "",
    "brightness": "",
    "goals": "",
    "goal_s": "s",
    "goal_share": "of the time",
    "object_mm": "mm",
}
"""Unit of each metric by its name: those of a series of runs, and those of `TaskMetrics`."""


class TaskMetrics(Observer):
    """Observer of one robot that computes the metrics of a challenge.

    Args:
        world: World to observe.
        index: Index of the robot.
        goals: Centre x, y and radius of each goal [m], in the required order.
        movable: Index of the movable object to put into the last goal; None without.
    """

    def __init__(
        self, world: World, index: int, goals: Sequence[tuple[float, float, float]], movable: int | None
    ) -> None:
        self._index = index
        self._goals = goals
        self._movable_index = movable
        entry, sampled = world.playpen.robots[index], world.robots[index].sampled
        self._interface = entry.robot_model.episode_interface
        (self._speeds,) = (list(channel.registers[:2]) for channel in sampled if channel.name == "speed")
        ambient = calibration.read(entry.calibration)[0].ambient
        self._dark, self._bright = ambient.dark_counts, ambient.floor_counts
        self._n_samples = self._n_reached = self._n_at_last_goal = 0
        self._wall_following_sum = self._brightness_sum = 0.0
        self._reached_ns = self._time_ns = self._start_ns = world.time_ns
        self._object_distance = math.inf
        world.add_observer(self)

    def sample(self, world: World) -> None:
        """Update the metrics with the state of the robot."""
        robot = world.robots[self._index]
        registers, (x, y, _) = robot.registers, robot.pose
        self._n_samples += 1
        self._time_ns = world.time_ns
        interface, (lowest, limit) = self._interface, self._interface.counts
        left, right = registers[self._speeds] * (fitness.TOP_SPEED_PULSES / interface.top_speed)
        side_proximity = max(float(registers[list(interface.sides)].max()) - lowest, 0) / (limit - lowest)
        self._wall_following_sum += float(fitness.wall_following(left, right, side_proximity))
        brightest_counts = float(registers[slice(*interface.ambient)].min())
        self._brightness_sum += float(fitness.light_seeking(brightest_counts, self._dark, self._bright))
        is_inside = [math.hypot(x - goal_x, y - goal_y) <= radius for goal_x, goal_y, radius in self._goals]
        if self._n_reached < len(is_inside) and is_inside[self._n_reached]:
            self._n_reached += 1
            self._reached_ns = self._time_ns
        if is_inside:
            self._n_at_last_goal += is_inside[-1]
        if self._movable_index is not None:
            object_x, object_y, _ = np.asarray(world.objects)[self._movable_index].tolist()
            self._object_distance = math.hypot(object_x - self._goals[-1][0], object_y - self._goals[-1][1])

    def metrics(self, limit_s: float) -> dict[str, float]:
        """Return the metrics by name; without all goals reached, `goal_s` is the time limit [s]."""
        are_all_reached = bool(self._goals) and self._n_reached == len(self._goals)
        metrics = {
            "wall_following": self._wall_following_sum / self._n_samples,
            "brightness": self._brightness_sum / self._n_samples,
        }
        if self._goals:
            metrics["goals"] = float(self._n_reached)
            metrics["goal_s"] = (self._reached_ns - self._start_ns) / NS_PER_S if are_all_reached else limit_s
            metrics["goal_share"] = self._n_at_last_goal / self._n_samples
        if self._movable_index is not None:
            metrics["object_mm"] = self._object_distance * 1e3
        return metrics
