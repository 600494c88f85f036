"""A robot of a world, of any model: its board on a serial line, and its body in the physics."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Protocol

import mujoco
import numpy as np
from numpy.typing import NDArray

from khep_twin import step
from khep_twin.board.fault_injection import MOTOR, SENSOR, WHEEL, Fault, Injector, locate
from khep_twin.board.turrets import TurretBody
from khep_twin.robots.model import SampledRegisters, robot_name
from khep_twin.sensing.device_faults import DEAD, SOUND, STUCK
from khep_twin.sensing.robot_indices import RobotIndices
from khep_twin.simulation.faulty_wheels import FaultyWheels
from khep_twin.simulation.moments import Moments
from khep_twin.simulation.robot_arrays import Layout
from khep_twin.simulation.turret_place import TurretWorld, WorldTurretContext
from khep_twin.simulation.wired_board import BoardFirmware, LineWorld, WiredBoard
from khep_twin.simulation.world_state import RobotSnapshot
from khep_twin.units import TICK_NS


class WorldContext(TurretWorld, LineWorld, Protocol):
    """Interface of the world to its robots."""

    @property
    def moments(self) -> Moments:
        """Moments that robots have recorded."""
        ...


@dataclass(frozen=True, slots=True)
class RobotSetup:
    """Place of a robot in a world, and its settings.

    Attributes:
        context: World of the robot.
        index: Index among the playpen's robots.
        indices: Indices in the scene.
        make_rng: Function that returns a random stream of the robot by its name.
        unpaced: True for a line without delay.
        strict_line: True to garble bytes if the baud rates of robot and host differ.
        faults: Faults of all robots.
    """

    context: WorldContext
    index: int
    indices: RobotIndices
    make_rng: Callable[..., np.random.Generator]
    unpaced: bool
    strict_line: bool
    faults: tuple[Fault, ...]


class Robot(WiredBoard, ABC):
    """A robot of a world: its board, its line and its body in the physics.

    Args:
        setup: Its place and settings.
        firmware: Command interpreter.

    Attributes:
        index: Index among the playpen's robots.
        name: Name in the scene, e.g. "khepera0".
        robot_model: Its model.
        family: Family of its model.
        dialect: Protocol on its line.
        indices: Indices in the scene.
        firmware: Command interpreter.
        uart: Serial line.
        faults: Its faults.
        registers: State of the board, as in logs; a robot that evaluates measurements only when they are read
            updates it by a function in `Observers.evaluations`.
        sampled: Channels of the board's registers.
        turret_bodies: Bodies of its turrets, by their names.
    """

    registers: NDArray[np.int64]
    sampled: Sequence[SampledRegisters] = ()
    layout: Layout
    """Layout of its state in snapshots."""

    def __init__(self, setup: RobotSetup, firmware: BoardFirmware) -> None:
        context, index, indices = setup.context, setup.index, setup.indices
        model = context.playpen.robots[index].robot_model
        self._record = context.simulation.robots.record_of(index)
        self._device_faults = self._record["faults"] if "faults" in self._record.dtype.names else None
        sensors = None if self._device_faults is None else model.body.fault_sensors
        faults = [locate(fault, sensors, f"robot {index} is a {model.title}") for fault in setup.faults]
        super().__init__(
            context,
            index,
            firmware,
            Injector(faults, partial(setup.make_rng, "fault"), partial(context.observers.on_event, index)),
            setup.unpaced,
            setup.make_rng("line") if setup.strict_line else None,
        )
        self.name = robot_name(index)
        self.robot_model = model
        self.family = model.family
        self.dialect = model.dialect
        self.indices = indices
        self._context = context
        self._has_stopped = False
        self._wheels = None
        if any(fault.device == WHEEL for fault in faults):
            self._wheels = FaultyWheels(context.model, context.data, indices)
        self._apply_faults()
        self.fit_turrets()
        scene: mujoco.MjModel = context.model
        positions = [scene.body_pos[light] for light in indices.led_lights]
        hidden: list[NDArray[np.float64]] = [position.copy() for position in positions]
        self._led_lights = list(zip(positions, hidden, scene.site_pos[list(indices.leds)], strict=True))
        self._shown_leds = [0] * len(indices.leds)

    @property
    def pose(self) -> tuple[float, float, float]:
        """True x, y [m] and heading [rad] in the playpen."""
        return self.indices.pose_in(self._context.data.qpos)

    @property
    def disc(self) -> tuple[float, float, float]:
        """Circle that it covers: x, y and radius [m]."""
        x, y, _ = self.pose
        return x, y, self._context.playpen.robots[self.index].body.radius

    def readings(self) -> dict[str, list[int]]:
        """Return the present values of its channels, by name."""
        return {name: self.registers[list(registers)].tolist() for name, _, registers in self.sampled}

    @property
    def line_image(self) -> NDArray[np.int64] | None:
        """Greys of its line camera, from left to right, 0 to 255 (n,); None without a camera."""
        for kind, turret in self.firmware.turrets.items():
            if kind.image is not None:
                return turret.registers[kind.image]
        return None

    def fit_turrets(self) -> None:
        """Create the bodies of its turrets in the present scene; their state is in the registers."""
        self.turret_bodies: dict[str, TurretBody] = {
            kind.name: kind.fit(
                WorldTurretContext(self._context, self.index, kind, turret.registers, self._record)
            )
            for kind, turret in self.firmware.turrets.items()
            if kind.fit is not None
        }

    def reseed(self, make_rng: Callable[..., np.random.Generator]) -> None:
        """Replace the random streams."""
        self.reseed_line(make_rng)

    def state(self, since_ns: int = -1) -> RobotSnapshot:
        """Return the state, with the replies that reach the host after a time [ns]."""
        return RobotSnapshot(
            **self.board_state(since_ns),
            model=self.family,
            version=self.layout.version,
            arrays=self.layout.pack(self._record),
            is_stopped=self._has_stopped,
            leds=tuple(self._shown_leds),
        )

    def set_state(self, state: RobotSnapshot) -> None:
        """Restore a state.

        Raises:
            ValueError: The state is of another robot model or another line.
        """
        if (state.model, state.version) != (self.family, self.layout.version):
            expected = f"{self.family!r}, version {self.layout.version}"
            raise ValueError(f"state of model {state.model!r}, version {state.version}; expected {expected}")
        self.layout.unpack(self._record, state.arrays)
        self.set_board_state(state)
        self._has_stopped = state.is_stopped
        self._set_led_lights(state.leds)
        self._apply_faults()

    def act_after(self, reason: int) -> None:
        """React to the reason for which the stepping core has returned, a `step.Reason`.

        By default, update the faults of sensors after each step, the others before a control period.
        """
        if reason == step.Reason.STEPPED:
            is_before_tick = self._context.time_ns % TICK_NS == 0
            self.update_faults(SENSOR, *((MOTOR, WHEEL, "") if is_before_tick else ()))

    def update_faults(self, *devices: str) -> list[Fault]:
        """Start and end the due faults of devices, and return them."""
        changed_faults = self.faults.update(devices, self._context.time_ns)
        if changed_faults:
            # Earlier measurements are those of the former faults.
            self._context.observers.evaluate()
            self._apply_faults()
        if any(fault.kind == "brown-out" for fault in changed_faults):
            self.reset_processor()
        return changed_faults

    def _apply_faults(self) -> None:
        """Apply the active faults to sensors, motors and wheels; without faults, restore them."""
        devices, wheels = self._device_faults, self._wheels
        if devices is not None:
            devices["sensors"], devices["strengths"] = SOUND, 1
        if wheels is not None:
            wheels.mend()
        for fault in self.faults.active:
            which = fault.which
            if fault.device == SENSOR and devices is not None:
                sensor_state = DEAD if fault.kind == "dead" else STUCK
                devices["sensors"][which] = max(devices["sensors"][which], sensor_state)
            elif fault.device == MOTOR and devices is not None:
                devices["strengths"][which] = min(devices["strengths"][which], fault.part)
            elif fault.kind == "slip" and wheels is not None:
                wheels.slip(which, fault.part)
            elif fault.device == WHEEL and wheels is not None:
                wheels.block(which)

    @abstractmethod
    def reset_motion(self) -> None:
        """Reset counters, setpoints and controllers, and cut the motors' voltage."""

    @property
    def lit_leds(self) -> list[int]:
        """State of each LED in the registers, 0 for off."""
        return []

    @property
    def leds_differ(self) -> bool:
        """True if the lights in the scene differ from the registers of the LEDs."""
        return self.lit_leds != self._shown_leds

    def show_leds(self) -> None:
        """Move the lights of lit LEDs to the LEDs, the others into the body."""
        self._set_led_lights(self.lit_leds)

    def _set_led_lights(self, leds: Sequence[int]) -> None:
        """Move each light to its LED if its state is not 0, otherwise into the body."""
        if len(leds) != len(self._led_lights):
            raise ValueError(f"states of {len(leds)} LEDs; expected {len(self._led_lights)}")
        self._shown_leds = list(leds)
        for is_lit, (position, hidden, led) in zip(self._shown_leds, self._led_lights, strict=True):
            position[:] = led if is_lit else hidden
