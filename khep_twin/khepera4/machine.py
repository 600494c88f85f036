"""A Khepera IV as its programs see it: the bus of its dsPIC, its pins, and its time."""

import errno
from collections.abc import Callable, Sequence

from khep_twin.khepera4.dspic import Dspic
from khep_twin.khepera4.registers import ADDRESS
from khep_twin.units import TICK_NS

BYTE_NS = 25_000
"""Simulated time of a byte on the bus [ns], 9 bits at 400 kHz and what is between (assumed)."""

RESET_PIN, CHARGER_PIN = 90, 65
"""Pins: the dsPIC is held in reset while it is 0; 0 while the charger is plugged in (library)."""

READS = 1
"""Flag of a message that reads."""


class Machine:
    """A Khepera IV as its programs see it, with its motors.

    Args:
        dspic: Its microcontroller.
        drive: Function that turns the wheels for a control period at a PWM of each, and returns their pulses.

    Attributes:
        time_ns: Simulated time [ns].
    """

    def __init__(self, dspic: Dspic, drive: Callable[[tuple[int, int]], tuple[int, int]]) -> None:
        self.time_ns = 0
        self._dspic, self._drive = dspic, drive
        self._pulses, self._pins, self._register = (0, 0), {CHARGER_PIN: 1, RESET_PIN: 1}, 0

    def advance_to(self, time_ns: int) -> None:
        """Advance to a time [ns], one control period of 10 ms after another."""
        for _ in range(time_ns // TICK_NS - self.time_ns // TICK_NS):
            self._pulses = self._drive(self._dspic.tick(*self._pulses))
        self.time_ns = max(time_ns, self.time_ns)

    def transfer(self, messages: Sequence[tuple[int, int, bytes]]) -> bytes:
        """Run messages on the bus; return the content of those that read.

        Args:
            messages: Address, flags, and content of each, of which a reading message has only the length.

        Raises:
            OSError: No device has the address.
        """
        found = b""
        for address, flags, content in messages:
            if address != ADDRESS or not self._pins[RESET_PIN]:
                raise OSError(errno.ENXIO, "no device has answered")
            self.advance_to(self.time_ns + (len(content) + 1) * BYTE_NS)
            if flags & READS:
                found += self._dspic.read(self._register, len(content))
            elif content:
                self._register = content[0]
                self._dspic.write(content)
        return found

    def set_pin(self, pin: int, level: int) -> None:
        """Set an output; the dsPIC begins anew where its reset ends."""
        if pin == RESET_PIN and level and not self._pins[RESET_PIN]:
            self._dspic.reset()
        self._pins[pin] = int(bool(level))

    def pin(self, pin: int) -> int:
        """Return the level of a pin; that of one without a connection is 0 (assumed)."""
        return self._pins.get(pin, 0)
