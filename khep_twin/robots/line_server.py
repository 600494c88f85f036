"""`LineServer`: a program on a robot that answers requests on its line, at one baud rate, without turrets."""

from collections.abc import Callable, Mapping, MutableSequence

from khep_twin.board.turrets import Turret, TurretKind
from khep_twin.firmware import FirmwareState
from khep_twin.robots.model import Dialect
from khep_twin.sensing.buffers import Vector

LONGEST_REQUEST = 1024
"""Bytes of an incomplete request that are kept."""


class LineServer:
    """Program that answers requests.

    Args:
        dialect: Protocol on the line.
        execute: Function that executes a request, without the ending of a line, and returns the reply.

    Attributes:
        baud: Speed of the line [baud].
        reply_baud: Same as `baud`.
        turrets: Always empty.
        answer_ns: Time from a command to its reply [ns].
    """

    answer_ns = 0
    program = ""
    """Name of the program in snapshots."""

    def __init__(self, dialect: Dialect, execute: Callable[[bytes], bytes]) -> None:
        self.baud = self.reply_baud = dialect.baud
        self._framing = dialect.framing
        self._execute = execute
        self.turrets: Mapping[TurretKind, Turret] = {}
        self._line = b""

    @property
    def powered(self) -> bool:
        """True while the robot has power."""
        return True

    def request_length(self, data: bytearray) -> int:
        """Return how many of the next bytes complete a request; more than their number if they do not."""
        # They may show that the bytes before them are noise.
        return max(self._framing.length(self._line + data, to_robot=True) - len(self._line), 1)

    def receive(self, data: bytes) -> bytes:
        """Receive bytes; return the replies to the requests that they complete, without noise."""
        messages, self._line = self._framing.split(self._line + data, to_robot=True)
        self._line = self._line[:LONGEST_REQUEST]
        requests = (message for message in messages if message and self._framing.is_message(message, True))
        return b"".join(map(self._execute, requests))

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


class VehicleServer(LineServer):
    """A program that starts with the first bytes received, and drives the robot as a vehicle on request.

    Args:
        dialect, execute: See `LineServer`.
        vehicle: State of the vehicle, all 0 while it does not drive.
    """

    def __init__(
        self,
        dialect: Dialect,
        execute: Callable[[bytes], bytes],
        vehicle: Vector[int] | MutableSequence[int],
    ) -> None:
        super().__init__(dialect, execute)
        self._vehicle = vehicle
        self.forget()

    def forget(self) -> None:
        """End the program; it restarts with the next bytes."""
        super().forget()
        self._is_running = False
        for index in range(len(self._vehicle)):
            self._vehicle[index] = 0

    def state(self) -> FirmwareState:
        """Return the state without that of the vehicle."""
        return super().state()._replace(running=self.program if self._is_running else "")

    def set_state(self, state: FirmwareState) -> None:
        """Restore a state without that of the vehicle.

        Raises:
            ValueError: It is of another robot.
        """
        super().set_state(state._replace(running=state.running or self.program))
        self._is_running = bool(state.running)
