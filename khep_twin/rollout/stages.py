"""Where trials happen: lives without a serial line where they can, else a world.

Both let time pass by control periods, and are told speeds as by a command D that takes no time. The first is
compiled and for one robot; the second takes any number, turrets, and lamps that take turns.
"""

from collections.abc import Sequence
from typing import Protocol

import mujoco
import numpy as np
from numpy.typing import NDArray

from khep_twin.clock import n_steps
from khep_twin.errors import DivergedError, PlaypenError
from khep_twin.placing import no_room
from khep_twin.playpen import Playpen, placed
from khep_twin.randomness import stream
from khep_twin.rollout import episode
from khep_twin.rollout.life import Ground, Life
from khep_twin.units import TICK_NS
from khep_twin.world import World

Pose = tuple[float, float, float]
"""x, y [m] and heading [rad]."""

_TRIES = 1000
"""Places that are drawn for a start before there is said to be no room."""


class Stage(Protocol):
    """Where robots are."""

    @property
    def data(self) -> mujoco.MjData:
        """The scene's state, live; after a beginning it may be another object."""
        ...

    @property
    def registers(self) -> Sequence[NDArray[np.int64]]:
        """Of each robot's board (N_REGISTERS,), live."""
        ...

    @property
    def poses(self) -> Sequence[Pose]:
        """Where each robot is."""
        ...

    def begin(self, seed: int, playpen: Playpen, noise: bool, spread: bool) -> None:
        """Starts anew, with the robots where the playpen has them."""
        ...

    def drive(self, robot: int, left: float, right: float) -> None:
        """Sets both speeds of a robot [pulses/10 ms]."""
        ...

    def go_on(self) -> None:
        """Lets a control period pass."""
        ...


class Alone:
    """One robot's lives, one after another.

    Args:
        ground: that is made ready; others may use it too.
        compiled: None for compiled where numba is installed.
    """

    def __init__(self, ground: Ground, compiled: bool | None) -> None:
        self._ground = ground
        self._life = Life(ground, compiled=compiled)

    @property
    def data(self) -> mujoco.MjData:
        """The scene's state."""
        return self._life._data  # pyright: ignore[reportPrivateUsage]

    @property
    def registers(self) -> Sequence[NDArray[np.int64]]:
        """Of the board."""
        return (self._life.registers,)

    @property
    def poses(self) -> Sequence[Pose]:
        """Where the robot is."""
        return (self._life.pose,)

    def begin(self, seed: int, playpen: Playpen, noise: bool, spread: bool) -> None:
        """Starts a life."""
        robot = playpen.robots[0]
        start = robot.x_mm, robot.y_mm, robot.heading_deg
        self._life.begin(seed, start=start, noise=noise, spread=spread)

    def drive(self, robot: int, left: float, right: float) -> None:
        """Sets both speeds."""
        self._life.drive(left, right)

    def go_on(self) -> None:
        """Lets a control period pass."""
        self._life.go_on(self._ground.wiring.steps_per_period)


class Together:
    """Any number of robots in a world; each beginning makes a new one.

    Args:
        period_ns: of the controllers, whole ticks of 10 ms.
    """

    def __init__(self, period_ns: int) -> None:
        n_steps(period_ns, TICK_NS)
        self._period_ns = period_ns
        self._world: World | None = None

    @property
    def world(self) -> World:
        """The world that there is.

        Raises:
            ValueError: nothing has begun.
        """
        if self._world is None:
            raise ValueError("there is no world yet; right is to begin first")
        return self._world

    @property
    def data(self) -> mujoco.MjData:
        """The scene's state."""
        return self.world.data

    @property
    def registers(self) -> Sequence[NDArray[np.int64]]:
        """Of the boards."""
        return [robot.registers for robot in self.world.robots]

    @property
    def poses(self) -> Sequence[Pose]:
        """Where the robots are."""
        return [robot.pose for robot in self.world.robots]

    def begin(self, seed: int, playpen: Playpen, noise: bool, spread: bool) -> None:
        """Makes a world."""
        self._world = World(playpen, seed=seed, noise=noise, spread=spread, unpaced=True)

    def drive(self, robot: int, left: float, right: float) -> None:
        """Sets both speeds of a robot.

        Raises:
            DivergedError: a speed is no number.
        """
        driven = self.world.robots[robot]
        if driven.firmware.powered and not episode.drive(driven.registers.data, left, right):
            raise DivergedError(
                f"{driven.name} failed at {self.world.time_ns / 1e9:.4f} s: the controller gave a speed that "
                "is no number"
            )

    def go_on(self) -> None:
        """Lets a control period pass."""
        self.world.advance_to(self.world.time_ns + self._period_ns)


def may_be_alone(playpen: Playpen) -> bool:
    """Whether a playpen has nothing that lives without a serial line cannot have."""
    robots = playpen.robots
    return len(robots) == 1 and not robots[0].turrets and playpen.lighting.mode == "all"


def several(playpen: Playpen, count: int) -> Playpen:
    """The playpen with so many of its first robot, still to be put somewhere.

    Raises:
        PlaypenError: there is no robot in it.
    """
    if not playpen.robots:
        raise PlaypenError(f"{playpen.name}: has no robot; right is one that others are made after")
    first = playpen.robots[0].model_copy(update={"name": None} if count > 1 else {})
    return playpen.model_copy(update={"robots": (first,) * count})


def anywhere(playpen: Playpen, seed: int) -> Playpen:
    """The playpen with its robots where the seed draws room for them.

    Raises:
        PlaypenError: no room was found.
    """
    chance = stream(seed, "starts")
    xs, ys = zip(*playpen.arena.corners, strict=True)
    left, right, low, high = min(xs), max(xs), min(ys), max(ys)
    standing = playpen.model_copy(update={"robots": ()})
    for robot in playpen.robots:
        for _ in range(_TRIES):
            x_mm, y_mm, heading_deg = chance.uniform((left, low, 0), (right, high, 360)).round(1).tolist()
            place = {"x_mm": x_mm, "y_mm": y_mm, "heading_deg": heading_deg, "spots": ()}
            tried = standing.model_copy(update={"robots": (*standing.robots, robot.model_copy(update=place))})
            if not no_room(tried, len(standing.robots), x_mm, y_mm):
                standing = tried
                break
        else:
            raise PlaypenError(
                f"{playpen.name}: no room for robot {len(standing.robots) + 1} was found in {_TRIES} tries; "
                "right are fewer robots"
            )
    return standing


def at_spots(playpen: Playpen, seed: int) -> Playpen:
    """The playpen with its robots in their places, or at spots that the seed draws."""
    return placed(playpen, stream(seed, "spots"))
