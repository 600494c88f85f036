"""Timing of a stand-in's line: the times at which bytes pass its relay and its adapter, and are logged.

`exact`: immediately, by a relay that is never late. `busy`: the relay wakes up as late as a real one did on a
busy machine, and forwards all bytes received until then together. `packets`: an adapter delivers the robot's
bytes each 16 ms. `stalls`: once in ten seconds, for 0.3 s, either host and relay stop, or the adapter holds
back the bytes of one direction. `pyserial`: no relay; a busy host logs whole replies when it has read them.
"""

import numpy as np

from khep_twin.clock import NS_PER_S
from khep_twin.randomness import stream

TIMES = "exact", "busy", "packets", "stalls", "pyserial"
"""Kinds of times."""

PACKET_NS = 16_000_000
"""Interval of an adapter's packets, the default of FTDI's [ns]."""

STALL_NS, STALL_EVERY_NS = 300_000_000, 10 * NS_PER_S
"""Length of a stall, and interval in which there is one [ns]."""

LATE = 0.0, 0.5, 0.75, 0.9, 0.99, 1.0
LATE_NS = 20_000, 150_000, 200_000, 4_000_000, 12_000_000, 25_000_000
"""Quantiles of a relay's delay, and the delays [ns], interpolated between them (`studies.relay_delays`).

Of 3000 chunks both ways, with four endless loops and a shadow beside the relay on two cores: median 0.15 ms,
90 % 4.0 ms, 99 % 12.1 ms, longest 24 ms. A host's and a robot's chunks differ little.
"""


class LineTimes:
    """Timing of one line; calls must be in order of time.

    Args:
        kind: One of TIMES.
        seed: Seed of all that is drawn.

    Attributes:
        whole_replies: Whether only complete replies have a time.
    """

    def __init__(self, kind: str, seed: int) -> None:
        self.whole_replies = kind == "pyserial"
        self._late = kind in ("busy", "pyserial")
        self._packets, self._stalls = kind == "packets", kind == "stalls"
        self._rng = stream(seed, "stand-in", "line times")
        self._phase_ns = int(self._rng.integers(PACKET_NS))
        self._wakes_ns = -1
        self._drawn: list[tuple[int, int]] = []

    def host(self, time_ns: int) -> int:
        """Return the time of a host's action that is due at a time [ns]."""
        return self._after_stall(time_ns, 0)

    def to_robot(self, time_ns: int) -> tuple[int, int]:
        """Return the times at which a command is logged and is on the robot's line [ns]."""
        logged_ns = time_ns if self.whole_replies else self._relayed(time_ns)
        return logged_ns, self._after_stall(logged_ns, 1)

    def from_robot(self, time_ns: int) -> int:
        """Return the time at which a byte of the robot is forwarded to the host and logged [ns]."""
        if self._packets:
            return time_ns + (self._phase_ns - time_ns) % PACKET_NS
        return self._relayed(self._after_stall(time_ns, 0, 2))

    def _relayed(self, time_ns: int) -> int:
        """Return the time at which the relay forwards a byte, with all bytes received until then."""
        if not self._late:
            return time_ns
        if time_ns > self._wakes_ns:
            late = np.exp(np.interp(self._rng.random(), LATE, np.log(LATE_NS)))
            self._wakes_ns = time_ns + int(late)
        return self._wakes_ns

    def _after_stall(self, time_ns: int, *kinds: int) -> int:
        """Return a time, or the end of a stall then: of host and relay (0), to the robot (1), from it (2)."""
        if not self._stalls:
            return time_ns
        number = time_ns // STALL_EVERY_NS
        while len(self._drawn) <= number:
            begin_ns = len(self._drawn) * STALL_EVERY_NS + int(self._rng.integers(STALL_EVERY_NS - STALL_NS))
            self._drawn.append((begin_ns, (0, 0, 1, 2)[int(self._rng.integers(4))]))
        begin_ns, kind = self._drawn[number]
        inside = begin_ns <= time_ns < begin_ns + STALL_NS and kind in kinds
        return begin_ns + STALL_NS if inside else time_ns
