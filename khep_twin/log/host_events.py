"""Host events of a log, from which a run is repeated.

    /khepera0/host_events   std_msgs/Int64MultiArray

A message has all events since the last flush of the log. Each is a row of integers: time when the world
learned of it [ns], kind (0 send, 1 disconnect, 2 discard, 3 set the line, 4 move the robot, 5 switch a lamp,
6 convert all sensors, 7 change the lamps, 8 log an event), time from which on it holds [ns], baud rate and
stop bits of the host's end (-1 for the robot's), number of bytes, then each byte. The bytes are those that
left the host; the transcript has those that reached the robot.
"""

from array import array
from collections.abc import Iterator, Sequence

import numpy as np

from khep_twin.board.uart import HostEvent, HostEventKind, LineSettings
from khep_twin.log.channels import array_message
from khep_twin.log.decoding import LATEST_NS, DecodeError, read_array

_LABEL = "known at [ns], act, from [ns], baud, stop bits, size, bytes"


def events_message(events: Sequence[tuple[int, HostEvent]]) -> bytes:
    """Return the message of host events with the times when the world learned of them [ns]."""
    numbers = array("q")
    for time_ns, (kind, at_ns, host, data) in events:
        baud, stop_bits = (-1, -1) if host is None else (host.baud, host.stop_bits)
        numbers.extend((time_ns, kind, at_ns, baud, stop_bits, len(data), *data))
    return array_message(np.frombuffer(numbers, np.int64), _LABEL)


def read_events(message: bytes) -> Iterator[tuple[int, HostEvent]]:
    """Yield the host events of a message with their times [ns]."""
    numbers: tuple[int, ...] = read_array(message, "q")
    place = 0
    while place < len(numbers):
        head = numbers[place : place + _HEAD]
        if len(head) < _HEAD:
            raise DecodeError(f"{len(head)} numbers at {place}", f"{_HEAD} that begin an event")
        time_ns, kind, at_ns, baud, stop_bits, size = head
        place += _HEAD
        for name, value, lowest, highest in (
            ("time", time_ns, 0, LATEST_NS),
            ("kind", kind, 0, len(HostEventKind) - 1),
            ("from", at_ns, 0, LATEST_NS),
            ("baud", baud, -1, _FASTEST),
            ("stop bits", stop_bits, -1, 2),
            ("size", size, 0, len(numbers) - place),
        ):
            if not lowest <= value <= highest:
                found = f"{name} = {value} at number {place - _HEAD}"
                raise DecodeError(found, f"{lowest} to {highest}")
        values = numbers[place : place + size]
        if wrong := next((each for each in values if not 0 <= each <= 255), None):
            raise DecodeError(f"byte = {wrong} after number {place - 1}", "0 to 255")
        sizes = _SIZES.get(HostEventKind(kind))
        if sizes is not None and size not in sizes:
            wanted = " or ".join(map(str, sizes))
            raise DecodeError(f"size = {size} of kind {kind} at number {place - _HEAD}", f"{wanted} bytes")
        place += size
        host = None if baud < 0 else LineSettings(baud, stop_bits)
        yield time_ns, HostEvent(HostEventKind(kind), at_ns, host, bytes(values))


PIECE_ENDS = (
    HostEventKind.PUT,
    HostEventKind.SWITCH,
    HostEventKind.SCAN,
    HostEventKind.SET_LAMPS,
    HostEventKind.NOTE,
)
"""Kinds of events that end their piece of the log: what other robots did at the same time was before."""

_HEAD = 6
"""Numbers before the bytes of an event."""

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
"""Sizes of events, as `move_robot` and `switching` make them; others have any number of bytes."""
