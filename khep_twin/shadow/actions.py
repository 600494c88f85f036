"""Actions on the line, as particles repeat them: commands, settings of the board, replies with values."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from khep_twin.board import kernel
from khep_twin.shadow.particles import Particles
from khep_twin.shadow.planes import TICK_NS
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
    """

    time_ns: int
    command: int
    left: int
    right: int
    doubtful: bool = False


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
    """A reply to N: proximity (8,) [counts] at the time of the reading [ns]."""

    time_ns: int
    readings: Integers


class Counted(NamedTuple):
    """A reply to H: counters, left and right (2,) [pulses], at the time of the reading [ns]."""

    time_ns: int
    counters: Integers


Action = Commanded | Configured | Restarted | Waited | Seen | Counted


def repeat(action: Action, particles: Particles) -> None:
    """Advance particles to an action and, unless it is a reply, do it to them."""
    planes = particles.planes
    if (ticks := action.time_ns // TICK_NS - planes.ticks) > 0:
        planes.advance(ticks)
    match action:
        case Commanded(_, command, left, right, doubtful):
            obeying = planes.taken(slice(None, None, 2)) if doubtful else planes
            obeying.command(command, left, right)
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
