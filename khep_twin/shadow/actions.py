"""Actions on the line, as particles repeat them: commands, settings of the board, replies with values."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from khep_twin.board import kernel
from khep_twin.shadow.particles import Particles
from khep_twin.shadow.wheel_commands import POSITION

Integers = NDArray[np.int64]


class Commanded(NamedTuple):
    """A command whose effect depends on a board's registers.

    Attributes:
        time_ns: Time at which the robot executed it [ns].
        command: SPEED, DUTY, TARGET or POSITION of `planes`.
        left: Argument for the left wheel.
        right: Argument for the right wheel.
        doubtful: True if no reply tells that it was executed: every other particle does.
        late_ns: Time until which it may have been executed instead, as its reply came late [ns]: particles
            do so at times from `time_ns` on, evenly.
    """

    time_ns: int
    command: int
    left: int
    right: int
    doubtful: bool = False
    late_ns: int = 0


class Configured(NamedTuple):
    """A command that sets registers, by index (n,), to values (n,), whatever they were, at a time [ns]."""

    time_ns: int
    registers: Integers
    values: Integers


class Restarted(NamedTuple):
    """A restart of the processor, by its time [ns]."""

    time_ns: int


class Waited(NamedTuple):
    """A silence until `time_ns` [ns]."""

    time_ns: int


class Seen(NamedTuple):
    """A reply to N: proximity (8,) [counts] at the time of the reading, and until when it may be of [ns]."""

    time_ns: int
    readings: Integers
    late_ns: int = 0


class Counted(NamedTuple):
    """A reply to H: counters, left and right (2,) [pulses], with the times of `Seen` [ns]."""

    time_ns: int
    counters: Integers
    late_ns: int = 0


LATE_NS = 20_000_000
"""Lateness of a reply above which the time of its command or reading is not certain, and the time between the
particles' executions of such a command (assumed) [ns]."""

Action = Commanded | Configured | Restarted | Waited | Seen | Counted


def repeat(action: Action, particles: Particles) -> None:
    """Advance particles to an action and, unless it is a reply, do it to them."""
    planes = particles.planes
    planes.advance_to(action.time_ns)
    match action:
        case Commanded(time_ns, command, left, right, doubtful, late_ns):
            turns = max(late_ns - time_ns, 0) // LATE_NS + 1
            for turn in range(turns):
                planes.advance_to(time_ns + turn * LATE_NS)
                planes.taken(slice(turn, None, 2 * turns if doubtful else turns)).command(
                    command, left, right
                )
        case Configured(_, registers, values):
            planes.registers[:, registers] = values
        case Restarted():
            for board in planes.registers:
                kernel.reset(board.data)
            particles.counted[:] = np.nan
        case _:
            pass
    if isinstance(action, Commanded) and action.command == POSITION:
        particles.counted[:] = np.nan
