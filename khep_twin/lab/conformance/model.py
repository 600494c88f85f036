"""Models of robots that differ in their protocol."""

from enum import StrEnum


class RobotModel(StrEnum):
    """Model of a robot, as far as its protocol is concerned."""

    KHEPERA = "khepera"
    KHEPERA4 = "khepera4"
