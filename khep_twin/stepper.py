"""Steps of a world: bytes on its lines, the stepping core, and actions of robots and observers in between."""

from collections.abc import Callable, Sequence

from khep_twin import step
from khep_twin.clock import NEVER_NS
from khep_twin.errors import DivergedError
from khep_twin.observers import Observers
from khep_twin.robots.robot import Robot
from khep_twin.simulation.simulation import Simulation
from khep_twin.simulation.stepping_code import SteppingCode
from khep_twin.simulation.world_state import WorldState


class Stepper:
    """Steps of a world, and its clock; `rewind` starts a run.

    Args:
        simulation: State of the stepping core.
        code: Code that runs it, plain or compiled.
        stops: Sum of `step.Stop` values at which robots act within a run: TICKED for turrets.
        shows_leds: True if the scene shows the robots' LEDs.

    Attributes:
        time_ns: Current time [ns].
        robots: Robots of the world, once they are switched on.
        failure: Error that ended the run; None for none.
    """

    def __init__(self, simulation: Simulation, code: SteppingCode, *, stops: int, shows_leds: bool) -> None:
        self._simulation = simulation
        self._code = code
        self._stops = stops
        self._shows_leds = shows_leds
        self._step_ns = simulation.plain.timing.step_ns
        self._steps_per_sample = simulation.plain.timing.steps_per_supply

    def rewind(self, observers: Observers) -> None:
        """Return to time 0, without robots, for a run with these observers."""
        self._observers = observers
        self.time_ns = 0
        self.robots: Sequence[Robot] = ()
        self.failure: DivergedError | None = None
        self._fault_ns = NEVER_NS

    def begin(self, robots: Sequence[Robot]) -> None:
        """Switch the robots on, one scan before time 0.

        Raises:
            DivergedError: The physics leaves its bounds at the start.
        """
        self.robots = robots
        self._update_fault_time()
        self._simulation.on_switch = self._on_switch
        self._run(self._simulation.switch_on)

    def advance_to(self, time_ns: int) -> None:
        """Advance to a time [ns]: see `World.advance_to`."""
        if self.failure is not None:
            raise self.failure
        if time_ns < self.time_ns:
            raise ValueError(f"time cannot go back from {self.time_ns} to {time_ns} ns")
        steps, end_step = self._simulation.steps, time_ns // self._step_ns
        while steps < end_step:
            steps = self._step_to(steps, end_step, self._exchange((steps + 1) * self._step_ns))
        self._exchange(time_ns)
        self.time_ns = time_ns
        if self._code.switch_step is not None and self._simulation.steps >= self._code.switch_step:
            self._code.switch_if_ready()

    def finish_steps(self, reason: int, end_step: int) -> None:
        """Handle a return of the stepping core, which another object has called, and run up to a step.

        Raises:
            DivergedError: The physics left its bounds.
        """
        stop_reason = self._run(lambda: self._simulation.check_reason(reason))
        while stop_reason != step.Reason.DONE:
            stop_reason = self._run(self._simulation.advance, end_step)

    @property
    def is_self_contained(self) -> bool:
        """True if no turret, LED, fault or observer acts within a run of the stepping core.

        A world with observers shows the LEDs.
        """
        return not (self._shows_leds or self._stops) and self._fault_ns == NEVER_NS

    def set_state(self, state: WorldState) -> None:
        """Restore the state of stepping core and robots; the caller restores physics and lamps afterwards.

        Raises:
            ValueError: It does not fit the world.
        """
        steps = state.time_ns // self._step_ns
        if state.simulation.steps != steps or len(state.robots) != len(self.robots):
            counts = f"{state.simulation.steps} steps of {len(state.robots)} robots at {state.time_ns} ns"
            raise ValueError(f"{counts}; expected {steps} of {len(self.robots)}")
        if state.simulation.phase != step.Phase.DONE and not state.failure:
            raise ValueError(f"phase {state.simulation.phase} of a step; expected {int(step.Phase.DONE)}")
        self._simulation.set_state(state.simulation)
        self.time_ns = state.time_ns
        self.failure = DivergedError(state.failure) if state.failure else None
        for robot, robot_state in zip(self.robots, state.robots, strict=True):
            try:
                robot.set_state(robot_state)
            except ValueError as error:
                raise ValueError(f"robot {robot.index}: {error}") from None
        self._update_fault_time()

    def _update_fault_time(self) -> None:
        """Set the time of the next scheduled start or end of a fault."""
        fault_changes_ns = [fault_ns for robot in self.robots for fault_ns in robot.faults.next_changes_ns]
        self._fault_ns = min(fault_changes_ns, default=NEVER_NS)

    def _exchange(self, time_ns: int) -> int:
        """Exchange the bytes due up to a time [ns] on all lines; return the time of the next ones [ns]."""
        earliest_ns = NEVER_NS
        for robot in self.robots:
            next_ns = robot.next_exchange_ns()
            if next_ns is not None and next_ns <= time_ns:
                robot.exchange(time_ns)
                next_ns = robot.next_exchange_ns()
            if next_ns is not None and next_ns < earliest_ns:
                earliest_ns = next_ns
        return earliest_ns

    def _step_to(self, steps: int, last_step: int, event_ns: int) -> int:
        """Run steps without an event outside the stepping core; return the number of steps since the start.

        Args:
            steps: Present number of steps since the start.
            last_step: Largest number of steps at which to stop.
            event_ns: Time of the next bytes on a line [ns].
        """
        steps_per_sample, step_ns = self._steps_per_sample, self._step_ns
        end_step = min(last_step, (min(event_ns, self._fault_ns) - 1) // step_ns)
        next_sample_step = (steps // steps_per_sample + 1) * steps_per_sample
        if end_step > next_sample_step and self._shows_leds:
            if self._observers or any(robot.leds_differ for robot in self.robots):
                end_step = next_sample_step
        end_step = max(end_step, steps + 1)
        stops = self._stops
        if self._fault_ns <= end_step * step_ns:
            stops = step.Stop.STEPPED | step.Stop.TICKED
        while self._run(self._simulation.advance, end_step, stops) != step.Reason.DONE:
            pass
        if end_step >= next_sample_step:
            for robot in self.robots:
                if self._shows_leds and robot.leds_differ:
                    robot.show_leds()
            if end_step % steps_per_sample == 0:
                self._observers.sample()
        return end_step

    def _run(self, run_core: Callable[..., int], *arguments: int) -> int:
        """Call `run_core`, a function of the stepping core, and handle its return; return the reason."""
        try:
            reason = run_core(*arguments)
        except DivergedError as error:
            self._update_time()
            self.failure = error
            self._observers.on_event(None, str(error))
            raise
        self._update_time()
        if reason != step.Reason.DONE:
            for robot in self.robots:
                robot.act_after(reason)
            self._update_fault_time()
        return reason

    def _on_switch(self) -> None:
        """Log which lamp is on, for lamps that are on one at a time."""
        self._update_time()
        if (lamps := self._simulation.lamps) is not None:
            self._observers.on_event(None, f"{lamps.names[lamps.lit_index or 0]} is on")

    def _update_time(self) -> None:
        self.time_ns = self._simulation.steps * self._step_ns
