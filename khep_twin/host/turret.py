"""`HostTurret`: common part of the turrets of a robot at the other end of a serial port."""

import re

from khep_twin.board.turrets import TurretKind
from khep_twin.errors import ProtocolError
from khep_twin.host.khepera import Khepera

_NUMBER = re.compile("[0-9]{1,6}")
"""Numbers in replies of turrets: unsigned, of 16 bits at most."""


class HostTurret:
    """Turret on a robot.

    Args:
        robot: Robot that carries it.
        kind: Kind of the turret; None for that of the class.

    Attributes:
        number: Number on the T bus.
        name: Name in messages.

    Raises:
        ProtocolError: The robot does not have this turret.
    """

    number: int
    name: str

    def __init__(self, robot: Khepera, kind: TurretKind | None = None) -> None:
        if kind is not None:
            self.number, self.name = kind.number, kind.name
        self._robot = robot
        self.versions()

    def versions(self) -> tuple[str, str]:
        """Return the versions that the turret reports for its software (command B)."""
        fields = self._robot.turret(self.number, "B").split(",")
        if len(fields) != 3 or fields[0] != "b":
            raise ProtocolError(f"{self._robot.name}: the {self.name} reported its versions as {fields}")
        return fields[1], fields[2]

    def ask(self, message: str, count: int) -> list[int]:
        """Return the numbers of the answer to a message; raise a `ProtocolError` for another answer."""
        answer = self._robot.turret(self.number, message)
        head, *fields = answer.split(",")
        if head != message[0].lower() or len(fields) != count or not all(map(_NUMBER.fullmatch, fields)):
            raise ProtocolError(f"{self._robot.name}: the {self.name} answered {message!r} with {answer!r}")
        return [int(field) for field in fields]
