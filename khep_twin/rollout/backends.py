"""Simulations behind episodes: episodes without a serial line where possible, else a world.

Both advance by control periods, and take speeds as by a command D without delay. The first is compiled, for
one robot; the second supports any number, turrets, and lamps that take turns.
"""

from collections.abc import Sequence
from typing import Protocol

import mujoco
import numpy as np
from numpy.typing import NDArray

from khep_twin.clock import n_steps
from khep_twin.errors import DivergedError, PlaypenError
from khep_twin.playpen import Playpen
from khep_twin.rollout import stepping
from khep_twin.rollout.episode import Episode, EpisodeSetup
from khep_twin.units import TICK_NS
from khep_twin.world import World

Pose = tuple[float, float, float]
"""x, y [m] and heading [rad]."""


class Backend(Protocol):
    """Simulation of the robots of an episode."""

    @property
    def data(self) -> mujoco.MjData:
        """State of the scene, live; `begin` may replace the object."""
        ...

    @property
    def registers(self) -> Sequence[NDArray[np.int64]]:
        """Registers of each robot's board (N_REGISTERS,), live."""
        ...

    @property
    def poses(self) -> Sequence[Pose]:
        """Pose of each robot."""
        ...

    def begin(self, seed: int, playpen: Playpen, noise: bool, vary: bool) -> None:
        """Start an episode, with the robots where the playpen has them."""
        ...

    def drive(self, robot: int, left: float, right: float) -> None:
        """Set both speeds of a robot [pulses/10 ms]."""
        ...

    def step(self) -> None:
        """Advance by a control period."""
        ...


class EpisodeBackend:
    """Episodes of one robot, one after another.

    Args:
        setup: Setup of the episodes, which others may share.
        compiled: Whether to run compiled; None if numba is installed.
    """

    def __init__(self, setup: EpisodeSetup, compiled: bool | None) -> None:
        self._setup = setup
        self._episode = Episode(setup, compiled=compiled)

    @property
    def data(self) -> mujoco.MjData:
        """State of the scene."""
        return self._episode._data  # pyright: ignore[reportPrivateUsage]

    @property
    def registers(self) -> Sequence[NDArray[np.int64]]:
        """Registers of the board."""
        return (self._episode.registers,)

    @property
    def poses(self) -> Sequence[Pose]:
        """Pose of the robot."""
        return (self._episode.pose,)

    def begin(self, seed: int, playpen: Playpen, noise: bool, vary: bool) -> None:
        """Start an episode."""
        robot = playpen.robots[0]
        start = robot.x_mm, robot.y_mm, robot.heading_deg
        self._episode.begin(seed, start=start, noise=noise, vary=vary)

    def drive(self, robot: int, left: float, right: float) -> None:
        """Set both speeds [pulses/10 ms]."""
        self._episode.drive(left, right)

    def step(self) -> None:
        """Advance by a control period."""
        self._episode.step(self._setup.sim_indices.steps_per_period)


class WorldBackend:
    """Any number of robots in a world; each episode creates a new one.

    Args:
        period_ns: Control period [ns], whole ticks of 10 ms.
    """

    def __init__(self, period_ns: int) -> None:
        n_steps(period_ns, TICK_NS)
        self._period_ns = period_ns
        self._world: World | None = None

    @property
    def world(self) -> World:
        """Current world.

        Raises:
            ValueError: No episode has begun.
        """
        if self._world is None:
            raise ValueError("there is no world yet; expected begin() first")
        return self._world

    @property
    def data(self) -> mujoco.MjData:
        """State of the scene."""
        return self.world.data

    @property
    def registers(self) -> Sequence[NDArray[np.int64]]:
        """Registers of the boards."""
        return [robot.registers for robot in self.world.robots]

    @property
    def poses(self) -> Sequence[Pose]:
        """Poses of the robots."""
        return [robot.pose for robot in self.world.robots]

    def begin(self, seed: int, playpen: Playpen, noise: bool, vary: bool) -> None:
        """Create a world."""
        self._world = World(playpen, seed=seed, noise=noise, vary=vary, unpaced=True)

    def drive(self, robot: int, left: float, right: float) -> None:
        """Set both speeds of a robot [pulses/10 ms].

        Raises:
            DivergedError: A speed is no number.
        """
        driven = self.world.robots[robot]
        if driven.firmware.powered and not stepping.drive(driven.registers.data, left, right):
            raise DivergedError(
                f"{driven.name} failed at {self.world.time_ns / 1e9:.4f} s: the controller gave a speed that "
                "is no number"
            )

    def step(self) -> None:
        """Advance by a control period."""
        self.world.advance_to(self.world.time_ns + self._period_ns)


def supports_episodes(playpen: Playpen) -> bool:
    """Return whether a playpen can be simulated without a serial line."""
    robots = playpen.robots
    return len(robots) == 1 and not robots[0].turrets and playpen.lighting.mode == "all"


def with_robots(playpen: Playpen, count: int) -> Playpen:
    """Return the playpen with `count` copies of its first robot, not yet placed.

    Raises:
        PlaypenError: The playpen has no robot.
    """
    if not playpen.robots:
        raise PlaypenError(f"{playpen.name}: no robot; expected one to copy")
    first = playpen.robots[0].model_copy(update={"name": None} if count > 1 else {})
    return playpen.model_copy(update={"robots": (first,) * count})
