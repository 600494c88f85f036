"""`Scout`: a Scout at the other end of a port."""

from khep_twin.host.host_robot import HostRobot
from second_robot.model import SCOUT


class Scout(HostRobot):
    """A Scout behind a port. Leaving it as a context stops the motors."""

    model = SCOUT

    def set_speed(self, left: float, right: float) -> None:
        """Drive the wheels at these speeds [rad/s]."""
        self.set_setpoints(round(100 * left), round(100 * right))
