"""One robot of a world, of any model: its board at its line, and its body in the physics."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from functools import partial
from typing import NamedTuple, Protocol

import mujoco
import numpy as np
from numpy.typing import NDArray

from khep_twin.board.fault_injection import Fault, Injector
from khep_twin.board.turrets import TurretBody
from khep_twin.sensing.robot_indices import RobotIndices
from khep_twin.simulation.turret_place import TurretWorld
from khep_twin.simulation.wired_board import BoardFirmware, LineWorld, WiredBoard
from khep_twin.simulation.world_state import RobotSnapshot


class WorldContext(TurretWorld, LineWorld, Protocol):
    """Interface of the world to its robots."""

    def on_event(self, robot: int | None, text: str) -> None:
        """Log an event."""
        ...


class RobotSettings(NamedTuple):
    """Settings of a world's robots.

    Attributes:
        unpaced: True for lines without delay.
        strict_line: True to garble the bytes between a robot and a host whose line has another speed.
        faults: Faults of the robots.
    """

    unpaced: bool
    strict_line: bool
    faults: tuple[Fault, ...]


class SampledRegisters(NamedTuple):
    """Registers that a log has as a channel of their own.

    Attributes:
        name: Name of the channel.
        label: Names of its numbers, and their unit in brackets.
        registers: Indices of the registers.
    """

    name: str
    label: str
    registers: Sequence[int]


class Robot(WiredBoard, ABC):
    """One robot of a world: its board, its line and its body in the physics.

    Args:
        context: World of the robot.
        index: Index among the playpen's robots.
        indices: Indices in the scene.
        firmware: Command interpreter.
        rng: Function that returns a random stream of the robot by its name.
        settings: Settings of the world's robots.

    Attributes:
        index: Index among the playpen's robots.
        name: Name in the scene, e.g. "khepera0".
        indices: Indices in the scene.
        firmware: Command interpreter.
        uart: Serial line.
        faults: Its faults.
        registers: State of the board, as a log has it.
        sampled: Channels of the board's registers.
        turret_bodies: Bodies of its turrets, by their names.
    """

    registers: NDArray[np.int64]
    sampled: Sequence[SampledRegisters] = ()

    def __init__(
        self,
        context: WorldContext,
        index: int,
        indices: RobotIndices,
        firmware: BoardFirmware,
        rng: Callable[..., np.random.Generator],
        settings: RobotSettings,
    ) -> None:
        super().__init__(
            context,
            index,
            firmware,
            Injector(settings.faults, partial(rng, "fault"), partial(context.on_event, index)),
            settings.unpaced,
            rng("line") if settings.strict_line else None,
        )
        self.name, self.indices, self._context = f"khepera{index}", indices, context
        self.turret_bodies: dict[str, TurretBody] = {}
        model: mujoco.MjModel = context.model
        positions = [model.body_pos[light] for light in indices.led_lights]
        hidden: list[NDArray[np.float64]] = [position.copy() for position in positions]
        self._lights = list(zip(positions, hidden, model.site_pos[list(indices.leds)], strict=True))
        self._shown = [0] * len(indices.leds)

    @property
    def pose(self) -> tuple[float, float, float]:
        """True x, y [m] and heading [rad] in the playpen."""
        return self.indices.pose_in(self._context.data.qpos)

    @property
    def disc(self) -> tuple[float, float, float]:
        """Disc of the floor that it covers: x, y and radius [m]."""
        x, y, _ = self.pose
        return x, y, self._context.playpen.robots[self.index].body.radius

    def readings(self) -> dict[str, list[int]]:
        """Return the present numbers of its channels, by their names."""
        self.refresh()
        return {name: self.registers[list(own)].tolist() for name, _, own in self.sampled}

    @property
    def line_image(self) -> NDArray[np.int64] | None:
        """Greys that its turret sees, from the left to the right, 0 to 255 (n,); None without such one."""
        for kind, turret in self.firmware.turrets.items():
            if kind.image is not None:
                return turret.registers[kind.image]
        return None

    @property
    def next_faults_ns(self) -> list[int]:
        """Times at which faults begin or end by themselves [ns]."""
        return self.faults.next_changes_ns

    def switch_on(self) -> None:
        """Begin the run, at time 0."""

    def refresh(self) -> None:
        """Bring the registers up to the present, for an observer."""

    def scan(self) -> None:
        """Measure by all sensors now, where the stepping core does not."""

    def fit_turrets(self) -> None:
        """Give its turrets their bodies in the scene as it is now; their state is in their registers."""

    def reseed(self, seed_of: Callable[..., np.random.Generator]) -> None:
        """Draw from other random streams from now on."""
        self.reseed_line(seed_of)

    @abstractmethod
    def state(self, since_ns: int = -1) -> RobotSnapshot:
        """Return the state, with the replies that reach the host after a time [ns]."""

    @abstractmethod
    def set_state(self, state: RobotSnapshot) -> None:
        """Take over a state.

        Raises:
            ValueError: It is of another robot, or another line.
        """

    @abstractmethod
    def act_after(self, reason: int) -> None:
        """Do what the stepping core has returned for: a reason of `step`."""

    @abstractmethod
    def apply_faults(self) -> None:
        """Make the robot as the present faults have it; sound without any."""

    @abstractmethod
    def reset_motion(self) -> None:
        """Reset counters, setpoints and controllers, and cut the motors' voltage."""

    @abstractmethod
    def zero_encoders(self) -> None:
        """Set the encoders to the wheels' current angles."""

    @property
    @abstractmethod
    def lit_leds(self) -> list[int]:
        """LEDs as the registers have them, 0 for an unlit one."""

    @property
    def leds_differ(self) -> bool:
        """True if the lights do not show what the LEDs' registers say yet."""
        return self.lit_leds != self._shown

    def show_leds(self) -> None:
        """Move the lights of lit LEDs to the LEDs, those of unlit ones back into the body."""
        self._show(self.lit_leds)

    def _show(self, leds: Sequence[int]) -> None:
        self._shown = list(leds)
        for lit, (place, hidden, shown) in zip(self._shown, self._lights, strict=True):
            place[:] = shown if lit else hidden
