"""Times of a stand-in's line: when bytes pass its relay and its adapter, and what a log tells of that.

`exact`: at once, by a relay that is never late. `busy`: the relay wakes up as late as a real one did on a
busy machine, and passes on together all that has come until then. `packets`: an adapter delivers the robot's
bytes each 16 ms. `stalls`: in each ten seconds, for 0.3 s, either host and relay stand still, or the adapter
keeps the bytes of one direction. `pyserial`: no relay; a busy host logs whole replies when it has read them.
"""

import numpy as np

from khep_twin.clock import NS_PER_S
from khep_twin.randomness import stream

TIMES = "exact", "busy", "packets", "stalls", "pyserial"
"""Kinds of times."""

PACKET_NS = 16_000_000
"""Interval of an adapter's packets, the default of FTDI's [ns]."""

STALL_NS, STALL_EVERY_NS = 300_000_000, 10 * NS_PER_S
"""Length of a stall, and of the time that has one [ns]."""

LATE = 0.0, 0.5, 0.75, 0.9, 0.99, 1.0
LATE_NS = 20_000, 150_000, 200_000, 4_000_000, 12_000_000, 25_000_000
"""Quantiles of a relay's delay, and the delays [ns], interpolated between them (`studies.relay_delays`).

Of 3000 chunks both ways, with four endless loops and a shadow beside the relay on two cores: median 0.15 ms,
90 % 4.0 ms, 99 % 12.1 ms, longest 24 ms. A host's and a robot's chunks differ little.
"""


class LineTimes:
    """Times of one line, whose calls come in order of time.

    Args:
        kind: One of TIMES.
        seed: Seed of all that is drawn.

    Attributes:
        whole: Whether only whole replies have a time.
    """

    def __init__(self, kind: str, seed: int) -> None:
        self.whole = kind == "pyserial"
        self._late = kind in ("busy", "pyserial")
        self._packets, self._stalls = kind == "packets", kind == "stalls"
        self._rng = stream(seed, "stand-in", "line times")
        self._phase_ns = int(self._rng.integers(PACKET_NS))
        self._wakes_ns = -1
        self._drawn: list[tuple[int, int]] = []

    def host(self, time_ns: int) -> int:
        """Return when a host does what it would do at a time [ns]."""
        return self._after_stall(time_ns, 0)

    def to_robot(self, time_ns: int) -> tuple[int, int]:
        """Return when a command is logged and when the robot's line has it [ns]."""
        logged_ns = time_ns if self.whole else self._relayed(time_ns)
        return logged_ns, self._after_stall(logged_ns, 1)

    def from_robot(self, time_ns: int) -> int:
        """Return when a byte of the robot is passed on to the host, which is when it is logged [ns]."""
        if self._packets:
            return time_ns + (self._phase_ns - time_ns) % PACKET_NS
        return self._relayed(self._after_stall(time_ns, 0, 2))

    def _relayed(self, time_ns: int) -> int:
        """Return when the relay wakes up for a byte; it takes all that has come until then."""
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
