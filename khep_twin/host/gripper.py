"""`Gripper`: the gripper turret of a robot at the other end of a serial port, real or simulated.

from khep_twin.host import Gripper, Khepera

with Khepera("khep://gripper") as robot:
    gripper = Gripper(robot)
    gripper.lower()
    gripper.close()
    gripper.wait()
    gripper.lift()
"""

from khep_twin.errors import PortTimeout
from khep_twin.host.turret import HostTurret
from khep_twin.units import ARM_DOWN, ARM_UP, GRIPPER_NUMBER

_POLL_INTERVAL_S = 0.1
"""Time between two reads of the positions [s]."""


class Gripper(HostTurret):
    """Gripper on a robot. Commands return immediately; `wait` waits for their completion.

    Raises:
        ProtocolError: The robot has no gripper.
    """

    number, name = GRIPPER_NUMBER, "gripper"

    def open(self) -> None:
        """Open the fingers (command D)."""
        self.ask("D,0", 0)

    def close(self) -> None:
        """Close the fingers (command D)."""
        self.ask("D,1", 0)

    def move_arm(self, position: int) -> None:
        """Move the arm to a position, 152 (up) to 255 (down) (command E)."""
        self.ask(f"E,{position}", 0)

    def lower(self) -> None:
        """Move the arm down, the fingers to the floor (command E)."""
        self.move_arm(ARM_DOWN)

    def lift(self) -> None:
        """Move the arm up (command E)."""
        self.move_arm(ARM_UP)

    def resistivity(self) -> int:
        """Return the resistivity between the fingers, 255 insulator or empty, 0 short (command F)."""
        return self.ask("F", 1)[0]

    def barrier(self) -> int:
        """Return the light barrier between the fingers, 0 free to 255 dark (command G)."""
        return self.ask("G", 1)[0]

    def fingers(self) -> int:
        """Return the position of the fingers, 0 closed to 200 open (command H)."""
        return self.ask("H,0", 1)[0]

    def arm(self) -> int:
        """Return the position of the arm, 152 up to 255 down (command H)."""
        return self.ask("H,1", 1)[0]

    def wait(self, timeout: float = 5.0) -> None:
        """Wait until neither arm nor fingers move.

        Raises:
            PortTimeout: They still move after `timeout` [s].
        """
        end = self._robot.time + timeout
        last_positions = None
        while last_positions != (positions := (self.arm(), self.fingers())):
            if not self._robot.time <= end:
                raise PortTimeout(f"{self._robot.name}: the gripper still moves after {timeout} s")
            last_positions = positions
            self._robot.sleep(_POLL_INTERVAL_S)
