"""`LineServer`: a program on a robot that answers requests on its line, at one baud rate, without turrets."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, MutableSequence, Sequence
from typing import Any

from khep_twin.board.turrets import Turret, TurretKind
from khep_twin.firmware import FirmwareState
from khep_twin.robots.model import Dialect
from khep_twin.robots.vehicle import LAST_LEFT, LAST_RIGHT, N_STILL, TURNING, WANDERING, Vehicle
from khep_twin.sensing.buffers import Vector

LONGEST_REQUEST = 1024
"""Bytes of an incomplete request that are kept."""

_BLOCKED, _N_STUCK = 250, 5
"""Front reading above which a vehicle is blocked, and rounds without motion after which it is stuck."""

Command = tuple[str, Sequence[int]]
"""Letter and numbers of a command."""

Reply = Any
"""Values of a reply, a whole reply, or None for an error."""


class LineServer:
    """Program that answers requests.

    Args:
        dialect: Protocol on the line.
        execute: Function that executes a request, without the ending of a line, and returns the reply.
        is_powered: Function that returns whether the robot has power.

    Attributes:
        baud: Speed of the line [baud].
        reply_baud: Same as `baud`.
        turrets: Always empty.
        answer_ns: Time from a command to its reply [ns].
    """

    answer_ns = 0
    program = ""
    """Name of the program in snapshots."""

    def __init__(
        self,
        dialect: Dialect,
        execute: Callable[[bytes], bytes],
        is_powered: Callable[[], bool] = lambda: True,
    ) -> None:
        self.baud = self.reply_baud = dialect.baud
        self._framing = dialect.framing
        self._execute, self._is_powered = execute, is_powered
        self.turrets: Mapping[TurretKind, Turret] = {}
        self._line, self._running = b"", self.program

    @property
    def powered(self) -> bool:
        """True while the robot has power."""
        return self._is_powered()

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
        """Return the state besides that in the robot's registers and of its vehicle."""
        return FirmwareState(self.baud, self.reply_baud, self._running, self._line, {})

    def set_state(self, state: FirmwareState) -> None:
        """Restore a state.

        Raises:
            ValueError: It is of another robot.
        """
        running = state.running or self.program
        expected_state = FirmwareState(self.baud, self.baud, self.program, state.partial_line, {})
        if state._replace(running=running) != expected_state:
            raise ValueError(
                f"baud = {state.baud}, {state.reply_baud}, program {state.running!r}, turrets "
                f"{sorted(state.turrets)}; expected {self.baud} baud, {self.program!r}, without turrets"
            )
        self._line, self._running = state.partial_line, state.running


class VehicleServer(LineServer, ABC):
    """A program whose commands are letters with numbers; it starts with the first bytes, by its command M.

    A method `_on_b` executes command B; it returns values, or a whole reply, or None for an error.

    Args:
        dialect, is_powered: See `LineServer`.
        vehicle: Numbers of its vehicle.
        state: State of the vehicle, all 0 while it does not drive.
    """

    end = b"\r\n"  # of a reply
    longest = 82  # bytes of a request that are read
    discards = True  # the input after a command

    def __init__(
        self,
        dialect: Dialect,
        vehicle: Vehicle,
        state: Vector[int] | MutableSequence[int],
        is_powered: Callable[[], bool],
    ) -> None:
        super().__init__(dialect, self.execute, is_powered)
        self._vehicle, self._state = vehicle, state
        self._gain: int | None = None
        self.forget()

    def forget(self) -> None:
        """End the program; it restarts with the next bytes."""
        super().forget()
        self._running = ""
        for index in range(len(self._state)):
            self._state[index] = 0

    def receive(self, data: bytes) -> bytes:
        """Receive bytes; return the replies to the commands that they complete."""
        if not self.powered:
            return b""
        if not self._running:
            self._running = self.program
            self._run("M", ())
        messages, line = self._framing.split(self._line + data, to_robot=True)
        self._line, replies = line[: self.longest], b""
        for request in filter(None, messages):
            replies += self.execute(request[: self.longest])
            if replies and self.discards:
                self._line = b""
                break
        return replies

    def execute(self, request: bytes) -> bytes:
        """Execute a command; return its reply."""
        command = self._parse(request)
        reply = None if command is None else self._run(*command)
        if isinstance(reply, bytes):
            return reply
        if command is None or reply is None:
            return b"$" + self.end
        return ",".join([command[0].lower(), *map(str, reply)]).encode() + self.end

    def tick(self) -> None:
        """Run the vehicle, if it drives, for a round."""
        state, vehicle = self._state, self._vehicle
        if not state[WANDERING]:
            return
        readings, positions, was_turning = self._readings(), self._run("R", ()), state[TURNING]
        is_blocked = max(readings[vehicle.front]) > _BLOCKED
        if vehicle.waits and was_turning and is_blocked:
            return
        is_still = all(map(vehicle.is_near, positions, (int(state[LAST_LEFT]), int(state[LAST_RIGHT]))))
        state[N_STILL] = state[N_STILL] + 1 if is_still else 0
        is_stuck = state[N_STILL] > _N_STUCK
        is_turning = is_stuck if vehicle.waits else is_blocked and (was_turning or is_stuck)
        state[TURNING] = int(is_turning)
        if (is_stuck or not is_still) and (vehicle.waits or not is_turning):
            state[N_STILL], state[LAST_LEFT], state[LAST_RIGHT] = 0, *positions
        turn = vehicle.turn * vehicle.unit
        self._order_speeds((turn, -turn) if is_turning else vehicle.speeds(readings, self._gain))

    @abstractmethod
    def _parse(self, request: bytes) -> Command | None:
        """Return letter and numbers of a request; None if it is malformed."""

    def _run(self, letter: str, values: Sequence[int]) -> Reply:
        handler = getattr(self, f"_on_{letter.lower()}", None)
        return None if handler is None else handler(values)

    def _start_vehicle(self, level: int, positions: Sequence[int]) -> Reply:
        for index, value in enumerate((level, 0, 0, *positions)):
            self._state[index] = value
        return ()

    def _readings(self) -> Reply:
        return self._run("N", ())

    def _order_speeds(self, speeds: tuple[int, int]) -> None:
        self._run("D", speeds)
