"""Interface between turrets and their world."""

from collections.abc import Mapping
from typing import Protocol

import mujoco
import numpy as np
from numpy.typing import NDArray

from khep_twin.board.turrets import TurretBody, TurretKind
from khep_twin.playpen import Playpen
from khep_twin.renamed import renamed_attribute
from khep_twin.robots.model import robot_name
from khep_twin.sensing.lamps import Lamps
from khep_twin.simulation.simulation import Simulation

_TURRET_KEY = 0x85EBCA6B
"""Factor from the number of a turret to a word of its key: any odd number."""


class TurretWorld(Protocol):
    """Interface of the world to its turrets."""

    playpen: Playpen
    model: mujoco.MjModel
    data: mujoco.MjData
    simulation: Simulation
    lamps: Lamps

    @property
    def time_ns(self) -> int:
        """Current time [ns]."""
        ...

    def turret_bodies(self, name: str) -> list[TurretBody | None]:
        """Return the bodies of the turrets of a kind, by the index of their robot; None without one."""
        ...


class WorldTurretContext:
    """Interface of a world to one turret, which implements `TurretContext`.

    Args:
        world: World of the robot.
        robot: Index of the robot.
        kind: Kind of the turret.
        registers: Registers of the turret's electronics.
        state: Record of the robot.
    """

    def __init__(
        self,
        world: TurretWorld,
        robot: int,
        kind: TurretKind,
        registers: NDArray[np.int64],
        state: NDArray[np.void],
    ) -> None:
        self.model, self.data = world.model, world.data
        self.robot = robot
        self.registers = registers
        self.prefix = f"{robot_name(robot)}/{kind.name}/"
        self._world = world
        self._kind = kind
        self._state = state

    @property
    def time_ns(self) -> int:
        """Time of the world [ns]."""
        return self._world.time_ns

    @property
    def lamps(self) -> list[tuple[float, float, float, float]]:
        """Positions [m] and current powers [W] of the lamps: x, y, z, power."""
        lamps = zip(self._world.lamps.positions, self._world.simulation.powers, strict=True)
        return [(*position, power) for position, power in lamps]

    @property
    def room_lux(self) -> float:
        """Illuminance by the room's lighting [lx]."""
        return self._world.playpen.lighting.room_lux

    @property
    def key(self) -> tuple[int, int]:
        """Words of the key of the turret's random draws, derived from those of the robot's sensors."""
        low, high = self._state["noise"].tolist()
        return low ^ (self._kind.number + 1) * _TURRET_KEY & 0xFFFFFFFF, high

    @property
    def noise(self) -> float:
        """Scale of the sensors' noise; 0 without noise."""
        return self._world.simulation.noise

    is_noisy = renamed_attribute("is_noisy", "noise")

    @property
    def settings(self) -> Mapping[str, float]:
        """Values of the playpen's table for turrets of this kind; empty without one."""
        return self._world.playpen.turret_settings.get(self._kind.name, {})

    @property
    def is_compiled(self) -> bool:
        """True if the world is stepped by compiled code, which a body may then also use."""
        return self._world.simulation.is_compiled

    @property
    def peers(self) -> list[TurretBody | None]:
        """Bodies of the turrets of this kind, by the index of their robot; None for robots without one."""
        return self._world.turret_bodies(self._kind.name)
