"""A simulation's state, lamps and random draws, stepped by plain or compiled code.

Both share the same memory and give the same values, bit for bit; a run may switch between them at any step.
"""

from collections.abc import Callable, Sequence
from itertools import chain
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from khep_twin import step
from khep_twin.errors import DivergedError
from khep_twin.playpen import Lighting
from khep_twin.randomness import key, stream
from khep_twin.robots.core import CORES
from khep_twin.sensing.buffers import as_records
from khep_twin.sensing.lamps import Lamps
from khep_twin.sensing.light import Bulb, HiddenSector, Light, LightLaw
from khep_twin.sensing.noise import check_scale, compiled_tables, key_words, plain_tables
from khep_twin.sensing.simulated import (
    FIRST_POWERS_STEP,
    N_CONVERSIONS,
    N_COUNTERS,
    STEPS,
    Simulated,
    StepInputs,
    Timing,
)
from khep_twin.simulation.moments import Moments
from khep_twin.simulation.robot_groups import RobotGroups
from khep_twin.simulation.world_state import SimulationState
from khep_twin.units import SCAN_STEPS

NO_LIGHT = Light(LightLaw(False, 0.0, 0.0, True, 1, 0.0), (), ())
"""Light of a scene without lamps."""

_MAX_STEPS = 20_000
"""Largest number of steps per call of compiled code, which signals cannot interrupt."""

Advance = Callable[..., int]
"""Function like `plain_advance`; compiled code has separate arrays."""


class SceneForms(Protocol):
    """A scene in its two forms, for plain and for compiled code."""

    def plain(self) -> Any:
        """Return the scene for plain code."""
        ...

    def compiled(self) -> tuple[Any, ...]:
        """Return the scene for compiled code, as arrays."""
        ...

    def vary_robots(self, make_rng: Callable[[int], np.random.Generator] | None) -> None:
        """Replace the robots by others of the same model; None restores those of the playpen.

        The scene's state is overwritten.

        Args:
            make_rng: Function that returns the stream of a robot by its number in the playpen.
        """

    def robot_states(self) -> list[Any]:
        """Return the state of each robot before a start, named tuples of classes in `robots.core.CORES`."""
        ...

    def light(self, lamps: Lamps, lighting: Lighting) -> Light:
        """Return the lamps with the precomputed lines of sight to them."""
        ...

    def describe_error(self, reason: int) -> str:
        """Return why the physics cannot continue."""
        ...


class Simulation:
    """State of a simulation.

    Attributes:
        title: Subject of error messages.
        terms: Names of further readings that are measured without a request, see `robots.core.Core`.
        lamps: Lamps of the scene; none at first.
        on_switch: Function that is called when the next one of lamps that are on one at a time is on.
        robots: Robots in groups, with their states.
        is_compiled: True if compiled code steps the simulation.
        counters: Counters (N_COUNTERS,).
        plain: State for plain code.
        inputs: Lamps, and distributions of random draws, for plain code.
    """

    def __init__(self, scene: SceneForms, timing: Timing) -> None:
        self._scene = scene
        self.robots = RobotGroups(scene.robot_states())
        self.title = "the simulation"
        self.terms: tuple[str, ...] = ()
        self.lamps: Lamps | None = None
        self.on_switch: Callable[[], None] | None = None
        self.counters: NDArray[np.int64] = np.zeros(N_COUNTERS, np.int64)
        self._keys: tuple[int, ...] = ()
        self._noise = 0.0
        self._powers_end = 0
        self.is_compiled = self._has_varied = False
        self.plain = Simulated(scene.plain(), timing, NO_LIGHT, self.robots.plain, self.counters.data)
        self.inputs = StepInputs([[]], plain_tables(0.0))
        self._core: Advance = plain_advance
        self._evaluates = False
        self._scene_args: tuple[Any, ...] = ()
        self._bind_arguments()

    @property
    def steps(self) -> int:
        """Number of steps done."""
        return self.plain.counters[STEPS]

    @property
    def noise(self) -> float:
        """Scale of the sensors' noise; 0 without noise."""
        return self._noise if self._keys else 0.0

    @property
    def powers(self) -> Sequence[float]:
        """Powers of the lamps after the last step, without their flicker (n_lamps,) [W]."""
        rows = self.inputs.powers
        return rows[0 if len(rows) == 1 else self.steps - 1 - int(self.counters[FIRST_POWERS_STEP])]

    @property
    def arguments(self) -> tuple[Any, ...] | None:
        """Arguments of compiled code for any number of steps; None with plain code or variable lamps."""
        are_constant = self.lamps is None or self.lamps.are_constant
        return self._arguments if self.is_compiled and are_constant else None

    def step_with(self, advance: Advance, compiled: bool, *, evaluates: bool = False) -> None:
        """Use another function for all further steps; one that `evaluates` also for measurements."""
        self._core, self._evaluates = advance, evaluates
        self.is_compiled = compiled
        if compiled:
            timing, light = self.plain.timing, self.plain.light
            self._scene_args = self._scene.compiled(), as_records([timing], timing), *_light_records(light)
        self._bind_arguments()

    def reset(self, seed: int, *, noise: float, vary: bool) -> None:
        """Return to step 0; the scene's state must be reset afterwards.

        Args:
            seed: Seed of the robots' random streams.
            noise: Whether sensors are noisy, or a scale of their noise.
            vary: Whether to draw each robot at random around its calibration.

        Raises:
            ValueError: The noise is out of range.
        """
        self._noise = check_scale(noise)
        if vary or self._has_varied:
            self._scene.vary_robots((lambda robot: stream(seed, "robot", robot, "spread")) if vary else None)
            self.robots.replace(self._scene.robot_states())
            self.plain = self.plain._replace(groups=self.robots.plain)
            self.refresh_scene()
        self._has_varied = vary
        self.robots.reset(self.terms)
        self.counters[:] = 0
        self._set_keys(self._make_keys(seed) if self._noise else ())

    def refresh_scene(self) -> None:
        """Update the arguments after a change of the scene."""
        self.plain = self.plain._replace(scene=self._scene.plain())
        if self.is_compiled:
            self._scene_args = (self._scene.compiled(), *self._scene_args[1:])
        self._bind_arguments()

    def state(self) -> SimulationState:
        """Return the state besides scene, robots and lamps."""
        steps, phase, _, drawn = self.counters.tolist()
        return SimulationState(steps, phase, self._keys, drawn, self._noise)

    def set_state(self, state: SimulationState) -> None:
        """Restore a state; the lamps must be set afterwards.

        Raises:
            ValueError: The state is of another number of robots.
        """
        if len(state.keys) not in (0, self.robots.n_robots):
            raise ValueError(f"random draws of {len(state.keys)} robots; expected {self.robots.n_robots}")
        self.counters[:] = state.steps, state.phase, 0, state.n_conversions
        self._noise = state.noise
        self._set_keys(state.keys)

    def reseed(self, seed: int) -> None:
        """Use another seed for all further random draws."""
        if self._keys:
            self._set_keys(self._make_keys(seed))

    def set_lamps(self, lamps: Lamps, lighting: Lighting) -> None:
        """Replace the lamps and the law of their light."""
        self.lamps = lamps
        self._powers_end = self.steps
        light = lamps.add_flicker(self._scene.light(lamps, lighting))
        if light is not self.plain.light:
            self.plain = self.plain._replace(light=light)
            if self.is_compiled:
                self._scene_args = (*self._scene_args[:2], *_light_records(light))
        self._set_powers([lamps.powers])

    def switch_on(self) -> int:
        """Run the scan before time 0; return DONE or STOPPED.

        Raises:
            DivergedError: The physics left its bounds.
        """
        return self.check_reason(self._core(*self._arguments, -1, 0))

    def advance(self, end_step: int, stops: int = 0) -> int:
        """Run steps until `end_step` of them are done since the start; return a `step.Reason`.

        Args:
            end_step: Number of steps since the start.
            stops: Reasons for an earlier return, as for `step.advance`.

        Raises:
            DivergedError: The physics left its bounds, or a controller returned a speed that is not a number.
        """
        lamps = self.lamps
        in_turns = lamps is not None and lamps.lit_index is not None
        if lamps is not None and not (lamps.are_constant or in_turns) and end_step > self._powers_end:
            self._set_powers(lamps.advance_steps(self.steps, end_step, self.plain.timing.step_ns))
            self._powers_end = end_step
        stop_reasons = stops | step.Stop.STEPPED if in_turns else stops
        while True:
            end = min(end_step, int(self.counters[STEPS]) + _MAX_STEPS)
            reason = self.check_reason(self._core(*self._arguments, end, stop_reasons))
            if in_turns and reason == step.Reason.STEPPED:
                self._switch_lamps()
                if not stops & step.Stop.STEPPED:
                    continue
            if reason != step.Reason.DONE or end >= end_step:
                return reason

    def scan(self) -> None:
        """Measure with all sensors of all robots now, in plain code."""
        inputs = self.inputs
        if self.lamps is not None:
            inputs = inputs._replace(powers=[self.lamps.powers])
        for robot in chain(*self.plain.groups):
            CORES[type(robot)].scan(robot, self.plain, inputs)
        self.counters[N_CONVERSIONS] += SCAN_STEPS

    def evaluate(self, robot: int, part: int, moment: int, moments: Moments) -> None:
        """Evaluate a measurement of a robot that is recorded as a moment.

        Args:
            robot: Number of the robot in the playpen.
            part: Number of the measurement, as for `robots.core.evaluate`.
            moment: Number of the moment.
            moments: All moments.
        """
        moments.show(moment)
        number, powers = step.EVALUATE - self.robots.position_of(robot), moments.powers(moment)
        if self._evaluates:
            *arguments, _, tables = self._arguments
            arguments[0] = moments.compiled()
            self._core(*arguments, powers, tables, number, part)
        else:
            inputs = self.inputs._replace(powers=powers.tolist())
            plain_advance(self.plain._replace(scene=moments.plain()), inputs, number, part)

    def check_reason(self, reason: int) -> int:
        """Check the reason of a return of the stepping core, and return it.

        Raises:
            DivergedError: The run has ended.
        """
        if reason < step.Reason.WARNED:
            return reason
        message = "a controller gave a speed that is no number, or raised an error"
        if reason != step.Reason.NO_SPEED:
            message = self._scene.describe_error(reason)
        time_s = self.steps * self.plain.timing.step_ns / 1e9
        raise DivergedError(f"{self.title} failed at {time_s:.4f} s, step {self.steps}: {message}")

    def _set_powers(self, rows: Sequence[Sequence[float]]) -> None:
        """Set the lamps' powers after each further step, or after all (n_steps or 1, n_lamps) [W]."""
        self.counters[FIRST_POWERS_STEP] = self.steps
        self.inputs = self.inputs._replace(powers=rows)
        self._bind_arguments()

    def _switch_lamps(self) -> None:
        """Update lamps that are on one at a time."""
        if self.lamps is None:
            return
        discs = [
            (*self.plain.scene.pose(robot.pose)[:2], robot.radius) for robot in chain(*self.plain.groups)
        ]
        has_switched = self.lamps.update(self.steps * self.plain.timing.step_ns, discs)
        self._set_powers([self.lamps.powers])
        if has_switched and self.on_switch is not None:
            self.on_switch()

    def _bind_arguments(self) -> None:
        """Set the arguments of the stepping core: named tuples, or arrays, which numba passes fastest."""
        if not self.is_compiled:
            self._arguments: tuple[Any, ...] = self.plain, self.inputs
            return
        powers = np.array(self.inputs.powers, np.float64).reshape(len(self.inputs.powers), -1)
        self._arguments = (
            *self._scene_args,
            self.robots.records,
            self.counters,
            powers,
            compiled_tables(self.noise),
        )

    def _make_keys(self, seed: int) -> tuple[int, ...]:
        """Return the key of each robot's random draws."""
        return tuple(key(seed, "robot", number, "sensors") for number in range(self.robots.n_robots))

    def _set_keys(self, keys: tuple[int, ...]) -> None:
        """Set the key of each robot's random draws; empty for no noise."""
        self._keys = keys
        for number in range(self.robots.n_robots):
            self.robots.record_of(number)["noise"] = key_words(keys[number] if keys else 0)
        self.inputs = self.inputs._replace(tables=plain_tables(self.noise))
        self._bind_arguments()


def plain_advance(simulated: Simulated, inputs: StepInputs, end_step: int, stops: int) -> int:
    """Run `step.advance`, or for `end_step` below 0 the action of `step.SWITCH_ON` or `step.EVALUATE`."""
    if end_step < step.SWITCH_ON:
        step.evaluate_recorded(simulated.groups, simulated, inputs, step.EVALUATE - end_step, stops)
        return step.Reason.DONE
    if end_step < 0:
        return step.switch_on(simulated, inputs)
    return step.advance(simulated, inputs, end_step, stops)


def _light_records(light: Light) -> tuple[NDArray[np.void], ...]:
    """Return the light as records for compiled code."""
    return (
        as_records([light.law], light.law),
        as_records(light.bulbs, Bulb()),
        as_records(light.sectors, HiddenSector()),
    )
