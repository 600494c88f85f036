"""Bodies of many planar twins of one robot, each with separate wheels, motors and obstacles."""

import math
from collections.abc import Iterable, Sequence
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from khep_twin import units
from khep_twin.board import battery, kernel
from khep_twin.episodes.episode_setup import EpisodeSetup
from khep_twin.episodes.planar import plane as planar
from khep_twin.episodes.planar.planar_world import PlanarForms
from khep_twin.errors import PlaypenError
from khep_twin.simulation.ready import module_of

Floats = NDArray[np.float64]
Booleans = NDArray[np.bool_]

TICK_NS = units.TICK_NS
"""Step of the twins [ns]."""

N_SPARE = 1
"""Spare obstacles of each twin, out of reach until a fault uses them."""

_EMPTY = np.zeros((0, 0))
"""Table without rows."""

_ROWS = "obstacles", "_order", "robots", "registers", "processor", "strength"
"""Arrays that have a row for each twin."""

AWAY = 1e3
"""Position of obstacles that are not in the playpen [m]."""


class PlanarBodies:
    """Bodies of planar twins of one robot, without noise; all arrays have a row for each twin.

    Args:
        setup: Playpen with the robot, prepared for the plane.
        forms: Its forms in the plane.
        count: Number of twins.

    Attributes:
        obstacles: Obstacles (n, n_obstacles + N_SPARE, planar.N_COLUMNS).
        robots: Records of `PlanarRobot` (n,).
        registers: States of the boards (n, N_REGISTERS).
        processor: States of the processors (n, N_PROCESSOR).
        strength: Shares of the motors' torque, left and right (n, 2); negative for a blocked wheel.
    """

    def __init__(self, setup: EpisodeSetup, forms: PlanarForms, count: int) -> None:
        self._compiled: Any = module_of("shadow")
        state = forms.robot_states()[0]
        obstacles, order, _, bodies, *_, robot = forms.compiled()
        if len(bodies):
            problem = f"{setup.playpen.name}: {len(bodies)} movable objects"
            raise PlaypenError(f"{problem}; expected none in the playpen of a shadow")
        spare = np.zeros((N_SPARE, planar.N_COLUMNS))
        spare[:, [planar.CENTRE_X, planar.COSINE, planar.HALF_WIDTH, planar.BODY]] = (AWAY, 1.0, -1.0, -1.0)
        self._scene: Floats = np.concatenate([obstacles, spare])
        self.obstacles: Floats = np.repeat(self._scene[None], count, axis=0)
        self._order = np.repeat(np.concatenate([order, len(order) + np.arange(N_SPARE)])[None], count, axis=0)
        self._near = np.zeros_like(self._scene)
        self.robots: Any = np.repeat(robot, count)
        self.registers: NDArray[np.int64] = np.zeros((count, kernel.N_REGISTERS), np.int64)
        kernel.reset(self.registers[0].data)
        self.registers[:] = self.registers[0]
        self.processor: NDArray[np.int64] = np.zeros((count, kernel.N_PROCESSOR), np.int64)
        self.processor[:, kernel.POWERED] = 1
        self.strength: Floats = np.ones((count, 2))
        self._motor_constant = state.motor_constant
        self._used_min = state.used_min
        self._nominal_robot = robot[0].copy()
        self.ticks = 0

    def __len__(self) -> int:
        return len(self.robots)

    def select(self, indices: NDArray[np.intp] | slice) -> Self:
        """Return copies of twins at these indices, or views of those of a slice."""
        return self._with_rows(getattr(self, name)[indices] for name in _ROWS)

    def concatenate(self, other: Self) -> Self:
        """Return these twins and others of the same time."""
        return self._with_rows(np.concatenate([getattr(self, name), getattr(other, name)]) for name in _ROWS)

    def _with_rows(self, rows: Iterable[NDArray[Any]]) -> Self:
        """Return twins in the same playpen with these arrays, in the order of _ROWS."""
        bodies = object.__new__(type(self))
        bodies.__dict__.update(self.__dict__)
        bodies.__dict__.update(zip(_ROWS, rows, strict=True))
        return bodies

    @property
    def _scene_arrays(self) -> tuple[Any, ...]:
        return self.obstacles, self._order, self._near, _EMPTY, self.robots

    @property
    def poses(self) -> Floats:
        """Poses x, y [m] and heading [rad], which is not wrapped (n, 3)."""
        return self.robots["joints"][:, :3].copy()

    @property
    def push_directions(self) -> Floats:
        """Unit vectors x, y in which obstacles push the twins, or 0 without one (n, 2)."""
        forward, sideways = self.robots["impulses"][:, [planar.PUSHED, planar.PUSHED_ASIDE]].T
        heading = self.robots["joints"][:, planar.HEADING]
        direction = (forward + 1j * sideways) * np.exp(1j * heading)
        direction /= np.where(direction == 0, 1, np.abs(direction))
        return np.stack([direction.real, direction.imag], axis=1)

    def reset_poses(self, poses: Floats) -> None:
        """Set the twins at rest at poses x, y [m], heading [rad] (n, 3); counters remain."""
        self.move(poses)
        for name in ("speeds", "ctrl", "force", "impulses"):
            self.robots[name][:] = 0

    def move(self, poses: Floats) -> None:
        """Move the twins to poses x, y [m], heading [rad] (n, 3); speeds remain."""
        robots = self.robots
        robots["joints"][:, :3] = poses
        last = robots["last_step"]
        last[:, : planar.CENTRE_Y + 1] = poses[:, :2]
        last[:, planar.HEADING_COSINE] = np.cos(poses[:, 2])
        last[:, planar.HEADING_SINE] = np.sin(poses[:, 2])
        self.remeasure()

    def remeasure(self) -> None:
        """Measure the distances to all obstacles again, after one was moved."""
        self.robots["last_step"][:, planar.ANCHOR_X] = np.inf
        self._compiled.measure(*self._scene_arrays)

    def obstacle_offsets(self, rows: Sequence[int]) -> Floats:
        """Return the offsets of an obstacle, by its rows, from its place in the playpen: x, y (n, 2) [m]."""
        place = slice(planar.CENTRE_X, planar.CENTRE_Y + 1)
        return self.obstacles[:, rows[0], place] - self._scene[rows[0], place]

    def set_obstacle_offsets(self, rows: Sequence[int], offsets: Floats) -> None:
        """Set the offsets of an obstacle, by its rows, from its place in the playpen: x, y (n, 2) [m]."""
        place = slice(planar.CENTRE_X, planar.CENTRE_Y + 1)
        self.obstacles[:, rows, place] = self._scene[rows, place] + offsets[:, None]
        self.remeasure()

    def remove_obstacles(self) -> None:
        """Move all obstacles out of reach."""
        self.obstacles[:, :, planar.CENTRE_X] += AWAY
        self.remeasure()

    def restore_obstacles(self, rows: Sequence[int]) -> None:
        """Move obstacles, by rows, back to their places in the playpen."""
        self.obstacles[:, rows, : planar.REFLECTANCE + 1] = self._scene[rows, : planar.REFLECTANCE + 1]
        self.remeasure()

    def set_wheels(self, radius: Floats, right_over_left: Floats, base: Floats) -> None:
        """Set the wheels as multiples of the calibration's: mean radius, ratio and base (n,)."""
        robots, nominal = self.robots, self._nominal_robot
        factors = {"left": radius * 2 / (1 + right_over_left)}
        factors["right"] = factors["left"] * right_over_left
        for side, factor in factors.items():
            robots[f"{side}_wheel"] = nominal[f"{side}_wheel"] * factor
            robots[f"{side}_free_speed"] = nominal[f"{side}_free_speed"] * factor
        robots["track"] = nominal["track"] * base

    def advance_to(self, time_ns: int) -> None:
        """Advance all twins to a time [ns], in whole control ticks; do nothing if they are past it."""
        if (ticks := time_ns // TICK_NS - self.ticks) > 0:
            self.advance(ticks)

    def advance(self, ticks: int) -> None:
        """Advance all twins by control ticks."""
        self.ticks += ticks
        voltage = battery.voltage(self._used_min, self.ticks * TICK_NS)
        boards = self.registers, self.processor, self.strength
        self._compiled.advance(*self._scene_arrays, *boards, self._motor_constant, voltage, ticks)

    def roll_wheels(self, pulses: Floats) -> None:
        """Move the twins as their wheels roll by pulses, left and right (n, 2)."""
        robots, poses = self.robots, self.poses
        angles = pulses * (math.tau / units.PULSES_PER_TURN)
        left: Floats = angles[:, 0] * robots["left_wheel"]
        right: Floats = angles[:, 1] * robots["right_wheel"]
        track: Floats = robots["track"]
        forward, turn = (left + right) / 2, (right - left) / track
        middle = poses[:, 2] + turn / 2
        self.move(poses + np.stack([forward * np.cos(middle), forward * np.sin(middle), turn], axis=1))

    def command(self, command: int, left: int, right: int) -> None:
        """Execute a command of `wheel_commands` on all boards."""
        self._compiled.command(self.registers, command, left, right)

    def are_clear(self, poses: Floats) -> Booleans:
        """Return whether a robot is clear of each twin's obstacles at a pose (n,)."""
        is_clear = np.zeros(len(self), np.bool_)
        self._compiled.clear(self.obstacles, self.robots, poses, is_clear)
        return is_clear
