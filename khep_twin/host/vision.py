"""`Vision`: the vision turret K213 of a robot at the other end of a serial port, real or simulated.

from khep_twin.host import Khepera, Vision

with Khepera("khep://stripes") as robot:
    vision = Vision(robot)
    print(vision.image())                  # 64 greys, 0 to 255, from the left to the right
    print(vision.region(24, 16))           # 16 of them, in a quarter of the time

Reads are repeatable, so a lost reply is harmless. The commands of this module can join a burst:

    greys, proximity = robot.burst(read_image(), commands.proximity())
"""

from functools import cache

from khep_twin.host.commands import HostCommand, turret
from khep_twin.host.turret import HostTurret
from khep_twin.units import K213_NUMBER, K213_PERIODS_MS, K213_PIXELS

Greys = tuple[int, ...]
"""Greys of pixels, 0 (dark) to 255, from the left to the right."""

_REGIONS = {8: "Q", 16: "R"}
"""Letters of the commands for a part of the image, by its number of pixels."""


@cache
def read_image() -> HostCommand[Greys]:
    """Return the command for the complete image (64 greys)."""
    return _greys("N", K213_PIXELS)


@cache
def read_light() -> HostCommand[int]:
    """Return the command for the reading of the light sensor."""
    command = _values("L", 2, 255)
    return HostCommand(command.request, lambda reply: int.from_bytes(command.read(reply)), repeatable=True)


def read_region(start: int, count: int) -> HostCommand[Greys]:
    """Return the command for 8 or 16 pixels from `start` on.

    Raises:
        ValueError: The pixels are out of range.
    """
    if count not in _REGIONS or not 0 <= start <= K213_PIXELS - count:
        raise ValueError(
            f"{count} pixels from {start} on; expected 8 from 0 to {K213_PIXELS - 8}, "
            f"or 16 from 0 to {K213_PIXELS - 16}"
        )
    return _greys(_REGIONS[count], count, f",{start}")


class Vision(HostTurret):
    """K213 on a robot.

    Raises:
        ProtocolError: The robot has no K213.
    """

    number, name = K213_NUMBER, "K213"

    def image(self) -> Greys:
        """Return the greys of the last complete scan (64,) (message N)."""
        return self._robot.burst(read_image())[0]

    def region(self, start: int, count: int) -> Greys:
        """Return 8 or 16 greys from a pixel on (messages Q and R).

        Raises:
            ValueError: The pixels are out of range.
        """
        return self._robot.burst(read_region(start, count))[0]

    def coarse(self) -> Greys:
        """Return all pixels in 16 greys, multiples of 16 (64,), in half the values (message M)."""
        pairs = self._robot.burst(_greys("M", K213_PIXELS // 2))[0]
        return tuple(grey for pair in pairs for grey in (pair // 16 * 16, pair % 16 * 16))

    def every_second(self) -> Greys:
        """Return every second pixel, from pixel 0 on (32,) (message S)."""
        return self._robot.burst(_greys("S", K213_PIXELS // 2))[0]

    def every_fourth(self) -> Greys:
        """Return every fourth pixel, from pixel 0 on (16,) (message T)."""
        return self._robot.burst(_greys("T", K213_PIXELS // 4))[0]

    def brightest(self) -> int:
        """Return the index of the brightest pixel, 0 at the left (message O)."""
        return self._robot.burst(_values("O", 1, K213_PIXELS - 1))[0][0]

    def darkest(self) -> int:
        """Return the index of the darkest pixel, 0 at the left (message P)."""
        return self._robot.burst(_values("P", 1, K213_PIXELS - 1))[0][0]

    def light(self) -> int:
        """Return the reading of the light sensor, the lower the brighter (message L)."""
        return self._robot.burst(read_light())[0]

    def set_period(self, period: int) -> None:
        """Set the scan period: 0 by the light, 1 to 7 for 50, 100, 150, 250, 500, 1000, 5000 ms (message U).

        Raises:
            ValueError: The period is out of range.
        """
        if not 0 <= period < len(K213_PERIODS_MS):
            raise ValueError(f"period {period}; expected 0 to {len(K213_PERIODS_MS) - 1}")
        self.ask(f"U,{period}", 0)


def _greys(letter: str, count: int, arguments: str = "") -> HostCommand[Greys]:
    return _values(letter, count, 255, arguments)


def _values(letter: str, count: int, limit: int, arguments: str = "") -> HostCommand[Greys]:
    """Return a command whose answer is its letter and `count` numbers from 0 to a limit."""
    turret_command = turret(K213_NUMBER, letter + arguments)

    def read(reply: str) -> Greys:
        head, *fields = turret_command.read(reply).split(",")
        values = tuple(int(field) for field in fields if field.isdecimal())
        if head != letter.lower() or len(values) != count or len(fields) != count or max(values) > limit:
            raise ValueError(f"expected {letter.lower()!r} and {count} numbers from 0 to {limit}")
        return values

    return HostCommand(turret_command.request, read, repeatable=True)
