"""Choice of the code that steps a world: plain code first, compiled code when it saves time."""

from khep_twin.simulation.ready import function_of, part_of, when_ready
from khep_twin.simulation.simulation import Advance, Simulation

_MIN_STEPS = 30_000
"""Steps of one robot after which compiled code saves more time than its loading takes."""


class SteppingCode:
    """Code that steps a simulation; plain and compiled code have the same results.

    Args:
        simulation: Simulation.
        compiled: Whether to step by compiled code; None to switch to it in a long run, once it is ready.

    Attributes:
        switch_at: Number of steps after which to check for compiled code; None for never. Loading the code
            takes half a second, so a run in real time does not switch.
    """

    def __init__(self, simulation: Simulation, compiled: bool | None) -> None:
        self._simulation = simulation
        self.switch_step: int | None = None
        self._part = part_of("world", simulation.robots.models)
        n_robots = simulation.robots.n_robots
        if compiled is None and n_robots:
            self.switch_step = _MIN_STEPS // n_robots
        elif compiled:
            self.compile()

    def compile(self) -> None:
        """Switch to compiled code; the first time may take some seconds.

        Raises:
            MissingNumbaError: numba is not installed.
        """
        self._switch_to(function_of(self._part))

    def switch_if_ready(self) -> None:
        """Switch to compiled code if it is ready; if not, start its compilation and check again later."""
        if (advance := when_ready(self._part)) is None:
            self.switch_step = self._simulation.steps + _MIN_STEPS // 10
        else:
            self._switch_to(advance)

    def _switch_to(self, advance: Advance) -> None:
        self.switch_step = None
        if self._simulation.robots.n_robots:  # without robots there is nothing to compile
            self._simulation.step_with(advance, compiled=True, evaluates=True)
            # The first call loads the code: now, rather than while a host waits for a reply.
            self._simulation.advance(self._simulation.steps)
