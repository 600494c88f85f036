"""Actions on the line that particles (hypothetical robots) replay: commands, register writes, replies."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from khep_twin.shadow.particles import Particles

Integers = NDArray[np.int64]


class WheelCommand(NamedTuple):
    """A command of `Core.commands`, whose effect depends on the robot's state.

    Attributes:
        time_ns: Time at which the robot executed it [ns].
        letter: Letter of the request.
        left: Argument for the left wheel.
        right: Argument for the right wheel.
        is_unconfirmed: True if no reply confirms that it was executed: every other particle executes it.
        late_ns: Latest time of its execution [ns]; those of particles are spread evenly from `time_ns` on.
    """

    time_ns: int
    letter: str
    left: int
    right: int
    is_unconfirmed: bool = False
    late_ns: int = 0


class StateWrite(NamedTuple):
    """A command at a time [ns] that sets words of `PlanarBodies.states` to the same values in all (n,)."""

    time_ns: int
    words: NDArray[np.intp]
    values: Integers


class CounterReset(NamedTuple):
    """A command that sets the counters, by its time [ns]."""

    time_ns: int


class Restart(NamedTuple):
    """A restart of the processor, by its time [ns]."""

    time_ns: int


class Silence(NamedTuple):
    """No bytes on the line until `time_ns` [ns]."""

    time_ns: int


class ProximityReply(NamedTuple):
    """A reply to N: proximity (s,) [counts], earliest and latest time [ns], if an obstacle is in sight."""

    time_ns: int
    readings: Integers
    late_ns: int = 0
    in_sight: bool = False


class SonarReply(NamedTuple):
    """A reply with distances (n,) [m], by `sonar_model.distances_of`; the rest is as in `ProximityReply`."""

    time_ns: int
    readings: NDArray[np.float64]
    late_ns: int = 0
    in_sight: bool = False


class CounterReply(NamedTuple):
    """A reply with counters, as to H: left and right (2,) [pulses], and its times [ns]."""

    time_ns: int
    counters: Integers
    late_ns: int = 0


LATE_NS = 20_000_000
"""Delay of a reply above which the time of its command or reading is uncertain; also the interval at which
groups of particles then execute the command (assumed) [ns]."""

RangeReply = ProximityReply | SonarReply
"""A reply that weights the particles."""

Action = WheelCommand | StateWrite | CounterReset | Restart | Silence | RangeReply | CounterReply


def apply_action(action: Action, particles: Particles) -> None:
    """Advance particles to an action and, unless it is a reply, apply it to them."""
    twins = particles.twins
    twins.advance_to(action.time_ns)
    match action:
        case WheelCommand(time_ns, letter, left, right, is_unconfirmed, late_ns):
            n_groups = max(late_ns - time_ns, 0) // LATE_NS + 1
            for group in range(n_groups):
                twins.advance_to(time_ns + group * LATE_NS)
                rows = slice(group, None, 2 * n_groups if is_unconfirmed else n_groups)
                twins.command(letter, left, right, rows)
        case StateWrite(_, words, values):
            twins.states[:, words] = values
        case Restart():
            twins.restart()
        case _:
            pass
    if isinstance(action, Restart | CounterReset):
        particles.counter_offsets[:] = np.nan
