"""State of a world and its robots, as stored in a snapshot."""

from typing import Annotated, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import Base64UrlBytes, Field

from khep_twin.board.fault_injection import InjectorState
from khep_twin.board.uart import LineState
from khep_twin.firmware import FirmwareState
from khep_twin.playpen import Lamp, Lighting
from khep_twin.randomness import StreamState
from khep_twin.sensing.lamps import LampsState
from khep_twin.sensing.noise import Scale
from khep_twin.simulation.physics_state import PhysicsState
from khep_twin.step import Phase

POSITIONS = "positions"
"""Array of a robot with the positions of all joints at a recorded moment; empty without one."""


class HostState(NamedTuple):
    """Known state of a robot's host.

    Attributes:
        settings: Baud rate and stop bits of the host's port; None for those of the robot.
        warned: Pairs of baud rates of host and robot for which a warning was given.
    """

    settings: tuple[Annotated[int, Field(ge=0, le=10**9)], int] | None
    warned: tuple[tuple[int, int], ...]


class RobotSnapshot(NamedTuple):
    """State of a robot besides its body in the physics.

    Attributes:
        firmware: State of the firmware.
        model: Family of the robot's model.
        version: Version of its `arrays`.
        arrays: Arrays of its state in the stepping core, by their paths: 64-bit numbers, see `robot_arrays`.
        is_stopped: Whether the processor has stopped for lack of voltage.
        baud: Baud rate of the robot's serial port.
        rx: Bytes to the robot.
        tx: Bytes to the host.
        host: Known state of its host.
        leds: Displayed LEDs, 1 for on.
        faults: State of the faults.
        line_noise: Position in the random stream of a strict line; None for a lenient one.
    """

    firmware: FirmwareState
    model: Annotated[str, Field(max_length=64)]
    version: int
    arrays: dict[str, Base64UrlBytes]
    is_stopped: bool
    baud: Annotated[int, Field(gt=0, le=10**9)]
    rx: LineState
    tx: LineState
    host: HostState
    leds: tuple[int, ...]
    faults: InjectorState
    line_noise: StreamState | None

    def in_scene(self, qpos: NDArray[np.float64]) -> Self:
        """Return the state with the positions of another scene at a recorded moment."""
        has_moment = bool(self.arrays.get(POSITIONS))
        return self._replace(arrays={**self.arrays, POSITIONS: qpos.tobytes()}) if has_moment else self


class SimulationState(NamedTuple):
    """State of a simulation besides its scene, robots and lamps.

    Attributes:
        steps: Number of steps done.
        phase: Part of the current step that is done, a `step.Phase`.
        keys: Key of each robot's random draws; empty without noise.
        n_conversions: Number of conversions of each robot so far.
        noise: Scale of the noise, if there are keys.
    """

    steps: Annotated[int, Field(ge=0, lt=2**62)]
    phase: Annotated[int, Field(ge=Phase.DONE, le=Phase.TICKED)]
    keys: tuple[Annotated[int, Field(ge=0, lt=2**64)], ...]
    n_conversions: Annotated[int, Field(ge=0, lt=2**62)]
    noise: Scale = 1.0  # the default is that of snapshots without it


class WorldState(NamedTuple):
    """State of a world.

    Attributes:
        time_ns: Current time [ns].
        physics: State of the physics.
        simulation: State of the stepping core.
        robots: State of each robot.
        lamps: All lamps, which may differ from those of the playpen.
        lighting: Their lighting.
        lamps_state: State of the lamps.
        lamps_stream: Position in their random stream.
        pending_events: Events of which observers have not been notified: robot and text.
        failure: Message of the error that has ended the run; empty for none.
    """

    time_ns: Annotated[int, Field(ge=0, lt=2**62)]
    physics: PhysicsState
    simulation: SimulationState
    robots: tuple[RobotSnapshot, ...]
    lamps: tuple[Lamp, ...]
    lighting: Lighting
    lamps_state: LampsState
    lamps_stream: StreamState
    pending_events: tuple[tuple[int | None, str], ...]
    failure: str
