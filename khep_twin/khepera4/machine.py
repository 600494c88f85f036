"""A Khepera IV as its programs see it: the bus of its dsPIC, its pins, and its time."""

import errno
from collections.abc import Sequence
from typing import Protocol

from khep_twin.khepera4.dspic import Dspic
from khep_twin.khepera4.registers import ADDRESS

BYTE_NS = 25_000
"""Simulated time of a byte on the bus [ns], 9 bits at 400 kHz and what is between (assumed)."""

RESET_PIN, CHARGER_PIN = 90, 65
"""Pins: the dsPIC is held in reset while it is 0; 0 while the charger is plugged in (library)."""

READS = 1
"""Flag of a message that reads."""


class MachineTime(Protocol):
    """Time of a machine, such as a `World`."""

    time_ns: int

    def advance_to(self, time_ns: int) -> None:
        """Advance to a time [ns], not before the present."""
        ...


class Machine:
    """A Khepera IV as its programs see it.

    Args:
        dspic: Its microcontroller.
        clock: Its time.
    """

    def __init__(self, dspic: Dspic, clock: MachineTime) -> None:
        self._dspic, self._clock = dspic, clock
        self._pins, self._register = {CHARGER_PIN: 1, RESET_PIN: 1}, 0

    @property
    def time_ns(self) -> int:
        """Simulated time [ns]."""
        return self._clock.time_ns

    def advance_to(self, time_ns: int) -> None:
        """Advance to a time [ns], unless it has passed."""
        if time_ns > self._clock.time_ns:
            self._clock.advance_to(time_ns)

    def transfer(self, messages: Sequence[tuple[int, int, bytes]], byte_ns: int = BYTE_NS) -> bytes:
        """Run messages on the bus; return the content of those that read.

        Args:
            messages: Address, flags, and content of each, of which a reading message has only the length.
            byte_ns: Time that passes for a byte [ns].

        Raises:
            OSError: No device has the address.
        """
        found = b""
        for address, flags, content in messages:
            if address != ADDRESS or not (self._pins[RESET_PIN] and self._dspic.is_powered):
                raise OSError(errno.ENXIO, "no device has answered")
            self.advance_to(self.time_ns + (len(content) + 1) * byte_ns)
            if flags & READS:
                found += self._dspic.read(self._register, len(content))
            elif content:
                self._register = content[0]
                self._dspic.write(content)
        return found

    def set_pin(self, pin: int, level: int) -> None:
        """Set an output; the dsPIC is reset, and stands still, as long as its pin is 0."""
        if pin == RESET_PIN and not level:
            self._dspic.reset()
        self._pins[pin] = int(bool(level))

    def pin(self, pin: int) -> int:
        """Return the level of a pin; that of one without a connection is 0 (assumed)."""
        return self._pins.get(pin, 0)
