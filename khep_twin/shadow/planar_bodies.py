"""Bodies of planar twins of one robot, side by side, each with its own wheels, motors and obstacles."""

import math
from collections.abc import Iterable, Sequence
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from khep_twin import units
from khep_twin.board import battery, kernel
from khep_twin.episodes.episode_setup import EpisodeSetup
from khep_twin.episodes.planar import plane as flat
from khep_twin.episodes.planar.planar_world import PlanarForms
from khep_twin.errors import PlaypenError
from khep_twin.sensing.buffers import as_records
from khep_twin.simulation.ready import module_of

Floats = NDArray[np.float64]

TICK_NS = units.TICK_NS
"""Step of the twins [ns]."""

N_SPARE = 1
"""Obstacles of each plane that the playpen does not have, out of reach until they are put somewhere."""

_NONE = np.zeros((0, 0))
"""Table without rows."""

_ROWS = "things", "_order", "robots", "registers", "processor", "strength"
"""Arrays that have a row for each twin."""

AWAY = 1e3
"""Position of what is not in the playpen [m]."""


class PlanarBodies:
    """Bodies of planar twins of one robot, without noise; all arrays have a row for each twin.

    Args:
        setup: Playpen with the robot, prepared for the plane.
        forms: Its forms in the plane.
        count: Number of twins.

    Attributes:
        things: Obstacles (n, n_things + N_SPARE, flat.N_COLUMNS).
        robots: Records of `PlanarRobot` (n,).
        registers: States of the boards (n, N_REGISTERS).
        processor: States of the processors (n, N_PROCESSOR).
        strength: Parts of the motors' torque, left and right (n, 2); below 0 for a wheel that is blocked.
    """

    def __init__(self, setup: EpisodeSetup, forms: PlanarForms, count: int) -> None:
        self._code: Any = module_of("shadow")
        state = forms.robot_states()[0]
        things, order, _, bodies, _, robot = forms.compiled()
        if len(bodies):
            found = f"{setup.playpen.name}: {len(bodies)} movable objects"
            raise PlaypenError(f"{found}; expected none in the playpen of a shadow")
        spare = np.zeros((N_SPARE, flat.N_COLUMNS))
        spare[:, [flat.CENTRE_X, flat.COSINE, flat.WIDTH, flat.BODY]] = AWAY, 1.0, -1.0, -1.0
        self._scene: Floats = np.concatenate([things, spare])
        self.things: Floats = np.repeat(self._scene[None], count, axis=0)
        self._order = np.repeat(np.concatenate([order, len(order) + np.arange(N_SPARE)])[None], count, axis=0)
        self._near = np.zeros_like(self._scene)
        self.robots: Any = np.repeat(robot, count)
        self.registers: NDArray[np.int64] = np.zeros((count, kernel.N_REGISTERS), np.int64)
        kernel.reset(self.registers[0].data)
        self.registers[:] = self.registers[0]
        self.processor: NDArray[np.int64] = np.zeros((count, kernel.N_PROCESSOR), np.int64)
        self.processor[:, kernel.POWERED] = 1
        self.strength: Floats = np.ones((count, 2))
        drive = self._code.MotorDrive(
            flat.LEFT_ANGLE, flat.RIGHT_ANGLE, flat.LEFT_ANGLE, flat.RIGHT_ANGLE, state.motor_constant
        )
        self._drive = as_records([drive], drive)
        self._used_min = state.used_min
        self._own = robot[0].copy()
        self.ticks = 0

    def __len__(self) -> int:
        return len(self.robots)

    def taken(self, indices: NDArray[np.intp] | slice) -> Self:
        """Return copies of twins at these indices, or the twins of a slice themselves."""
        return self._of(getattr(self, name)[indices] for name in _ROWS)

    def joined(self, other: Self) -> Self:
        """Return these twins and others of the same time."""
        return self._of(np.concatenate([getattr(self, name), getattr(other, name)]) for name in _ROWS)

    def _of(self, rows: Iterable[NDArray[Any]]) -> Self:
        """Return twins in the same playpen whose arrays, in the order of _ROWS, are these."""
        made = object.__new__(type(self))
        made.__dict__.update(self.__dict__)
        made.__dict__.update(zip(_ROWS, rows, strict=True))
        return made

    @property
    def _scenes(self) -> tuple[Any, ...]:
        return self.things, self._order, self._near, _NONE, self.robots

    @property
    def poses(self) -> Floats:
        """Poses x, y [m] and heading [rad], which is not wrapped (n, 3)."""
        return self.robots["joints"][:, :3].copy()

    @property
    def pushes(self) -> Floats:
        """Directions x, y in which obstacles push the twins, of length 1, or 0 where none does (n, 2)."""
        ahead, aside = self.robots["grips"][:, [flat.PUSHED, flat.PUSHED_ASIDE]].T
        heading = self.robots["joints"][:, flat.HEADING]
        push = (ahead + 1j * aside) * np.exp(1j * heading)
        push /= np.where(push == 0, 1, np.abs(push))
        return np.stack([push.real, push.imag], axis=1)

    def put(self, poses: Floats) -> None:
        """Put the twins at rest at poses x, y [m], heading [rad] (n, 3); counters are kept."""
        self.move(poses)
        for name in ("speeds", "ctrl", "force", "grips"):
            self.robots[name][:] = 0

    def move(self, poses: Floats) -> None:
        """Move the twins to poses x, y [m], heading [rad] (n, 3), in motion as they are."""
        robots = self.robots
        robots["joints"][:, :3] = poses
        last = robots["last"]
        last[:, : flat.CENTRE_Y + 1] = poses[:, :2]
        last[:, flat.HEADING_COSINE], last[:, flat.HEADING_SINE] = np.cos(poses[:, 2]), np.sin(poses[:, 2])
        self.remeasure()

    def remeasure(self) -> None:
        """Have the distances to all obstacles measured again, as after one was moved."""
        self.robots["last"][:, flat.ANCHOR_X] = np.inf
        self._code.measure(*self._scenes)

    def offsets(self, rows: Sequence[int]) -> Floats:
        """Return how far a thing, with its rows, is from where the playpen has it: x and y (n, 2) [m]."""
        place = slice(flat.CENTRE_X, flat.CENTRE_Y + 1)
        return self.things[:, rows[0], place] - self._scene[rows[0], place]

    def offset(self, rows: Sequence[int], offsets: Floats) -> None:
        """Put a thing, with its rows, so far from where the playpen has it: x and y (n, 2) [m]."""
        place = slice(flat.CENTRE_X, flat.CENTRE_Y + 1)
        self.things[:, rows, place] = self._scene[rows, place] + offsets[:, None]
        self.remeasure()

    def clear_away(self) -> None:
        """Put all things out of reach."""
        self.things[:, :, flat.CENTRE_X] += AWAY
        self.remeasure()

    def restore(self, rows: Sequence[int]) -> None:
        """Put things back to where the playpen has them."""
        self.things[:, rows, : flat.REFLECTANCE + 1] = self._scene[rows, : flat.REFLECTANCE + 1]
        self.remeasure()

    def set_wheels(self, radius: Floats, right_over_left: Floats, base: Floats) -> None:
        """Set the wheels, as parts of those of the calibration: mean radius, ratio and base (n,)."""
        robots, own = self.robots, self._own
        factors = {"left": radius * 2 / (1 + right_over_left)}
        factors["right"] = factors["left"] * right_over_left
        for side, factor in factors.items():
            robots[f"{side}_wheel"] = own[f"{side}_wheel"] * factor
            robots[f"{side}_free_speed"] = own[f"{side}_free_speed"] * factor
        robots["track"] = own["track"] * base

    def advance_to(self, time_ns: int) -> None:
        """Advance all twins to a time, in whole control ticks; they stay where they are beyond it [ns]."""
        if (ticks := time_ns // TICK_NS - self.ticks) > 0:
            self.advance(ticks)

    def advance(self, ticks: int) -> None:
        """Advance all twins by control ticks."""
        self.ticks += ticks
        voltage = battery.voltage(self._used_min, self.ticks * TICK_NS)
        boards = self.registers, self.processor, self.strength
        self._code.advance(*self._scenes, *boards, self._drive, voltage, ticks)

    def roll(self, pulses: Floats) -> None:
        """Move the twins as their wheels roll by so many pulses, left and right (n, 2)."""
        robots, poses = self.robots, self.poses
        angles = pulses * (math.tau / units.PULSES_PER_TURN)
        left: Floats = angles[:, 0] * robots["left_wheel"]
        right: Floats = angles[:, 1] * robots["right_wheel"]
        track: Floats = robots["track"]
        ahead, turn = (left + right) / 2, (right - left) / track
        middle = poses[:, 2] + turn / 2
        self.move(poses + np.stack([ahead * np.cos(middle), ahead * np.sin(middle), turn], axis=1))

    def command(self, command: int, left: int, right: int) -> None:
        """Execute a command of `compiled` on all boards."""
        self._code.command(self.registers, command, left, right)

    def free(self, poses: Floats) -> NDArray[np.bool_]:
        """Return whether a robot would stand free of each twin's obstacles at a pose (n,)."""
        free = np.zeros(len(self), np.bool_)
        self._code.clear(self.things, self.robots, poses, free)
        return free
