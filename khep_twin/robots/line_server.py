"""`LineServer`: a program on a robot that answers lines, at one baud rate, without turrets."""

from abc import ABC, abstractmethod
from collections.abc import Mapping

from khep_twin.board.protocol import LINE_END
from khep_twin.board.turrets import Turret, TurretKind
from khep_twin.firmware import FirmwareState


class LineServer(ABC):
    """Program that answers lines.

    Args:
        baud: Speed of the line [baud].

    Attributes:
        baud: Speed of the line [baud].
        reply_baud: Same as `baud`.
        turrets: Always empty.
        answer_ns: Time from a command to its reply [ns].
    """

    answer_ns = 0
    program = ""
    """Name of the program in snapshots."""

    def __init__(self, baud: int) -> None:
        self.baud = self.reply_baud = baud
        self.turrets: Mapping[TurretKind, Turret] = {}
        self._line = b""

    @abstractmethod
    def execute(self, line: bytes) -> bytes:
        """Execute a line without its ending; return the reply with its ending."""

    @property
    def powered(self) -> bool:
        """True while the robot has power."""
        return True

    def receive(self, data: bytes) -> bytes:
        """Receive bytes; return the replies to the lines that they complete."""
        replies, self._line = b"", self._line + data
        while end := LINE_END.search(self._line):
            line, self._line = self._line[: end.start()], self._line[end.end() :]
            replies += self.execute(line) if line else b""
        return replies

    def forget_line(self) -> None:
        """Discard the incomplete line."""
        self._line = b""

    def forget(self) -> None:
        """End the program; it restarts with the next bytes."""
        self.forget_line()

    def reset(self) -> bytes:
        """Reset robot and program; return its banner, which is empty."""
        self.forget()
        return b""

    def baud_rate_hint(self, baud: int) -> str:
        """Return a hint on how to match the baud rates of robot and host."""
        return f"expected {self.baud} baud at the host, not {baud}"

    def state(self) -> FirmwareState:
        """Return the state besides that in the robot's registers."""
        return FirmwareState(self.baud, self.reply_baud, self.program, self._line, {})

    def set_state(self, state: FirmwareState) -> None:
        """Restore a state.

        Raises:
            ValueError: It is of another robot.
        """
        if state._replace(partial_line=b"") != FirmwareState(self.baud, self.baud, self.program, b"", {}):
            raise ValueError(
                f"baud = {state.baud}, {state.reply_baud}, program {state.running!r}, turrets "
                f"{sorted(state.turrets)}; expected {self.baud} baud, {self.program!r}, without turrets"
            )
        self._line = state.partial_line
