"""Terms: further readings and outputs of controllers of episodes, of a robot or of its turrets."""

from collections.abc import Callable
from typing import NamedTuple


class Term(NamedTuple):
    """Further readings that tasks observe and controllers of episodes read, by registers.

    Attributes:
        name: Name.
        register: Register of the first reading; the others follow.
        names: Names of the readings.
        low: Lowest value that counts.
        high: Highest value that counts.
        unit: Unit of the readings.
        turret: Name of the turret that has the register; empty for one of the robot.
        message: Message to the turret whose reply has the readings.
        order: Function that returns the message by which a controller sets the reading; None if it cannot.
    """

    name: str
    register: int
    names: tuple[str, ...]
    low: float
    high: float
    unit: str
    turret: str = ""
    message: str = ""
    order: Callable[[int], str] | None = None

    @property
    def registers(self) -> tuple[int, int]:
        """First register of the readings, and the end of them."""
        return self.register, self.register + len(self.names)

    @property
    def zero(self) -> float:
        """Value that is the input 0 of a network; `high` is 1, and values are clipped to `low` and `high`."""
        return max(self.low, 0.0)

    def unscale(self, output: float) -> float:
        """Return the value that an output of a network sets: `low` for -1 to `high` for 1."""
        return self.low + (self.high - self.low) * (output + 1) / 2

    def order_for(self, value: float) -> str:
        """Return the message for a value, which is rounded and clipped."""
        return "" if self.order is None else self.order(round(min(max(value, self.low), self.high)))
