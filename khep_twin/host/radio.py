"""`Radio`: the radio turret of a robot at the other end of a serial port, real or simulated.

from khep_twin.host import Khepera, Radio

with Khepera("/dev/ttyUSB0") as robot:
    radio = Radio(robot)
    radio.send(2, b"hello")  # to the robot with the number 2
    if radio.wait_until_sent():
        print(radio.wait_for_message())
"""

from typing import NamedTuple

from khep_twin.errors import PortTimeout, ProtocolError
from khep_twin.host.turret import HostTurret
from khep_twin.units import RADIO_ALL, RADIO_BYTES, RADIO_NUMBER, RadioStatus

_POLL_INTERVAL_S = 0.02
"""Time between two reads of the status [s]."""


class RadioMessage(NamedTuple):
    """Received message: number of the radio that sent it, and its bytes."""

    sender: int
    data: bytes


class Radio(HostTurret):
    """Radio turret on a robot. `send` returns immediately; `wait_until_sent` waits for the acknowledgement.

    Raises:
        ProtocolError: The robot has no radio turret.
    """

    number, name = RADIO_NUMBER, "radio"

    def status(self) -> RadioStatus:
        """Return the status bits (command F)."""
        return RadioStatus(self.ask("F", 1)[0])

    def send(self, to: int, data: bytes) -> None:
        """Send a message of up to 16 bytes to the radio with this number (command S).

        Raises:
            ValueError: The message is too long.
            ProtocolError: The turret still sends the previous message, or the number is invalid.
        """
        if len(data) > RADIO_BYTES:
            raise ValueError(f"a message of {len(data)} bytes; expected at most {RADIO_BYTES}")
        padded = data + bytes(RADIO_BYTES - len(data))
        self.ask(f"S,{to},{len(data)}," + ",".join(map(str, padded)), 0)

    def broadcast(self, data: bytes) -> None:
        """Send a message of up to 16 bytes to all radios, which do not acknowledge it (command S).

        Raises:
            ValueError: The message is too long.
            ProtocolError: The turret still sends the previous message.
        """
        self.send(RADIO_ALL, data)

    def receive(self) -> RadioMessage | None:
        """Return the oldest received message and remove it from the turret; None without one (command R).

        Raises:
            ProtocolError: The reply is malformed, as on a disturbed line.
        """
        sender, length, *data = self.ask("R", 2 + RADIO_BYTES)
        if length > RADIO_BYTES or max(data) > 255:
            content = f"{length} bytes, {data}"
            expected = f"at most {RADIO_BYTES}, of 0 to 255"
            raise ProtocolError(f"{self._robot.name}: the radio received {content}; expected {expected}")
        return RadioMessage(sender, bytes(data[:length])) if sender or length else None

    def wait_until_sent(self, timeout: float = 5.0) -> bool:
        """Wait until the turret has sent its message; return whether it was acknowledged.

        A message to all counts as acknowledged.

        Raises:
            PortTimeout: The turret still sends after `timeout` [s].
        """
        end = self._robot.time + timeout
        while not (status := self.status()) & RadioStatus.READY:
            self._pause(end, f"the radio still sends after {timeout} s")
        return not status & RadioStatus.FAILED

    def wait_for_message(self, timeout: float = 5.0) -> RadioMessage:
        """Wait for a message; return it and remove it from the turret.

        Raises:
            PortTimeout: No message arrived within `timeout` [s].
        """
        end = self._robot.time + timeout
        while not self.status() & RadioStatus.RECEIVED:
            self._pause(end, f"no message came within {timeout} s")
        message = self.receive()
        if message is None:
            raise ProtocolError(f"{self._robot.name}: the radio reported a message and then had none")
        return message

    def _pause(self, end: float, problem: str) -> None:
        """Pause between two reads; raise PortTimeout with the problem after `end` [s]."""
        if not self._robot.time <= end:
            raise PortTimeout(f"{self._robot.name}: {problem}")
        self._robot.sleep(_POLL_INTERVAL_S)
