"""Questions that a relay asks the robot by itself, while no host does.

They are asked only where nothing has crossed the line for `IDLE_S` and every command is answered, so never
between a command and its reply. A host's bytes that come before the reply wait for it, for at most `HOLD_S`.
The replies are kept from the host.
"""

import time
from itertools import cycle

from khep_twin.units import BITS_PER_BYTE

IDLE_S = 0.25
"""Silence of the line from which on the relay may ask [s] (assumed; hosts that wait ask again sooner)."""

HOLD_S = 0.05
"""Longest time for which a host's bytes wait for the reply to a poll [s]."""

_PERIOD_S = 0.1
"""Time from one poll to the next [s]."""

_LOST_S = 0.5
"""Time after which no reply to a poll is expected any more [s] (assumed)."""

_POLLS = b"N\n", b"H\n"

_ERROR = b"z"
"""First byte of an error."""

_LONGEST = 40
"""Bytes of a poll and its longest usual reply, N with seven readings of three digits [bytes]."""


class IdlePolls:
    """Polls of one robot's line."""

    def __init__(self) -> None:
        self._polls = cycle(_POLLS)
        self._quiet_since = self._sent_s = time.monotonic()
        self._held_since: float | None = None
        self._letter = b""  # first byte of the reply that is awaited
        self._at_start = True  # of a line of the robot's
        self._dropping = b""  # last byte of a reply that is kept from the host

    def due(self, baud: int) -> bytes:
        """Return the command to send now, empty if none is due; the line is free of commands."""
        now = time.monotonic()
        if self._letter and now - self._sent_s > _LOST_S:
            self._letter = self._dropping = b""
        slow = _LONGEST * BITS_PER_BYTE > HOLD_S * baud
        if self._letter or slow or now - self._quiet_since < IDLE_S or now - self._sent_s < _PERIOD_S:
            return b""
        self._sent_s = now
        command = next(self._polls)
        self._letter = command[:1].lower()
        return command

    def hold_s(self, waiting: bytes) -> float:
        """Return how long a host's bytes wait for a reply to a poll [s]."""
        if not waiting:
            return 0.0
        now = self._quiet_since = time.monotonic()
        if not self._letter:
            self._held_since = None
            return 0.0
        if self._held_since is None:
            self._held_since = now
        left = self._held_since + HOLD_S - now
        if left <= 0:
            self._held_since = None
            if not self._dropping and self._letter.upper() in waiting:
                # No reply has begun: the next one is to the host's own question.
                self._letter = b""
            return 0.0
        return left

    def passed(self, reply: bytes) -> bytes:
        """Return the robot's bytes without those of replies to polls."""
        if not self._letter and not self._dropping:
            self._at_start = reply.endswith(b"\n")
            self._quiet_since = time.monotonic()
            return reply
        kept = bytearray()
        for place in range(len(reply)):
            byte = reply[place : place + 1]
            if self._dropping == b"\r":
                # The reply has ended, and the next poll may be out before the rest of its end has come.
                self._dropping = b""
                if byte == b"\n":
                    continue
            if self._dropping or (self._at_start and self._letter and byte in (self._letter, _ERROR)):
                self._at_start, self._dropping = byte in b"\r\n", b"" if byte == b"\n" else byte
                if self._at_start:
                    self._letter = b""
            else:
                kept += byte
                self._at_start = byte == b"\n"
                self._quiet_since = time.monotonic()
        return bytes(kept)
