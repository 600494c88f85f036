"""Faults of the machine's clocks: the wall clock is set, and the machine sleeps for a while.

A wall clock that is set, by seconds or by years, must disturb no program. A machine that sleeps suspends all
its programs together, while robots at its cables continue. Linux stops the monotonic clock meanwhile, so that
programs see only a jump of the wall clock; on other systems it continues, as here.
"""

from checks.simulate.faults import CLOCK, Faults
from checks.simulate.kernel import NS_PER_S, Kernel
from checks.simulate.system import SimulatedTime

_LOOK_NS = 10 * NS_PER_S
"""Time from one opportunity to the next [ns]."""

_MOST_SET, _MOST_SUSPENDED = 0.3, 0.1
"""Highest probabilities at an opportunity."""

_JUMPS_S = 0.5, 60.0, 3600.0, 86400.0, 3e7
"""Jumps of the wall clock [s]."""


def disturb_clocks(kernel: Kernel, faults: Faults, time: SimulatedTime) -> None:
    """Set the clock, and suspend the machine, now and then from now on."""

    def look() -> None:
        kernel.at(kernel.now_ns + _LOOK_NS, look)
        if faults.happens(CLOCK, "machine", _MOST_SET):
            rng = faults.drawn(CLOCK, "machine")
            time.ahead_ns += round(rng.choice((-1, 1)) * rng.choice(_JUMPS_S) * NS_PER_S)
        if faults.happens("suspend", "machine", _MOST_SUSPENDED):
            duration_s = 10 ** faults.drawn("suspend", "machine").uniform(-1, 1)
            kernel.suspend(round(duration_s * NS_PER_S))

    # Amid events, not at whole seconds.
    kernel.at(kernel.now_ns + 4_321_012_345, look)
