"""Host events of a log: the actions of hosts and users, which are the inputs for a repetition of the run.

    /khepera0/host_events   std_msgs/Int64MultiArray

A message contains all events since the last flush of the log. Each is a row of integers: time when the world
received it [ns], kind (0 send, 1 disconnect, 2 discard, 3 line settings, 4 move the robot, 5 switch a lamp,
6 convert all sensors, 7 change the lamps, 8 log an event), time at which it takes effect [ns], baud rate and
stop bits of the host (-1 for those of the robot), number of bytes, then each byte. The bytes are those that
left the host; the transcript contains those that reached the robot.
"""

from array import array
from collections.abc import Iterator, Sequence

import numpy as np

from khep_twin.board.uart import HostEvent, HostEventKind, LineSettings
from khep_twin.log.channels import array_message
from khep_twin.log.decoding import LATEST_NS, DecodeError, read_array

_FIELD_NAMES = "known at [ns], act, from [ns], baud, stop bits, size, bytes"

FLUSHING_KINDS = (
    HostEventKind.MOVE_ROBOT,
    HostEventKind.SWITCH_LAMP,
    HostEventKind.SCAN,
    HostEventKind.SET_LAMPS,
    HostEventKind.NOTE,
)
"""Kinds of events that the recorder flushes immediately: simultaneous events of other robots precede them."""

_N_FIELDS = 6
"""Numbers before the bytes of an event."""

_MAX_BAUD = 10**9

_SIZES = {
    HostEventKind.DISCONNECT: (0,),
    HostEventKind.FLUSH: (0,),
    HostEventKind.LINE_SETTINGS: (0,),
    HostEventKind.MOVE_ROBOT: (24, 25),
    HostEventKind.SWITCH_LAMP: (5,),
    HostEventKind.SCAN: (0,),
}
"""Numbers of bytes by kind, of `move_robot` and `switching` as these encode them; other kinds: any."""


def events_message(events: Sequence[tuple[int, HostEvent]]) -> bytes:
    """Return the message of host events with the times when the world received them [ns]."""
    numbers = array("q")
    for time_ns, (kind, effect_ns, host, data) in events:
        baud, stop_bits = (-1, -1) if host is None else (host.baud, host.stop_bits)
        numbers.extend((time_ns, kind, effect_ns, baud, stop_bits, len(data), *data))
    return array_message(np.frombuffer(numbers, np.int64), _FIELD_NAMES)


def read_events(message: bytes) -> Iterator[tuple[int, HostEvent]]:
    """Yield the host events of a message with their times [ns]."""
    numbers: tuple[int, ...] = read_array(message, "q")
    offset = 0
    while offset < len(numbers):
        fields = numbers[offset : offset + _N_FIELDS]
        if len(fields) < _N_FIELDS:
            raise DecodeError(f"{len(fields)} numbers at {offset}", f"{_N_FIELDS} that begin an event")
        time_ns, kind, effect_ns, baud, stop_bits, size = fields
        offset += _N_FIELDS
        for name, value, lowest, highest in (
            ("time", time_ns, 0, LATEST_NS),
            ("kind", kind, 0, len(HostEventKind) - 1),
            ("from", effect_ns, 0, LATEST_NS),
            ("baud", baud, -1, _MAX_BAUD),
            ("stop bits", stop_bits, -1, 2),
            ("size", size, 0, len(numbers) - offset),
        ):
            if not lowest <= value <= highest:
                actual = f"{name} = {value} at number {offset - _N_FIELDS}"
                raise DecodeError(actual, f"{lowest} to {highest}")
        values = numbers[offset : offset + size]
        if invalid := next((byte for byte in values if not 0 <= byte <= 255), None):
            raise DecodeError(f"byte = {invalid} after number {offset - 1}", "0 to 255")
        sizes = _SIZES.get(HostEventKind(kind))
        if sizes is not None and size not in sizes:
            expected = " or ".join(map(str, sizes))
            actual = f"size = {size} of kind {kind} at number {offset - _N_FIELDS}"
            raise DecodeError(actual, f"{expected} bytes")
        offset += size
        host = None if baud < 0 else LineSettings(baud, stop_bits)
        yield time_ns, HostEvent(HostEventKind(kind), effect_ns, host, bytes(values))
