"""Hashes of the whole world's state in a log, to compare runs.

/state   std_msgs/Int64MultiArray   a hash of eight bytes every 20 ms from the message's time on
"""

import zlib
from functools import cache

import numpy as np
from numpy.typing import NDArray

from khep_twin.log.channels import array_message
from khep_twin.log.decoding import read_array
from khep_twin.robot import Robot


def states_message(states: NDArray[np.int64]) -> bytes:
    """Return hashes of consecutive samples as a message of /state."""
    return array_message(states, "hash of the state every 20 ms")


def read_states(message: bytes) -> list[int]:
    """Return hashes of consecutive samples from their message.

    Raises:
        DecodeError: It is no such message.
    """
    return list(read_array(message, "q"))


def boards(robot: Robot) -> list[NDArray[np.int64]]:
    """Return the registers of a robot's board and its turrets."""
    return [robot.registers, *(turret.registers for turret in robot.firmware.turrets.values())]


class Answered:
    """Running hash of all answers of each robot.

    Args:
        robots: Number of robots.

    Attributes:
        numbers: Hash of each robot.
    """

    def __init__(self, robots: int) -> None:
        # One per robot: the order of two robots within a step depends on which is read first.
        self.numbers = [0] * robots

    def on_bytes(self, time_ns: int, robot: int, data: bytes) -> None:
        """Add bytes that a robot has answered."""
        self.numbers[robot] = zlib.crc32(b"%d " % time_ns + data, self.numbers[robot])


def hashes(*parts: NDArray[np.int64] | NDArray[np.float64]) -> NDArray[np.int64]:
    """Return samples of a state in eight bytes each (n,).

    A sum of the parts' words, each times its own odd number, modulo 2^64: any change of one word is
    detected, and of several all but one in 2^64.

    Args:
        parts: Parts of the state, a row for each sample (n, length): answers, positions and speeds, and the
            registers of every robot's boards.
    """
    words = np.hstack([np.ascontiguousarray(part).view(np.uint64) for part in parts])
    # The highest bit of a word, the sign of a float, would only ever change the sum's highest.
    words ^= words >> np.uint64(32)
    return (words @ _odd_numbers(words.shape[1])).view(np.int64)


@cache
def _odd_numbers(count: int) -> NDArray[np.uint64]:
    """Return odd pseudorandom numbers (count,): the finalizer of splitmix64 over 1, 2, 3, ..."""
    numbers = np.arange(1, count + 1, dtype=np.uint64) * np.uint64(0x9E3779B97F4A7C15)
    for shift, factor in ((30, 0xBF58476D1CE4E5B9), (27, 0x94D049BB133111EB), (31, 1)):
        numbers = (numbers ^ (numbers >> np.uint64(shift))) * np.uint64(factor)
    return numbers | np.uint64(1)
