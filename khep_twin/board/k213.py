"""Electronics of the K213, a linear vision turret with a line of 64 pixels and a light sensor.

    B        versions                                        b,1,0
    N        all pixels, 0 (dark) to 255, from the left      n, and 64 values
    M        all pixels in 16 greys, two in each value       m, and 32 values
    S        every second pixel, from pixel 0                s, and 32 values
    T        every fourth pixel, from pixel 0                t, and 16 values
    Q,start  8 pixels from this one, 0 to 56                 q, and 8 values
    R,start  16 pixels from this one, 0 to 48                r, and 16 values
    O, P     index of the brightest, of the darkest pixel    o,…
    L        light sensor, high and low byte                 l,high,low
    U,period scan period: 0 automatic, 1 to 7 fixed            u

Orders and numbers of values are from public host programs and simulators; the turret's manual is not
available. The sources give M 32 values of a lower grey resolution; two pixels of 4 bits in each value, the
left one in the higher bits, are assumed. The limits of Q and R are assumed, and that O and P return the
leftmost of equal pixels.

The turret scans continuously. `K213Body` writes the pixels and the light into the registers at the end of a
scan, in the control period in which the register LEFT is 1; replies report the last complete scan. The light
sensor reads its period: 200 in the light of a room, more in the dark. In automatic mode (U,0) a scan takes
as many milliseconds, so that a white wall has the same grey in any light.
"""

from enum import IntEnum

import numpy as np

from khep_twin.board.protocol import PROTOCOL_ERROR, Malformed, parse_turret_order, turret_reply
from khep_twin.units import K213_NUMBER, K213_PERIODS_MS, K213_PIXELS, TICK_NS

VERSION, REVISION = 1, 0
"""Version and revision in the reply to B (simulators)."""

SHORTEST_MS, LONGEST_MS = 50, 1000
"""Shortest and longest scan in automatic mode [ms] (assumed: the fixed periods except the longest)."""

LIGHT_LIMIT = 65535
"""Largest reading of the light sensor."""

TICK_MS = TICK_NS // 1_000_000
"""Control period, in which scans are counted [ms]."""

_REPLY_PIXELS = {"Q": 8, "R": 16}
"""Numbers of pixels in the replies to these orders."""

_ARGUMENT_COUNTS = {"B": 0, "L": 0, "M": 0, "N": 0, "O": 0, "P": 0, "Q": 1, "R": 1, "S": 0, "T": 0, "U": 1}


class K213Register(IntEnum):
    """Registers of the K213, before its pixels."""

    LIGHT = 0  # reading of the light sensor, the lower the brighter
    PERIOD = 1  # parameter of U
    SCAN = 2  # duration of the present scan [10 ms]; 0 for the first one, which ends in the first tick
    LEFT = 3  # remaining time of the present scan [10 ms]
    SCANS = 4  # complete scans so far


PIXELS = slice(len(K213Register), len(K213Register) + K213_PIXELS)
"""Registers of the pixels, 0 to 255, from left to right."""

RANGES = {
    K213Register.LIGHT: (0, LIGHT_LIMIT),
    K213Register.PERIOD: (0, len(K213_PERIODS_MS) - 1),
    K213Register.SCAN: (0, max(K213_PERIODS_MS) // TICK_MS),
    K213Register.LEFT: (1, max(K213_PERIODS_MS) // TICK_MS),
    K213Register.SCANS: (0, 2**62),
    **dict.fromkeys(range(PIXELS.start, PIXELS.stop), (0, 255)),
}
"""Range of each register."""


class K213Electronics:
    """Electronics of the K213, a `Turret`.

    Attributes:
        registers: State of the electronics (69,).
    """

    def __init__(self) -> None:
        self.registers = np.zeros(PIXELS.stop, np.int64)
        self._register_view = self.registers.data
        self.reset()

    def receive(self, message: bytes) -> bytes:
        """Execute an order; return its reply."""
        order = parse_turret_order(message, _ARGUMENT_COUNTS)
        if isinstance(order, Malformed):
            return order.reply
        pixels: list[int] = self.registers[PIXELS].tolist()
        match order.letter, order.arguments:
            case "B", ():
                values = [VERSION, REVISION]
            case "L", ():
                values = divmod(self._register_view[K213Register.LIGHT], 256)
            case "M", ():
                pairs = zip(pixels[::2], pixels[1::2], strict=True)
                values = [left // 16 * 16 + right // 16 for left, right in pairs]
            case "N", ():
                values = pixels
            case "O", ():
                values = [pixels.index(max(pixels))]
            case "P", ():
                values = [pixels.index(min(pixels))]
            case ("Q" | "R") as letter, (start,) if 0 <= start <= K213_PIXELS - _REPLY_PIXELS[letter]:
                values = pixels[start : start + _REPLY_PIXELS[letter]]
            case "S", ():
                values = pixels[::2]
            case "T", ():
                values = pixels[::4]
            case "U", (period,) if 0 <= period < len(K213_PERIODS_MS):
                self._register_view[K213Register.PERIOD] = period
                self._start_scan()
                values = []
            case _:
                return PROTOCOL_ERROR
        return turret_reply(K213_NUMBER, order.letter, *values)

    def tick(self) -> None:
        """Continue the scan; start the next one at its end."""
        view = self._register_view
        view[K213Register.LEFT] -= 1
        if view[K213Register.LEFT] <= 0:
            view[K213Register.SCANS] += 1
            self._start_scan()

    def reset(self) -> None:
        """Scan in automatic mode, first in the next control period."""
        self._register_view[K213Register.PERIOD] = self._register_view[K213Register.SCAN] = 0
        self._register_view[K213Register.LEFT] = 1

    def _start_scan(self) -> None:
        """Start a scan."""
        view = self._register_view
        fixed_ms = K213_PERIODS_MS[view[K213Register.PERIOD]]
        period_ms = fixed_ms or min(max(view[K213Register.LIGHT], SHORTEST_MS), LONGEST_MS)
        view[K213Register.SCAN] = view[K213Register.LEFT] = (period_ms + TICK_MS // 2) // TICK_MS
