"""`Toy`: a Toy at the other end of a port."""

from khep_twin.files.paths import StrPath
from khep_twin.host.host_command import HostCommand, split_reply
from khep_twin.host.host_robot import HostRobot
from toy_robot.core import AMBIENT, N_INFRARED, N_REGISTERS, POSITION, PROXIMITY, SPEED, ULTRASONIC
from toy_robot.model import BAUD, BODY, TOY


class Toy(HostRobot):
    """A Toy behind a port. Leaving it as a context stops the motors."""

    def __init__(
        self, url: StrPath, timeout: float | None = None, baudrate: int = BAUD, *, retries: int = 1
    ) -> None:
        super().__init__(url, timeout, baudrate, retries, TOY.dialect)

    def set_speed(self, left: float, right: float) -> None:
        """Drive the wheels at these speeds [m/s]."""
        texts = (round(1000 * speed).to_bytes(2, "big", signed=True).hex() for speed in (left, right))
        self._run(HostCommand(f"M,{','.join(texts)}", lambda reply: split_reply("m", 0, reply)))

    def stop(self) -> None:
        """Stop the wheels."""
        self.set_speed(0, 0)

    def read(self, first: int, count: int = 1) -> list[int]:
        """Return registers."""
        texts = self._run(HostCommand("R", lambda reply: split_reply("r", N_REGISTERS, reply), True))
        numbers = [int.from_bytes(bytes.fromhex(text), "big", signed=True) for text in texts]
        return numbers[first : first + count]

    def proximity(self) -> list[int]:
        """Return the counts of the infrared sensors."""
        return self.read(PROXIMITY, N_INFRARED)

    def distance(self) -> float:
        """Return the distance that the ultrasonic sensor measures [m]; 0 without an echo."""
        return self.read(ULTRASONIC)[0] / 1000

    def position(self) -> tuple[float, float]:
        """Return the ways of the wheels [m]."""
        left, right = self.read(POSITION, 2)
        return left * BODY.pulse_length, right * BODY.pulse_length

    def read_panel(self) -> dict[str, list[int]]:
        """Return the values of a panel."""
        values = self.read(0, N_REGISTERS)
        parts = {"proximity": (PROXIMITY, 5), "ambient": (AMBIENT, 5), "speed": (SPEED, 2)}
        return {name: values[first : first + count] for name, (first, count) in parts.items()}
