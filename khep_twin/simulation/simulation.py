"""A simulation's state, lamps and random draws, stepped by plain or by compiled code.

Both kinds of code work on the same memory and give the same bits, so a run may change over at any step.
"""

from collections.abc import Callable, Sequence
from typing import Annotated, Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from khep_twin import step
from khep_twin.errors import DivergedError
from khep_twin.playpen import Lighting
from khep_twin.randomness import key, stream
from khep_twin.sensing.buffers import as_plain, as_records, fill_record
from khep_twin.sensing.lamps import Lamps
from khep_twin.sensing.light import Bulb, Hidden, Light, LightLaw
from khep_twin.sensing.noise import TABLE_ARRAYS, TABLES, key_words
from khep_twin.step import RobotState, Simulated, StepInputs, Timing
from khep_twin.units import N_SENSORS

NO_LIGHT = Light(LightLaw(False, 0.0, 0.0, True, 1, 0.0), (), ())
"""Lamps of a scene without any."""

_SPAN = 20_000
"""Most steps in one call of compiled code, which nothing interrupts."""

Advance = Callable[..., int]
"""`step.advance`, or `step.switch_on` where `until` is below 0; compiled code gets all as separate arrays."""


class SceneForms(Protocol):
    """A scene in its two forms."""

    def plain(self) -> Any:
        """Return the scene for plain code."""
        ...

    def compiled(self) -> tuple[Any, ...]:
        """Return the scene for compiled code, as arrays."""
        ...

    def vary(self, spread: Callable[[int], np.random.Generator] | None) -> None:
        """Make the robots others of the same make; None for those of the playpen.

        The scene's state is lost.

        Args:
            spread: Function that returns the stream of a robot by its number in the playpen.
        """
        ...

    @property
    def n_robots(self) -> int:
        """Number of robots in the playpen."""
        ...

    @property
    def numbers(self) -> Sequence[int]:
        """Numbers of those that the stepping core runs."""
        ...

    def robot_states(self) -> list[RobotState]:
        """Return the states of the robots that the stepping core runs."""
        ...

    def light(self, lamps: Lamps, lighting: Lighting) -> Light:
        """Return the lamps with the known sight lines to them."""
        ...

    def trouble(self, reason: int) -> str:
        """Return a sentence on why the physics cannot go on."""
        ...


class SimulationState(NamedTuple):
    """State of a simulation besides its scene, robots and lamps.

    Attributes:
        steps: Number of steps done.
        phase: Part of the step that is done.
        keys: Key of each robot's random draws; empty without noise.
        drawn: Number of conversions of each robot so far.
    """

    steps: Annotated[int, Field(ge=0, lt=2**62)]
    phase: Annotated[int, Field(ge=step.Phase.DONE, le=step.Phase.TICKED)]
    keys: tuple[Annotated[int, Field(ge=0, lt=2**64)], ...]
    drawn: Annotated[int, Field(ge=0, lt=2**62)]


class Simulation:
    """State of a simulation.

    Args:
        scene: Scene.
        timing: Divisions of time, and bounds.

    Attributes:
        title: Subject of error messages.
        lamps: Lamps of the scene; none at first.
        on_switch: Function that is called when another lamp is on, where lamps are on one at a time.
        others: Function that returns the discs of the floor that robots outside the stepping core cover.
        records: Robots as records of `step.RobotState` (n_robots,): their present state.
        counters: Counters (step.N_COUNTERS,).
        plain: State for plain code.
        inputs: Lamps, and distributions of random draws, for plain code.
    """

    def __init__(self, scene: SceneForms, timing: Timing) -> None:
        self._scene = scene
        robots = scene.robot_states()
        self.title = "the simulation"
        self.lamps: Lamps | None = None
        self.on_switch: Callable[[], None] | None = None
        self.others: Callable[[], list[tuple[float, float, float]]] = list
        self.records: Any = as_records(robots, robots[0]) if robots else np.zeros(0, np.int64)
        self.counters: NDArray[np.int64] = np.zeros(step.N_COUNTERS, np.int64)
        self._keys: tuple[int, ...] = ()
        self._powered = 0
        self._compiled = self._is_varied = False
        self.plain = Simulated(scene.plain(), timing, NO_LIGHT, (), self.counters.data)
        self.inputs = StepInputs([[]], TABLES[0])
        self._run: Advance = plain_advance
        self._arrays: tuple[Any, ...] = ()
        self._show_plain(robots)

    @property
    def steps(self) -> int:
        """Number of steps done."""
        return self.plain.counters[step.STEPS]

    @property
    def is_noisy(self) -> bool:
        """True if sensors are noisy."""
        return bool(self._keys)

    def key_words(self, number: int) -> tuple[int, int]:
        """Return the words of the key of a robot's random draws; 0 without noise."""
        return key_words(self._keys[number] if self._keys else 0)

    @property
    def powers(self) -> Sequence[float]:
        """Powers of the lamps after the last step, without their flicker (n_lamps,) [W]."""
        rows = self.inputs.powers
        return rows[0 if len(rows) == 1 else self.steps - 1 - int(self.counters[step.FIRST])]

    @property
    def is_compiled(self) -> bool:
        """True if compiled code steps it."""
        return self._compiled

    @property
    def arguments(self) -> tuple[Any, ...] | None:
        """Arguments of compiled code for any number of steps; None if plain code steps, or lamps change."""
        steady = self.lamps is None or self.lamps.steady
        return self._arguments if self._compiled and steady else None

    def step_with(self, advance: Advance, compiled: bool) -> None:
        """Step by another function from now on."""
        self._run, self._compiled = advance, compiled
        if compiled:
            timing = self.plain.timing
            self._arrays = (self._scene.compiled(), as_records([timing], timing), *_arrays(self.plain.light))
        self._bind()

    def reset(self, seed: int, *, noise: bool, vary: bool) -> None:
        """Return to step 0; the scene's own state has to be reset afterwards.

        Args:
            seed: Seed of the robots' random streams.
            noise: Whether sensors are noisy.
            vary: Whether to draw each robot at random around its calibration.
        """
        if vary or self._is_varied:
            self._scene.vary((lambda number: stream(seed, "robot", number, "spread")) if vary else None)
            self.take_scene()
            robots = self._scene.robot_states()
            for record, robot in zip(self.records, robots, strict=True):
                fill_record(record, robot)
            self._show_plain(robots)
        self._is_varied = vary
        for name in ("registers", "processor", "sensor_states", "voltage") if len(self.records) else ():
            self.records[name] = 0
        if len(self.records):
            self.records["strengths"] = 1
        self.counters[:] = 0
        self._draw_by(self._keys_of(seed) if noise else ())

    def take_scene(self) -> None:
        """Take the present forms of the scene, which has changed."""
        self.plain = self.plain._replace(scene=self._scene.plain())
        if self._compiled:
            self._arrays = (self._scene.compiled(), *self._arrays[1:])
        self._bind()

    def state(self) -> SimulationState:
        """Return the state besides scene, robots and lamps."""
        steps, phase, _, drawn = self.counters.tolist()
        return SimulationState(steps, phase, self._keys, drawn)

    def set_state(self, state: SimulationState) -> None:
        """Take over a state; the lamps have to be set afterwards.

        Raises:
            ValueError: It is of other robots.
        """
        if len(state.keys) not in (0, self._scene.n_robots):
            raise ValueError(f"random draws of {len(state.keys)} robots; expected {self._scene.n_robots}")
        self.counters[:] = state.steps, state.phase, 0, state.drawn
        self._draw_by(state.keys)

    def reseed(self, seed: int) -> None:
        """Draw at random by another seed from now on."""
        if self._keys:
            self._draw_by(self._keys_of(seed))

    def set_lamps(self, lamps: Lamps, lighting: Lighting) -> None:
        """Replace the lamps and the law of their light."""
        self.lamps, self._powered = lamps, self.steps
        light = lamps.flickering(self._scene.light(lamps, lighting))
        if light is not self.plain.light:
            self.plain = self.plain._replace(light=light)
            if self._compiled:
                self._arrays = (*self._arrays[:2], *_arrays(light))
        self._power([lamps.powers])

    def switch_on(self) -> int:
        """Run the scan before time 0; return DONE or STOPPED.

        Raises:
            DivergedError: The physics left its bounds.
        """
        return self.checked(self._run(*self._arguments, -1, 0))

    def advance(self, until: int, stops: int = 0) -> int:
        """Run steps until so many are done since the start; return a reason of `step`.

        Args:
            until: Number of steps.
            stops: Reasons to return earlier, as for `step.advance`.

        Raises:
            DivergedError: The physics left its bounds, or a controller gave a speed that is no number.
        """
        lamps = self.lamps
        by_turns = lamps is not None and lamps.lit is not None
        if lamps is not None and not (lamps.steady or by_turns) and until > self._powered:
            self._power(lamps.rows(self.steps, until, self.plain.timing.step_ns))
            self._powered = until
        wanted = stops | step.Stop.STEPPED if by_turns else stops
        while True:
            end = min(until, int(self.counters[step.STEPS]) + _SPAN)
            reason = self.checked(self._run(*self._arguments, end, wanted))
            if by_turns and reason == step.Reason.STEPPED:
                self._switch_lamps()
                if not stops & step.Stop.STEPPED:
                    continue
            if reason != step.Reason.DONE or end >= until:
                return reason

    def scan(self, first: int) -> None:
        """Convert all sensors of all robots now, from one on, in plain code."""
        inputs = self.inputs
        if self.lamps is not None:
            inputs = inputs._replace(powers=[self.lamps.powers])
        time_ns = self.steps * self.plain.timing.step_ns
        for turn in range(N_SENSORS):
            channel = (first + turn) % N_SENSORS
            for robot in range(len(self.plain.robots)):
                step.convert_sensor(self.plain, inputs, robot, 0, time_ns, channel)
            self.counters[step.DRAWN] += 1

    def checked(self, reason: int) -> int:
        """Return the reason of a return of the stepping core.

        Raises:
            DivergedError: The run has ended.
        """
        if reason < step.Reason.WARNED:
            return reason
        trouble = "a controller gave a speed that is no number, or raised an error"
        if reason != step.Reason.NO_SPEED:
            trouble = self._scene.trouble(reason)
        time_s = self.steps * self.plain.timing.step_ns / 1e9
        raise DivergedError(f"{self.title} failed at {time_s:.4f} s, step {self.steps}: {trouble}")

    def _power(self, rows: Sequence[Sequence[float]]) -> None:
        """Set the lamps' powers after each step from now on, or for all (n_steps or 1, n_lamps) [W]."""
        self.counters[step.FIRST] = self.steps
        self.inputs = self.inputs._replace(powers=rows)
        self._bind()

    def _switch_lamps(self) -> None:
        """Update lamps that are on one at a time."""
        if self.lamps is None:
            return
        discs = self.others()
        for robot in self.plain.robots:
            x, y, _, _ = self.plain.scene.pose(robot.pose)
            discs.append((x, y, robot.radius))
        switched = self.lamps.update(self.steps * self.plain.timing.step_ns, discs)
        self._power([self.lamps.powers])
        if switched and self.on_switch is not None:
            self.on_switch()

    def _show_plain(self, robots: Sequence[RobotState]) -> None:
        """Show the records to plain code, as robots with these constants."""
        plain = [as_plain(robot, record) for robot, record in zip(robots, self.records, strict=True)]
        self.plain = self.plain._replace(robots=plain)
        self._bind()

    def _bind(self) -> None:
        """Set the arguments of the stepping core: named tuples, or arrays, as numba passes these fastest."""
        if not self._compiled:
            self._arguments: tuple[Any, ...] = self.plain, self.inputs
            return
        powers = np.array(self.inputs.powers, np.float64).reshape(len(self.inputs.powers), -1)
        self._arguments = (
            *self._arrays,
            self.records,
            self.counters,
            powers,
            TABLE_ARRAYS[bool(self._keys)],
        )

    def _keys_of(self, seed: int) -> tuple[int, ...]:
        """Return the key of each robot's random draws."""
        return tuple(key(seed, "robot", number, "sensors") for number in range(self._scene.n_robots))

    def _draw_by(self, keys: tuple[int, ...]) -> None:
        """Draw at random by the key of each robot, or make no noise without any."""
        self._keys = keys
        for record, number in zip(self.records, self._scene.numbers, strict=True):
            record["noise"] = self.key_words(number)
        self.inputs = self.inputs._replace(tables=TABLES[bool(keys)])
        self._bind()


def plain_advance(simulated: Simulated, inputs: StepInputs, until: int, stops: int) -> int:
    """Run `step.advance`, or `step.switch_on` where `until` is below 0."""
    return step.switch_on(simulated, inputs) if until < 0 else step.advance(simulated, inputs, until, stops)


def _arrays(light: Light) -> tuple[NDArray[np.void], ...]:
    """Return lamps for compiled code."""
    return (
        as_records([light.law], light.law),
        as_records(light.bulbs, Bulb()),
        as_records(light.hidden, Hidden()),
    )
