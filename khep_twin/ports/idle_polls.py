"""Polls that a relay sends to the robot while no host sends commands.

A poll is sent only if no byte has crossed the line for `IDLE_S` and every command is answered, so never
between a command and its reply. A host's bytes that arrive before the reply to a poll wait for it, for at
most `HOLD_S`. The replies to polls are removed from the bytes for the host.

    idle --IDLE_S without traffic--> awaiting --first byte of the reply--> dropping --end of line--> idle
"""

import time
from collections.abc import Sequence
from itertools import cycle

from khep_twin.units import BITS_PER_BYTE

IDLE_S = 0.25
"""Silence of the line before a poll [s] (assumed; hosts that wait for a reply send again sooner)."""

HOLD_S = 0.05
"""Longest time for which a host's bytes wait for the reply to a poll [s]."""

_PERIOD_S = 0.1
"""Time from one poll to the next [s]."""

_REPLY_TIMEOUT_S = 0.5
"""Time after which a poll without reply counts as lost [s] (assumed)."""

_ERROR_BYTE = b"z"
"""First byte of an error reply."""

_MAX_POLL_BYTES = 40
"""Bytes of a poll and its longest usual reply, N with seven readings of three digits [bytes]."""


class IdlePolls:
    """Polls of one robot's line, whose replies start with the request's letter in lower case.

    Args:
        requests: Requests, which are sent in turn.
    """

    def __init__(self, requests: Sequence[bytes]) -> None:
        self._polls = cycle(requests)
        self._last_traffic_s = self._sent_s = time.monotonic()
        self._hold_start_s: float | None = None
        self._awaited = b""  # first byte of the awaited reply
        self._is_start = True  # in the robot's output
        self._dropped = b""  # last byte of a reply that is being dropped

    def next_command(self, baud: int) -> bytes:
        """Return the poll to send now, empty if none is due; the line must be free of commands."""
        now = time.monotonic()
        if self._awaited and now - self._sent_s > _REPLY_TIMEOUT_S:
            self._awaited = self._dropped = b""
        is_slow = _MAX_POLL_BYTES * BITS_PER_BYTE > HOLD_S * baud
        if self._awaited or is_slow or now - self._last_traffic_s < IDLE_S or now - self._sent_s < _PERIOD_S:
            return b""
        self._sent_s = now
        command = next(self._polls)
        self._awaited = command[:1].lower()
        return command

    def remaining_hold_s(self, host_data: bytes) -> float:
        """Return how long a host's bytes still wait for the reply to a poll [s]."""
        if not host_data:
            return 0.0
        now = self._last_traffic_s = time.monotonic()
        if not self._awaited:
            self._hold_start_s = None
            return 0.0
        if self._hold_start_s is None:
            self._hold_start_s = now
        remaining_s = self._hold_start_s + HOLD_S - now
        if remaining_s <= 0:
            self._hold_start_s = None
            if not self._dropped and self._awaited.upper() in host_data:
                # No reply has started: the next one answers the host's command.
                self._awaited = b""
            return 0.0
        return remaining_s

    def filter_replies(self, reply: bytes) -> bytes:
        """Return the robot's bytes without those of replies to polls."""
        if not self._awaited and not self._dropped:
            self._is_start = reply.endswith(b"\n")
            self._last_traffic_s = time.monotonic()
            return reply
        output = bytearray()
        for index in range(len(reply)):
            byte = reply[index : index + 1]
            if self._dropped == b"\r":
                # The reply has ended; the next poll may be sent before the line feed arrives.
                self._dropped = b""
                if byte == b"\n":
                    continue
            if self._dropped or (self._is_start and self._awaited and byte in (self._awaited, _ERROR_BYTE)):
                self._is_start, self._dropped = byte in b"\r\n", b"" if byte == b"\n" else byte
                if self._is_start:
                    self._awaited = b""
            else:
                output += byte
                self._is_start = byte == b"\n"
                self._last_traffic_s = time.monotonic()
        return bytes(output)
