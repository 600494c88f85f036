"""Metrics of a challenge that a series of runs does not have: along walls, in the light, at goals."""

import math
from collections.abc import Sequence

import numpy as np

from khep_twin.board.kernel import AMBIENT, PROXIMITY, SPEEDS
from khep_twin.clock import NS_PER_S
from khep_twin.episodes import fitness
from khep_twin.lab.experiment import measures
from khep_twin.sensing import calibration
from khep_twin.units import COUNTS_LIMIT, Sensor
from khep_twin.world import Observer, World

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

_SIDES = [PROXIMITY[Sensor.LEFT_90], PROXIMITY[Sensor.RIGHT_90]]


class TaskMetrics(Observer):
    """Observer of one robot that computes the metrics of a challenge.

    Args:
        world: World to observe from now on.
        index: Index of the robot.
        goals: Centre x, y and radius of each goal, in the order in which they are to be reached [m].
        movable: Index of the movable object that belongs into the last goal; None without.
    """

    def __init__(
        self, world: World, index: int, goals: Sequence[tuple[float, float, float]], movable: int | None
    ) -> None:
        self._index, self._goals, self._movable = index, goals, movable
        ambient = calibration.read(world.playpen.robots[index].calibration)[0].ambient
        self._dark, self._floor = ambient.dark_counts, ambient.floor_counts
        self._samples = self._reached = self._at_last = 0
        self._following = self._brightness = 0.0
        self._reached_ns = self._time_ns = self._begin_ns = world.time_ns
        self._away = math.inf
        world.add_observer(self)

    def sample(self, world: World) -> None:
        """Add the state of the robot to the sums."""
        robot = world.robots[self._index]
        registers, (x, y, _) = robot.registers, robot.pose
        self._samples += 1
        self._time_ns = world.time_ns
        left, right = (float(speed) for speed in registers[SPEEDS])
        side = float(registers[_SIDES].max()) / COUNTS_LIMIT
        self._following += float(fitness.wall_following(left, right, side))
        darkest = float(registers[AMBIENT].min())
        self._brightness += float(fitness.light_seeking(darkest, self._dark, self._floor))
        within = [math.hypot(x - goal_x, y - goal_y) <= radius for goal_x, goal_y, radius in self._goals]
        if self._reached < len(within) and within[self._reached]:
            self._reached += 1
            self._reached_ns = self._time_ns
        if within:
            self._at_last += within[-1]
        if self._movable is not None:
            object_x, object_y, _ = np.asarray(world.objects)[self._movable].tolist()
            self._away = math.hypot(object_x - self._goals[-1][0], object_y - self._goals[-1][1])

    def metrics(self, limit_s: float) -> dict[str, float]:
        """Return the metrics by name; a goal that was not reached counts with the time limit [s]."""
        all_reached = bool(self._goals) and self._reached == len(self._goals)
        found = {
            "wall_following": self._following / self._samples,
            "brightness": self._brightness / self._samples,
        }
        if self._goals:
            found["goals"] = float(self._reached)
            found["goal_s"] = (self._reached_ns - self._begin_ns) / NS_PER_S if all_reached else limit_s
            found["goal_share"] = self._at_last / self._samples
        if self._movable is not None:
            found["object_mm"] = self._away * 1e3
        return found
