"""Dead reckoning: a twin that drives by commands alone; its board shows the effect of each command."""

import math
import re
from collections.abc import Iterator

from khep_twin.log.exchanges import Exchange
from khep_twin.robots.core import Core
from khep_twin.shadow.actions import Action, CounterReset, StateWrite, WheelCommand
from khep_twin.shadow.planes import Twins

Pose = tuple[float, float, float]

_WHEEL_COMMAND = re.compile(rb"([A-Z]),[a-z]?(-?\d{1,10}),[a-z]?(-?\d{1,10})")
"""Request with a number for each wheel, each with the prefix of its size or without."""


class Reckoning:
    """Twin that drives by commands alone, as the calibration's robot would.

    Args:
        core: Core of its model.
        twins: Twin, one.
    """

    def __init__(self, core: Core, twins: Twins) -> None:
        self._core = core
        self._planes = twins

    @property
    def pose(self) -> Pose:
        """Pose x, y [m] and heading [rad]."""
        x, y, heading = self._planes.poses[0].tolist()
        return x, y, math.remainder(heading, math.tau)

    def reset(self) -> None:
        """Reset the board."""
        self._planes.restart()

    def advance_to(self, time_ns: int) -> None:
        """Advance to a time [ns]."""
        self._planes.advance_to(time_ns)

    def execute(self, time_ns: int, late_ns: int, exchange: Exchange) -> Iterator[Action]:
        """Execute a command; yield the actions by which particles with other wheels execute it.

        Args:
            time_ns: Earliest time at which the robot has executed it [ns].
            late_ns: Latest time [ns].
            exchange: Command with its reply.
        """
        self.advance_to(time_ns)
        line = exchange.command
        if not exchange.letter:
            return
        words, values = self._planes.execute(line + b"\n")
        if (match := _WHEEL_COMMAND.fullmatch(line)) and exchange.letter in self._core.commands:
            # The line may have lost the command, or its reply.
            is_unconfirmed = exchange.reply is None
            yield WheelCommand(
                time_ns, exchange.letter, int(match[2]), int(match[3]), is_unconfirmed, late_ns
            )
        elif len(words):
            # Gains, profiles and LEDs: values that do not depend on any other.
            yield StateWrite(time_ns, words, values)
        if exchange.letter in self._core.counter_commands:
            yield CounterReset(time_ns)
