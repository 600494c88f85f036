"""Choice of the code that steps a world: plain at first, compiled from where that saves time."""

from khep_twin.simulation.ready import function_of, when_ready
from khep_twin.simulation.simulation import Advance, Simulation

_STEPS_WORTH_LOADING = 30_000
"""Steps of one robot from which on compiled code saves more time than its loading takes."""


class SteppingCode:
    """Code that steps a simulation; plain and compiled code have the same results.

    Args:
        simulation: Simulation.
        compiled: Whether to step by compiled code; None to change over to it in a long run, once it is ready.

    Attributes:
        switch_at: Number of steps from which on to look for compiled code; None for never. Loading it takes
            half a second, so a run in real time does without.
    """

    def __init__(self, simulation: Simulation, compiled: bool | None) -> None:
        self._simulation = simulation
        self.switch_at: int | None = None
        n_robots = len(simulation.records)
        if compiled is None and n_robots:
            self.switch_at = _STEPS_WORTH_LOADING // n_robots
        elif compiled:
            self.compile()

    def compile(self) -> None:
        """Step by compiled code from now on; the first time may take some seconds.

        Raises:
            MissingNumbaError: numba is not installed.
        """
        self._use(function_of("world"))

    def switch_if_ready(self) -> None:
        """Step by compiled code from now on if it is ready; if not, have it compiled, and look later."""
        if (advance := when_ready("world")) is None:
            self.switch_at = self._simulation.steps + _STEPS_WORTH_LOADING // 10
        else:
            self._use(advance)

    def _use(self, advance: Advance) -> None:
        self.switch_at = None
        if len(self._simulation.records):  # without any robot there is nothing to compile
            self._simulation.step_with(advance, compiled=True)
            # The code is loaded by its first call: now, and not when a host waits for a reply.
            self._simulation.advance(self._simulation.steps)
