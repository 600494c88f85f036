"""Observers that store the events and samples of a world."""

from khep_twin.board.uart import HostEvent
from khep_twin.observers import Observer
from khep_twin.world import World


class Notes(Observer):
    """An observer that keeps the texts of events."""

    def __init__(self) -> None:
        self.events: list[str] = []

    def on_event(self, time_ns: int, robot: int | None, text: str) -> None:
        """Keep the text."""
        self.events.append(text)


class Events:
    """An observer that notes everything with its time."""

    def __init__(self) -> None:
        self.samples: list[object] = []

    def sample(self, world: World) -> None:
        self.samples.append((world.time_ns, world.data.xpos.tobytes()))

    def on_bytes(self, time_ns: int, robot: int, to_robot: bool, data: bytes) -> None:
        self.samples.append((time_ns, robot, to_robot, data))

    def on_host_event(self, time_ns: int, robot: int, event: HostEvent) -> None:
        self.samples.append((time_ns, robot, event))

    def on_event(self, time_ns: int, robot: int | None, text: str) -> None:
        self.samples.append((time_ns, robot, text))
