"""Connection to a robot of any model, by its host class."""

from typing import Any, cast

from khep_twin.host.host_robot import HostRobot, open_robot
from khep_twin.host.opening import BAUD_RATES, find_baud_rate
from khep_twin.host.robot_port import RobotPort
from khep_twin.robots.framing import LINES
from khep_twin.robots.registry import default_model, find_family, find_model, find_replying_model


def connect(url: str, timeout: float | None = None, baudrate: int = 0, family: str = "") -> HostRobot:
    """Open the robot at a port as an object of its model's host class.

    Args:
        url: URL of the port.
        timeout: Longest wait for a silent robot [s], as for a `Khepera`.
        baudrate: Baud rate; 0 for that of a twin in this process, and to try all rates of a robot.
        family: Family of models whose baud rate is tried first; empty for the default one. At a server with
            the wire clock, where an identification would let time pass, the robot is one of these.

    Raises:
        PortError: The port cannot be opened, or no robot of an installed model identifies itself.
    """
    expected_model = find_family(family or default_model().family)
    first_baudrate = baudrate or expected_model.dialect.baud
    port = RobotPort(url, timeout, first_baudrate, 1, LINES)
    if port.model is not None:
        port.serial_port.baudrate = baudrate or cast(Any, port.serial_port).robot_baudrate
        return open_robot(find_model(port.model), port.serial_port, timeout=timeout)
    if not port.clock_speed:
        port.close()
        return open_robot(expected_model, url, timeout=timeout, baudrate=first_baudrate)
    rates = (first_baudrate,) if baudrate else dict.fromkeys((first_baudrate, *BAUD_RATES))
    try:
        found_baudrate, identity = find_baud_rate(
            port.serial_port, port.name, lambda: port.timeout_time, [*rates]
        )
    finally:
        port.close()
    model = find_replying_model(identity) or expected_model
    modes = [mode for rom in model.roms.values() for mode in rom.modes.values()]
    # A twin at a port without a baud rate answers at any, also at one that its robot has not.
    has_rate = baudrate or any(mode.baud == found_baudrate for mode in modes)
    robot = open_robot(
        model, url, timeout=timeout, baudrate=found_baudrate if has_rate else model.dialect.baud
    )
    robot.identity = identity
    return robot
