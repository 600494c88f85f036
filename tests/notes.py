"""A tap that keeps the events of a world."""

from khep_twin.board.uart import HostEvent
from khep_twin.world import World


class Notes:
    """A tap that keeps the events."""

    def __init__(self) -> None:
        self.told: list[str] = []

    def sample(self, world: World) -> None:
        """Nothing."""

    def on_bytes(self, time_ns: int, robot: int, to_robot: bool, data: bytes) -> None:
        """Nothing."""

    def on_host_event(self, time_ns: int, robot: int, event: HostEvent) -> None:
        """Nothing."""

    def on_event(self, time_ns: int, robot: int | None, text: str) -> None:
        """Keeps it."""
        self.told.append(text)
