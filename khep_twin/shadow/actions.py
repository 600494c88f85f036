"""Actions on the line that particles (hypothetical robots) replay: commands, register writes, replies."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from khep_twin.board import kernel
from khep_twin.shadow.particles import Particles
from khep_twin.shadow.thresholds import THRESHOLDS
from khep_twin.shadow.wheel_commands import POSITION

Integers = NDArray[np.int64]


class WheelCommand(NamedTuple):
    """A command whose effect depends on a board's registers.

    Attributes:
        time_ns: Time at which the robot executed it [ns].
        command: SPEED, DUTY, TARGET or POSITION of `wheel_commands`.
        left: Argument for the left wheel.
        right: Argument for the right wheel.
        is_unconfirmed: True if no reply confirms that it was executed: every other particle executes it.
        late_ns: Latest time of its execution [ns]; those of particles are spread evenly from `time_ns` on.
    """

    time_ns: int
    command: int
    left: int
    right: int
    is_unconfirmed: bool = False
    late_ns: int = 0


class RegisterWrite(NamedTuple):
    """A command at a time [ns] that sets registers, by index (n,), to values that no register determines."""

    time_ns: int
    registers: Integers
    values: Integers


class Restart(NamedTuple):
    """A restart of the processor, by its time [ns]."""

    time_ns: int


class Silence(NamedTuple):
    """No bytes on the line until `time_ns` [ns]."""

    time_ns: int


class ProximityReply(NamedTuple):
    """A reply to N: proximity (8,) [counts], and the earliest and the latest time of the reading [ns]."""

    time_ns: int
    readings: Integers
    late_ns: int = 0

    @property
    def in_sight(self) -> bool:
        """True if an obstacle is in sight of a sensor."""
        return bool(self.readings.max() > THRESHOLDS.in_sight)


class CounterReply(NamedTuple):
    """A reply to H: counters, left and right (2,) [pulses], with the times of `ProximityReply` [ns]."""

    time_ns: int
    counters: Integers
    late_ns: int = 0


LATE_NS = 20_000_000
"""Delay of a reply above which the time of its command or reading is uncertain; also the interval at which
groups of particles then execute the command (assumed) [ns]."""

Action = WheelCommand | RegisterWrite | Restart | Silence | ProximityReply | CounterReply


def apply_action(action: Action, particles: Particles) -> None:
    """Advance particles to an action and, unless it is a reply, apply it to them."""
    twins = particles.twins
    twins.advance_to(action.time_ns)
    match action:
        case WheelCommand(time_ns, command, left, right, is_unconfirmed, late_ns):
            n_groups = max(late_ns - time_ns, 0) // LATE_NS + 1
            for group in range(n_groups):
                twins.advance_to(time_ns + group * LATE_NS)
                rows = slice(group, None, 2 * n_groups if is_unconfirmed else n_groups)
                twins.select(rows).command(command, left, right)
        case RegisterWrite(_, registers, values):
            twins.registers[:, registers] = values
        case Restart():
            for board in twins.registers:
                kernel.reset(board.data)
            particles.counter_offsets[:] = np.nan
        case _:
            pass
    if isinstance(action, WheelCommand) and action.command == POSITION:
        particles.counter_offsets[:] = np.nan
