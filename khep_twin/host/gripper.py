"""`Gripper`: the gripper turret of a robot at the other end of a serial port, real or simulated.

from khep_twin.host import Gripper, Khepera

with Khepera("khep://gripper") as robot:
    gripper = Gripper(robot)
    gripper.lower()
    gripper.close()
    gripper.wait()
    gripper.lift()
"""

from khep_twin.errors import PortTimeout, ProtocolError
from khep_twin.host.khepera import Khepera
from khep_twin.units import ARM_DOWN, ARM_UP, GRIPPER_NUMBER

_PAUSE = 0.1
"""Between two looks at what moves [s]."""


class Gripper:
    """A gripper on top of a robot. Orders return at once; `wait` waits until they are done.

    Args:
        robot: that carries it.

    Raises:
        ProtocolError: the robot has no gripper.
    """

    def __init__(self, robot: Khepera) -> None:
        self._robot = robot
        self.versions()

    def versions(self) -> tuple[str, str]:
        """B: versions of its software, as the turret tells them."""
        fields = self._robot.turret(GRIPPER_NUMBER, "B").split(",")
        if len(fields) != 3:
            raise ProtocolError(f"{self._robot.name}: the gripper told its versions as {fields}")
        return fields[1], fields[2]

    def open(self) -> None:
        """D: opens the fingers."""
        self._robot.turret(GRIPPER_NUMBER, "D,0")

    def close(self) -> None:
        """D: closes the fingers."""
        self._robot.turret(GRIPPER_NUMBER, "D,1")

    def move_arm(self, place: int) -> None:
        """E: sends the arm to a place, 152 (up) to 255 (down)."""
        self._robot.turret(GRIPPER_NUMBER, f"E,{place}")

    def lower(self) -> None:
        """E: sends the arm down, the fingers to the floor."""
        self.move_arm(ARM_DOWN)

    def lift(self) -> None:
        """E: sends the arm up."""
        self.move_arm(ARM_UP)

    def resistivity(self) -> int:
        """F: of what both fingers touch, 255 for an insulator or nothing, 0 for a short circuit."""
        return self._value("F")

    def barrier(self) -> int:
        """G: light barrier between the fingers, 0 free to 255 dark."""
        return self._value("G")

    def fingers(self) -> int:
        """H: where the fingers are, 0 closed to 200 open."""
        return self._value("H,0")

    def arm(self) -> int:
        """H: where the arm is, 152 up to 255 down."""
        return self._value("H,1")

    def wait(self, timeout: float = 5.0) -> None:
        """Waits until neither arm nor fingers move.

        Raises:
            PortTimeout: they still do after `timeout` [s].
        """
        end = self._robot.time + timeout
        before = None
        while before != (now := (self.arm(), self.fingers())):
            if self._robot.time > end:
                raise PortTimeout(f"{self._robot.name}: the gripper still moves after {timeout} s")
            before = now
            self._robot.sleep(_PAUSE)

    def _value(self, message: str) -> int:
        answer = self._robot.turret(GRIPPER_NUMBER, message)
        letter, _, value = answer.partition(",")
        if letter != message[0].lower() or not value.isdigit():
            raise ProtocolError(f"{self._robot.name}: the gripper answered {message!r} with {answer!r}")
        return int(value)
