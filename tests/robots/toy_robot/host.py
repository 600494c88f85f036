"""`Toy`: a Toy at the other end of a port."""

from khep_twin.host.host_robot import HostRobot
from toy_robot.model import TOY


class Toy(HostRobot):
    """A Toy behind a port. Leaving it as a context stops the motors."""

    model = TOY

    def set_speed(self, left: float, right: float) -> None:
        """Drive the wheels at these speeds [m/s]."""
        self.set_setpoints(round(1000 * left), round(1000 * right))
