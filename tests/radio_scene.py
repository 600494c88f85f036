"""Robots that carry radios: playpens with them, and radios alone, period by period."""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

from khep_twin import playpen
from khep_twin.board.radio import RadioElectronics
from khep_twin.playpen import Playpen, RadioChannel
from khep_twin.sensing.radio_body import RadioBody
from khep_twin.units import TICK_NS, RadioStatus
from khep_twin.world import World


def playpen_with_radios(
    places: Sequence[tuple[float, float]], extra_tables: str = "", turrets: str = '"radio"'
) -> Playpen:
    """Return a playpen with a robot at each of these places [mm], and more tables."""
    robots = "".join(
        f"[[robot]]\nx_mm = {x}\ny_mm = {y}\nheading_deg = 0\nturrets = [{turrets}]\n" for x, y in places
    )
    arena = 'version = 1\nname = "radios"\n[arena]\nwidth_mm = 1000\nheight_mm = 500\n'
    return playpen.parse(f"{arena}{extra_tables}\n{robots}", "radios.toml")


class Message(NamedTuple):
    """A message with the number of its sender."""

    sender: int
    data: bytes


class Place:
    """A `TurretContext` of a robot that stands still."""

    def __init__(self, air: "Air", robot: int, settings: Mapping[str, float]) -> None:
        self.model, self.data = air.world.model, air.world.data
        self.prefix, self.robot = f"khepera{robot}/radio/", robot
        self.registers = air.electronics[robot].registers
        self.lamps: Sequence[tuple[float, float, float, float]] = ()
        self.noise, self.settings = 1.0, settings
        self.key = (0x12345678 + robot * 0x9E3779B1 & 0xFFFFFFFF, air.seed)
        self._air = air

    @property
    def time_ns(self) -> int:
        return self._air.time_ns

    @property
    def peers(self) -> Sequence[RadioBody | None]:
        return self._air.bodies


class Air:
    """Radios on robots that stand still, without a step of the physics.

    Args:
        world: World with the robots.
        seed: Seed of the draws.
        channel: The playpen's table.
    """

    def __init__(self, world: World, seed: int = 0, **channel: float) -> None:
        self.world, self.seed, self.time_ns = world, seed, 0
        self.electronics = [RadioElectronics() for _ in world.robots]
        settings = RadioChannel(**channel).model_dump()  # type: ignore[arg-type]
        self.bodies = [RadioBody(Place(self, robot, settings)) for robot in range(len(world.robots))]

    def send(self, sender: int, to: int, data: bytes) -> bool:
        """Gives the order of a message; returns whether it was accepted."""
        numbers = [to, len(data), *data, *[0] * (16 - len(data))]
        return (
            self.electronics[sender - 1].receive(f"S,{','.join(map(str, numbers))}".encode()) == b"t,4,s\r\n"
        )

    def status(self, number: int) -> RadioStatus:
        return RadioStatus(int(self.electronics[number - 1].receive(b"F").split(b",")[3]))

    def read(self, number: int) -> list[Message]:
        """Reads and removes all messages of a radio."""
        messages: list[Message] = []
        while self.status(number) & RadioStatus.RECEIVED:
            sender, length, *data = map(int, self.electronics[number - 1].receive(b"R").split(b",")[3:])
            messages.append(Message(sender, bytes(data[:length])))
        return messages

    def tick(self, order: Sequence[int] | None = None) -> None:
        """Runs a control period of the turrets, robot by robot in this order."""
        self.time_ns += TICK_NS
        for robot in range(len(self.bodies)) if order is None else order:
            self.bodies[robot].sense()
            self.electronics[robot].tick()
            self.bodies[robot].drive()

    def registers(self) -> list[list[int]]:
        return [radio.registers.tolist() for radio in self.electronics]
