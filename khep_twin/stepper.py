"""Steps of a world: bytes on its lines, the stepping core, and what robots and observers do in between."""

from collections.abc import Callable, Sequence
from threading import RLock
from typing import Protocol

from khep_twin import step
from khep_twin.clock import NEVER_NS
from khep_twin.errors import DivergedError
from khep_twin.one_thread import entered_twice
from khep_twin.robot import Robot
from khep_twin.simulation.simulation import Simulation
from khep_twin.simulation.stepping_code import SteppingCode
from khep_twin.simulation.world_state import WorldState


class SteppedWorld(Protocol):
    """Interface of the world to its steps."""

    time_ns: int
    guard: RLock

    @property
    def observers(self) -> Sequence[object]:
        """Observers of the world."""
        ...

    def sample(self) -> None:
        """Let the observers sample the world."""
        ...

    def on_event(self, robot: int | None, text: str) -> None:
        """Send an event to the observers."""
        ...


class Stepper:
    """Steps of a world, which set its clock.

    Args:
        world: World.
        simulation: State that the stepping core works on.
        code: Code that steps it.
        stops: Reasons of `step` for which robots act amid a run: TICKED for turrets, STEPPED and TICKED for
            robots that the stepping core does not run.
        shows_leds: True if the scene shows the robots' LEDs.

    Attributes:
        robots: Robots of the world.
        failure: Error that has ended the run; None for none.
    """

    def __init__(
        self,
        world: SteppedWorld,
        simulation: Simulation,
        code: SteppingCode,
        *,
        stops: int,
        shows_leds: bool,
    ) -> None:
        self._world, self._simulation, self._code = world, simulation, code
        self._stops, self._shows_leds = stops, shows_leds
        self._step_ns = simulation.plain.timing.step_ns
        self._steps_per_sample = simulation.plain.timing.steps_per_supply
        self.rewind()

    def rewind(self) -> None:
        """Return to time 0, without robots."""
        self._world.time_ns = 0
        self.robots: Sequence[Robot] = ()
        self.failure: DivergedError | None = None
        self._fault_ns = NEVER_NS

    def begin(self, robots: Sequence[Robot]) -> None:
        """Switch the robots on, a scan before time 0.

        Raises:
            DivergedError: The physics leaves its bounds at once.
        """
        self.robots = robots
        self._find_faults()
        self._simulation.on_switch = self._on_switch
        self._run(self._simulation.switch_on)
        for robot in robots:
            robot.switch_on()

    def advance_to(self, time_ns: int) -> None:
        """Advance to a time [ns]: see `World.advance_to`."""
        # As by `one_thread`, but faster: it is called for each read and write of a host.
        if not self._world.guard.acquire(False):
            raise entered_twice(self._world, "advance_to")
        try:
            self._advance_to(time_ns)
        finally:
            self._world.guard.release()

    def finish_steps(self, reason: int, until: int) -> None:
        """Act for a return of the stepping core that was not called here, and run on to a step.

        Raises:
            DivergedError: The physics left its bounds.
        """
        returned = self._run(lambda: self._simulation.checked(reason))
        while returned != step.DONE:
            returned = self._run(self._simulation.advance, until)

    @property
    def is_self_contained(self) -> bool:
        """True if nothing outside the stepping core acts amid a run: no turret, LED, fault or observer."""
        acts = self._shows_leds or bool(self._stops) or bool(self._world.observers)
        return not acts and self._fault_ns == NEVER_NS

    def set_state(self, state: WorldState) -> None:
        """Take over the state of stepping core and robots; physics and lamps have to be set afterwards.

        Raises:
            ValueError: It does not fit the world.
        """
        steps = state.time_ns // self._step_ns
        if state.simulation.steps != steps or len(state.robots) != len(self.robots):
            found = f"{state.simulation.steps} steps of {len(state.robots)} robots at {state.time_ns} ns"
            raise ValueError(f"{found}; expected {steps} of {len(self.robots)}")
        self._simulation.set_state(state.simulation)
        self._world.time_ns = state.time_ns
        self.failure = DivergedError(state.failure) if state.failure else None
        for robot, of_robot in zip(self.robots, state.robots, strict=True):
            robot.set_state(of_robot)
        self._find_faults()

    def _advance_to(self, time_ns: int) -> None:
        if self.failure is not None:
            raise self.failure
        if time_ns < self._world.time_ns:
            raise ValueError(f"time cannot go back from {self._world.time_ns} to {time_ns} ns")
        steps, last = self._simulation.steps, time_ns // self._step_ns
        while steps < last:
            steps = self._step_to(steps, last, self._exchange((steps + 1) * self._step_ns))
        self._exchange(time_ns)
        self._world.time_ns = time_ns
        if self._code.switch_at is not None and self._simulation.steps >= self._code.switch_at:
            self._code.switch_if_ready()

    def _find_faults(self) -> None:
        """Find when the next fault begins or ends by itself."""
        changes_ns = [fault_ns for robot in self.robots for fault_ns in robot.next_faults_ns]
        self._fault_ns = min(changes_ns, default=NEVER_NS)

    def _exchange(self, time_ns: int) -> int:
        """Exchange what is due by a time [ns] on all lines; return when something is due next [ns]."""
        earliest_ns = NEVER_NS
        for robot in self.robots:
            next_ns = robot.next_exchange_ns()
            if next_ns is not None and next_ns <= time_ns:
                robot.exchange(time_ns)
                next_ns = robot.next_exchange_ns()
            if next_ns is not None and next_ns < earliest_ns:
                earliest_ns = next_ns
        return earliest_ns

    def _step_to(self, steps: int, last: int, event_ns: int) -> int:
        """Run one span, in which nothing outside the stepping core can happen; return the steps done.

        Args:
            steps: Steps done so far.
            last: Steps after which the span must end.
            event_ns: Time when something is due on a line [ns].
        """
        per_sample, step_ns = self._steps_per_sample, self._step_ns
        end = min(last, (min(event_ns, self._fault_ns) - 1) // step_ns)
        boundary = (steps // per_sample + 1) * per_sample
        if end > boundary and self._shows_leds:
            if self._world.observers or any(robot.leds_differ for robot in self.robots):
                end = boundary
        end = max(end, steps + 1)
        stops = self._stops
        if self._fault_ns <= end * step_ns:
            stops = step.STEPPED | step.TICKED
        while self._run(self._simulation.advance, end, stops) != step.DONE:
            pass
        if end >= boundary:
            for robot in self.robots:
                if self._shows_leds and robot.leds_differ:
                    robot.show_leds()
            if end % per_sample == 0:
                self._world.sample()
        return end

    def _run(self, run: Callable[..., int], *arguments: int) -> int:
        """Run the stepping core and do what it returns for; return the reason."""
        try:
            reason = run(*arguments)
        except DivergedError as error:
            self._take_time()
            self.failure = error
            self._world.on_event(None, str(error))
            raise
        self._take_time()
        if reason != step.DONE:
            for robot in self.robots:
                robot.act_after(reason)
            self._find_faults()
        return reason

    def _on_switch(self) -> None:
        """Log which lamp is on, where lamps are on one at a time."""
        self._take_time()
        if (lamps := self._simulation.lamps) is not None:
            self._world.on_event(None, f"{lamps.names[lamps.lit or 0]} is on")

    def _take_time(self) -> None:
        self._world.time_ns = self._simulation.steps * self._step_ns
