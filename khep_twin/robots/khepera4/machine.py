"""Interface of a Khepera IV to its programs: the I2C bus of its dsPIC, its pins, and its time."""

import errno
from collections.abc import Sequence
from typing import Protocol

from khep_twin.robots.khepera4.dspic import Dspic
from khep_twin.robots.khepera4.registers import ADDRESS

BYTE_NS = 25_000
"""Simulated time of a byte on the bus [ns], 9 bits at 400 kHz and a pause (assumed)."""

RESET_PIN, CHARGER_PIN = 90, 65
"""Pins: 0 holds the dsPIC in reset; 0 while the charger is plugged in (library)."""

READ_FLAG = 1
"""Flag of a read message."""


class MachineTime(Protocol):
    """Time of a machine, for example a `World`."""

    @property
    def time_ns(self) -> int:
        """Current time [ns]."""
        ...

    def advance_to(self, time_ns: int) -> None:
        """Advance to a time [ns], not before the present."""


class Machine:
    """A Khepera IV, as its programs see it.

    Args:
        dspic: Its microcontroller.
        clock: Its time.
    """

    def __init__(self, dspic: Dspic, clock: MachineTime) -> None:
        self._dspic = dspic
        self._clock = clock
        self._pins = {CHARGER_PIN: 1, RESET_PIN: 1}
        self._next_register = 0

    @property
    def time_ns(self) -> int:
        """Simulated time [ns]."""
        return self._clock.time_ns

    def advance_to(self, time_ns: int) -> None:
        """Advance to a time [ns]; do nothing if it has passed."""
        if time_ns > self._clock.time_ns:
            self._clock.advance_to(time_ns)

    def transfer(self, messages: Sequence[tuple[int, int, bytes]], byte_ns: int = BYTE_NS) -> bytes:
        """Run messages on the bus; return the content of the read messages.

        Args:
            messages: Address, flags and content of each; of a read message only the length counts.
            byte_ns: Simulated time of a byte [ns].

        Raises:
            OSError: No device has the address.
        """
        reply = b""
        for address, flags, content in messages:
            if address != ADDRESS or not (self._pins[RESET_PIN] and self._dspic.is_powered):
                raise OSError(errno.ENXIO, "no device has answered")
            self.advance_to(self.time_ns + (len(content) + 1) * byte_ns)
            if flags & READ_FLAG:
                reply += self._dspic.read(self._next_register, len(content))
            elif content:
                self._next_register = content[0]
                self._dspic.write(content)
        return reply

    def set_pin(self, pin: int, level: int) -> None:
        """Set an output; 0 at `RESET_PIN` resets the dsPIC and holds it."""
        if pin == RESET_PIN and not level:
            self._dspic.reset()
        self._pins[pin] = int(bool(level))

    def pin(self, pin: int) -> int:
        """Return the level of a pin, 0 for an unconnected pin (assumed)."""
        return self._pins.get(pin, 0)
