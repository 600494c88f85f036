"""Observers of a world, for samples of its state, bytes on its lines, and events."""

from collections.abc import Callable
from typing import Any, Protocol

import mujoco

from khep_twin import units
from khep_twin.board.uart import HostEvent

SAMPLE_NS = units.SCAN_NS
"""Sampling period of the observers [ns]."""


class Observer(Protocol):
    """Observer of a world, for example a recorder; methods that a subclass does not define do nothing."""

    def sample(self, world: Any) -> None:
        """Observe the `World`; called every SAMPLE_NS and at its start."""

    def on_bytes(self, time_ns: int, robot: int, to_robot: bool, data: bytes) -> None:
        """Observe bytes that crossed a robot's line, the last of them at `time_ns`."""

    def on_host_event(self, time_ns: int, robot: int, event: HostEvent) -> None:
        """Observe an action of a robot's host on the line."""

    def on_event(self, time_ns: int, robot: int | None, text: str) -> None:
        """Observe a logged event."""


class ObservedWorld(Protocol):
    """Interface of a world to its observers."""

    model: mujoco.MjModel
    data: mujoco.MjData

    @property
    def time_ns(self) -> int:
        """Current time [ns]."""
        ...


class Observers(list[Observer]):
    """Observers of a world, in the order in which they are notified.

    Args:
        world: World.

    Attributes:
        early_events: Events at time 0, for observers that are added later: robot and text.
        evaluations: Functions by which robots evaluate their recorded measurements.
    """

    def __init__(self, world: ObservedWorld) -> None:
        super().__init__()
        self._world = world
        self.early_events: list[tuple[int | None, str]] = []
        self.evaluations: list[Callable[[], None]] = []

    def sample(self, *observers: Observer) -> None:
        """Let some observers sample the world, by default all."""
        if self:
            # After a step, the positions of bodies are those at its start; observers sample those at its end.
            mujoco.mj_kinematics(self._world.model, self._world.data)
            self.evaluate()
            for observer in observers or self:
                observer.sample(self._world)

    def evaluate(self) -> None:
        """Let robots evaluate their recorded measurements, as before a change of lamps or random streams."""
        for function in self.evaluations:
            function()

    def on_bytes(self, time_ns: int, robot: int, to_robot: bool, data: bytes) -> None:
        """Send bytes that crossed a robot's line, the last of them at `time_ns`."""
        for observer in self:
            observer.on_bytes(time_ns, robot, to_robot, data)

    def on_host_event(self, robot: int, event: HostEvent) -> None:
        """Send an action of a robot's host at the current time."""
        for observer in self:
            observer.on_host_event(self._world.time_ns, robot, event)

    def on_event(self, robot: int | None, text: str) -> None:
        """Send an event that follows from the state."""
        if self._world.time_ns == 0 and not self:
            self.early_events.append((robot, text))
        for observer in self:
            observer.on_event(self._world.time_ns, robot, text)
