"""Data to repeat and compare a log: acts of the hosts, and hashes of the state in eight bytes.

    /khepera0/wire   std_msgs/Int64MultiArray   acts of the host, one after the other: time when the world
                                                learned of it [ns], kind (0 sends, 1 disconnects, 2 discards,
                                                3 sets its line, 4 moves the robot, 5 switches a lamp,
                                                6 converts all sensors, 7 changes the lamps), time from
                                                when on it holds [ns], baud and stop bits of the host's end
                                                (-1 for as the robot has it), number of bytes, then each byte
    /state           std_msgs/Int64MultiArray   hashes of the whole world's state, every 20 ms from the
                                                message's own time on

The bytes are those that left the host; the transcript has those that reached the robot. A message has all
acts since the last one: they are written when a log is flushed to the file system.
"""

import zlib
from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from khep_twin.board.uart import HostEvent, HostEventKind, LineSettings
from khep_twin.log.channels import ArrayFrame
from khep_twin.log.decoding import LATEST_NS, Misfit, read_array
from khep_twin.robot import Robot

_LABEL = "known at [ns], act, from [ns], baud, stop bits, size, bytes"


def events_message(events: Sequence[tuple[int, HostEvent]]) -> bytes:
    """Return acts, with the times when the world learned of them [ns], as a message of /khepera0/wire."""
    numbers: list[int] = []
    for time_ns, event in events:
        baud, stop_bits = (event.host.baud, event.host.stop_bits) if event.host is not None else (-1, -1)
        numbers += time_ns, event.kind, event.at_ns, baud, stop_bits, len(event.data)
        numbers += event.data
    return _message(np.array(numbers, np.int64), _LABEL)


def read_events(message: bytes) -> Iterator[tuple[int, HostEvent]]:
    """Yield acts and their times [ns] from their message.

    Raises:
        Misfit: It is none.
    """
    numbers: tuple[int, ...] = read_array(message, "q")
    place = 0
    while place < len(numbers):
        head = numbers[place : place + _HEAD]
        if len(head) < _HEAD:
            raise Misfit(f"{len(head)} numbers at {place}", f"{_HEAD} that begin an act")
        time_ns, kind, at_ns, baud, stop_bits, size = head
        place += _HEAD
        for name, value, lowest, highest in (
            ("time", time_ns, 0, LATEST_NS),
            ("act", kind, 0, len(HostEventKind) - 1),
            ("from", at_ns, 0, LATEST_NS),
            ("baud", baud, -1, _FASTEST),
            ("stop bits", stop_bits, -1, 2),
            ("size", size, 0, len(numbers) - place),
        ):
            if not lowest <= value <= highest:
                found = f"{name} = {value} at number {place - _HEAD}"
                raise Misfit(found, f"{lowest} to {highest}")
        values = numbers[place : place + size]
        if wrong := next((each for each in values if not 0 <= each <= 255), None):
            raise Misfit(f"byte = {wrong} after number {place - 1}", "0 to 255")
        sizes = _SIZES.get(HostEventKind(kind))
        if sizes is not None and size not in sizes:
            wish = " or ".join(map(str, sizes))
            raise Misfit(f"size = {size} of act {kind} at number {place - _HEAD}", f"{wish} bytes")
        place += size
        host = None if baud < 0 else LineSettings(baud, stop_bits)
        yield time_ns, HostEvent(HostEventKind(kind), at_ns, host, bytes(values))


_HEAD = 6
"""Numbers before the bytes of an act."""

_FASTEST = 10**9
"""Highest speed of a line that is accepted [baud]."""

_SIZES = {
    HostEventKind.DISCONNECT: (0,),
    HostEventKind.FLUSH: (0,),
    HostEventKind.SET: (0,),
    HostEventKind.PUT: (24, 25),
    HostEventKind.SWITCH: (5,),
    HostEventKind.SCAN: (0,),
}
"""Sizes of acts, as `move_robot` and `switching` make them; others have any number of bytes."""


def states_message(states: NDArray[np.int64]) -> bytes:
    """Return hashes of consecutive samples as a message of /state."""
    return _message(states, "hash of the state every 20 ms")


def read_states(message: bytes) -> list[int]:
    """Return hashes of consecutive samples from their message.

    Raises:
        Misfit: It is none.
    """
    return list(read_array(message, "q"))


def _message(numbers: NDArray[np.int64], label: str) -> bytes:
    return ArrayFrame(len(numbers), "i8", label).messages(numbers.reshape(1, -1))[0].tobytes()


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
    return (words * _odd_numbers(words.shape[1])).sum(axis=1).view(np.int64)


def _odd_numbers(count: int) -> NDArray[np.uint64]:
    """Return odd pseudorandom numbers (count,): the finalizer of splitmix64 over 1, 2, 3, ..."""
    numbers = np.arange(1, count + 1, dtype=np.uint64) * np.uint64(0x9E3779B97F4A7C15)
    for shift, factor in ((30, 0xBF58476D1CE4E5B9), (27, 0x94D049BB133111EB), (31, 1)):
        numbers = (numbers ^ (numbers >> np.uint64(shift))) * np.uint64(factor)
    return numbers | np.uint64(1)
