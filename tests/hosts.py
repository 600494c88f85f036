"""Hosts at twins in this process."""

from khep_twin.host import HostRobot


def answer_once(robot: HostRobot, reply: bytes) -> None:
    """Let the robot's twin give this reply to the next bytes that it receives."""
    firmware = robot.port.twin.robot.firmware  # type: ignore[attr-defined]
    receive = firmware.receive

    def answer(data: bytes) -> bytes:
        firmware.receive = receive
        return reply

    firmware.receive = answer
