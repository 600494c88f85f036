"""Bodies of many planar twins of one robot, each with separate wheels, motors and obstacles."""

import math
from collections.abc import Iterable, Sequence
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from khep_twin import units
from khep_twin.episodes.episode_setup import EpisodeSetup
from khep_twin.episodes.planar import plane as planar
from khep_twin.episodes.planar.planar_world import PlanarForms
from khep_twin.errors import PlaypenError, RobotModelError
from khep_twin.robots.core import marker_of
from khep_twin.sensing.buffers import as_plain, as_records
from khep_twin.sensing.noise import compiled_tables
from khep_twin.sensing.scene import Beams
from khep_twin.simulation.ready import module_of

Floats = NDArray[np.float64]
Booleans = NDArray[np.bool_]

TICK_NS = units.TICK_NS
"""Step of the twins [ns]."""

N_SPARE = 1
"""Spare obstacles of each twin, out of reach until a fault uses them."""

_EMPTY = np.zeros((0, 0))
"""Table without rows."""

_Command = tuple[int, int, int]
_ALL = slice(None)

_ROWS = "obstacles", "_order", "robots", "states", "strength"
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
        states: States that change in the robots' cores, as words of 64 bits (n, n_words).
        entry: The robot in the playpen.
        scale: Size of the robot, as a multiple of a Khepera's.
        motor_lag: Time constant of the motors of the calibration's robot [s].
        ticks: Time since the start [ticks].
        strength: Shares of the motors' torque, left and right (n, 2); negative for a blocked wheel.
    """

    def __init__(self, setup: EpisodeSetup, forms: PlanarForms, count: int) -> None:
        self._compiled: Any = module_of("shadow")
        self._run = self._compiled.run_of(setup.entry.robot_model.family)
        self.entry, core, state = setup.entry, setup.core, forms.robot_states()[0]
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
        # All twins share one state; the words of it that change are those of the twin that runs.
        record = as_records([state], state, marker_of(core))
        self._memory: NDArray[np.int64] = record.view(np.int64)
        if core.program is None:
            raise RobotModelError(
                f"model {self.entry.model}: no program in its core; expected one for a shadow"
            )
        self._program = core.program(self.entry, as_plain(state, record[0]))
        words = np.arange(len(self._memory)).view(record.dtype)[0]
        changing = (name for name in core.changing if not isinstance(getattr(state, name), Beams))
        self._columns = np.frombuffer(b"".join(words[name].tobytes() for name in changing), np.int64)
        self.states: NDArray[np.int64] = np.repeat(self._memory[None, self._columns], count, axis=0)
        self._boards = record, self._memory, self._columns, compiled_tables(0.0)
        self.strength: Floats = np.ones((count, 2))
        sonar = self.entry.body.sonar
        self._n_echoes, self._lag = (0, 0.0) if sonar is None else (len(sonar.names), sonar.lag)
        self._supply = setup.calibration.motors.supply_v
        self._pulses_per_rad = self.entry.body.pulses_per_turn / math.tau
        self.scale = self.entry.body.radius / units.BODY_RADIUS
        self._nominal_robot = robot[0].copy()
        self.motor_lag = -float(robot[0]["substep"] / math.log(robot[0]["linear_decay"]))
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
        self._call(ticks=ticks)

    def _call(
        self, rows: slice = _ALL, command: _Command = (0, 0, 0), ticks: int = 0, distances: Floats = _EMPTY
    ) -> None:
        """Run twins of some rows: a command, ticks and distances, each if there are any."""
        inputs = (rows.start or 0, rows.step or 1), command, ticks, self.ticks * TICK_NS, self._supply
        self._run(self._scene_arrays, self._boards, self.states, self.strength, *inputs, self._lag, distances)

    def echoes(self) -> Floats:
        """Return the distances by the ultrasonic sensors, as `robots.core.echo` does (n, n_sensors) [m]."""
        self._call(distances=(distances := np.zeros((len(self), self._n_echoes))))
        return distances

    @property
    def counters(self) -> Floats:
        """Counts of the encoders, left and right (n, 2) [pulses]."""
        angles = self.robots["joints"][:, [planar.LEFT_ANGLE, planar.RIGHT_ANGLE]]
        return np.floor(angles * self._pulses_per_rad + 0.5)

    def execute(self, data: bytes) -> tuple[NDArray[np.intp], NDArray[np.int64]]:
        """Execute requests on the first twin; return the words of its state that change, and their values."""
        self._memory[self._columns] = self.states[0]
        self._program.receive(data)
        old, self.states[0] = self.states[0].copy(), self._memory[self._columns]
        changed = np.flatnonzero(self.states[0] != old)
        return changed, self.states[0, changed]

    def restart(self) -> None:
        """Restart the program of each twin."""
        for state in self.states:
            self._memory[self._columns] = state
            self._program.reset()
            state[:] = self._memory[self._columns]

    def roll_wheels(self, pulses: Floats) -> None:
        """Move the twins as their wheels roll by pulses, left and right (n, 2)."""
        robots, poses = self.robots, self.poses
        angles = pulses * (math.tau / self.entry.body.pulses_per_turn)
        left: Floats = angles[:, 0] * robots["left_wheel"]
        right: Floats = angles[:, 1] * robots["right_wheel"]
        track: Floats = robots["track"]
        forward, turn = (left + right) / 2, (right - left) / track
        middle = poses[:, 2] + turn / 2
        self.move(poses + np.stack([forward * np.cos(middle), forward * np.sin(middle), turn], axis=1))

    def command(self, letter: str, left: int, right: int, rows: slice = _ALL) -> None:
        """Execute a request of `Core.commands` on twins of some rows."""
        self._call(rows, (ord(letter), left, right))

    def are_clear(self, poses: Floats) -> Booleans:
        """Return whether a robot is clear of each twin's obstacles at a pose (n,)."""
        is_clear = np.zeros(len(self), np.bool_)
        self._compiled.clear(self.obstacles, self.robots, poses, is_clear)
        return is_clear
