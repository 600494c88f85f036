"""The world: one scene, its robots, and their common clock.

Time is an integer in nanoseconds. Physics advances in whole steps of 2.5 ms, the bytes on the serial lines
fall between them. Only `World.advance_to` advances time.
"""

import math
from collections.abc import Sequence
from typing import Protocol

import mujoco
import numpy as np
from numpy.typing import NDArray

from khep_twin import units
from khep_twin.board.fault_injection import Fault
from khep_twin.board.uart import HostEvent
from khep_twin.clock import n_steps
from khep_twin.errors import DivergedError
from khep_twin.playpen import Playpen
from khep_twin.playpen.starts import at_spots
from khep_twin.playpen_to_mjcf import to_spec
from khep_twin.randomness import stream
from khep_twin.robot import Robot
from khep_twin.sensing.lamps import Lamps

SAMPLE_NS = units.SCAN_NS
"""Sampling period of the observers [ns]."""

_STEPS_PER_TICK = n_steps(units.TICK_NS, units.STEP_NS)
_STEPS_PER_SAMPLE = n_steps(SAMPLE_NS, units.STEP_NS)
_FASTEST = 1000.0
"""Highest speed of a joint in a playpen [m/s or rad/s]; beyond it the simulation has diverged."""


class Observer(Protocol):
    """Observer of a world, such as a recorder; a subclass ignores what it does not define."""

    def sample(self, world: "World") -> None:
        """Observe the world; called every SAMPLE_NS and at its start."""

    def on_bytes(self, time_ns: int, robot: int, to_robot: bool, data: bytes) -> None:
        """Observe bytes that crossed a robot's line, the last of them at `time_ns`."""

    def on_host_event(self, time_ns: int, robot: int, event: HostEvent) -> None:
        """Observe an action of a robot's host on the line."""

    def on_event(self, time_ns: int, robot: int | None, text: str) -> None:
        """Observe a logged event."""


class World:
    """A simulated playpen.

    The robots are switched on a scan and a step before time 0, so that every register holds a conversion.

    Args:
        playpen: Scene; robots with spots start at a random one.
        seed: Seed of every random stream.
        noise: True for noisy sensors.
        unpaced: True for lines without delay.
        vary: True to draw each robot's sensors at random around its calibration.
        strict_line: True to garble the bytes between a robot and a host whose line has another speed.
        faults: Faults of its robots.

    Attributes:
        time_ns: Current time [ns].
        model: Compiled scene.
        data: State of the scene.
        lamps: Lamps of the world.
        robots: Robots in the playpen's order.
        observers: Observers of the world.
    """

    def __init__(
        self,
        playpen: Playpen,
        *,
        seed: int = 0,
        noise: bool = True,
        vary: bool = False,
        unpaced: bool = False,
        strict_line: bool = False,
        faults: Sequence[Fault] = (),
    ) -> None:
        # MuJoCo would write its warnings into a file in the working directory; they are checked here.
        mujoco.set_mju_user_warning(keep_quiet)
        self.playpen = playpen = at_spots(playpen, seed)
        self.observers: list[Observer] = []
        self._untold: list[tuple[int | None, str]] = []
        self.time_ns = 0
        self.spec = to_spec(playpen)
        self.model = self.spec.compile()
        self.data = mujoco.MjData(self.model)
        self._lamp_chance = stream(seed, "lamps")
        self.lamps = Lamps(playpen, self._lamp_chance)
        self.robots = tuple(
            Robot(
                self,
                index,
                seed=seed,
                noise=noise,
                vary=vary,
                unpaced=unpaced,
                strict_line=strict_line,
                faults=faults,
            )
            for index in range(len(playpen.robots))
        )
        self._steps = 0
        self._failure: DivergedError | None = None
        self._warnings: NDArray[np.int32] = self.data.warning.number
        self._places = self.data.xpos.ravel()
        self._limit = 1.0 + max(units.metres(playpen.arena.width_mm), units.metres(playpen.arena.height_mm))
        self._switch_on()

    def add_observer(self, observer: Observer) -> None:
        """Add an observer; it receives the current state at once."""
        self.observers.append(observer)
        for robot, text in self._untold:
            observer.on_event(self.time_ns, robot, text)
        mujoco.mj_kinematics(self.model, self.data)
        observer.sample(self)

    def advance_to(self, time_ns: int) -> None:
        """Advance the world to `time_ns` [ns].

        Each step of 2.5 ms runs in this order:

            1. bytes that arrive before its end are read by the firmware, which answers from the registers
               of the last step
            2. physics, with the motor voltages of the last control tick
            3. lamps blink, fade and switch; one sensor of each robot is converted, as of the pose at the
               step's start
            4. after every fourth step the control tick: encoders, speed, controllers, duty, voltage
            5. after every eighth the supply is measured and the observers sample the world

        Raises:
            ValueError: `time_ns` is in the past.
            DivergedError: The physics left its bounds, now or before.
        """
        if self._failure is not None:
            raise self._failure
        if time_ns < self.time_ns:
            raise ValueError(f"time cannot go back from {self.time_ns} to {time_ns} ns")
        while (end_ns := (self._steps + 1) * units.STEP_NS) <= time_ns:
            self._exchange(end_ns)
            self.time_ns = end_ns
            self._step()
        self._exchange(time_ns)
        self.time_ns = time_ns

    def scan(self) -> None:
        """Convert all sensors of all robots now, without advancing time."""
        model, data = self.model, self.data
        # The rangefinders take turns; here all measure at the same time, and keep their turns afterwards.
        turns, history = model.sensor_interval.copy(), data.history.copy()
        model.sensor_interval[:] = 0
        for look in (mujoco.mj_kinematics, mujoco.mj_comPos, mujoco.mj_camlight, mujoco.mj_sensorPos):
            look(model, data)
        model.sensor_interval[:], data.history[:] = turns, history
        for turn in range(units.N_SENSORS):
            for robot in self.robots:
                robot.convert((self._steps + turn) % units.N_SENSORS)

    def relight(self, playpen: Playpen) -> None:
        """Take the lamps and the lighting of another playpen."""
        self.playpen = playpen
        self.lamps = Lamps(playpen, self._lamp_chance, self.time_ns)
        for robot in self.robots:
            robot.relight(self.lamps, playpen.lighting)

    def log_event(self, robot: int | None, text: str) -> None:
        """Send an event to the observers."""
        if self.time_ns == 0 and not self.observers:
            # No observer could be added yet.
            self._untold.append((robot, text))
        for observer in self.observers:
            observer.on_event(self.time_ns, robot, text)

    def on_bytes(self, time_ns: int, robot: int, to_robot: bool, data: bytes) -> None:
        """Send bytes that crossed a robot's line to the observers."""
        for observer in self.observers:
            observer.on_bytes(time_ns, robot, to_robot, data)

    def on_host_event(self, robot: int, event: HostEvent) -> None:
        """Send a host's action to the observers."""
        for observer in self.observers:
            observer.on_host_event(self.time_ns, robot, event)

    def _switch_on(self) -> None:
        # The rangefinders' first turn comes in the second step.
        mujoco.mj_step(self.model, self.data)
        for channel in range(units.N_SENSORS):
            mujoco.mj_step(self.model, self.data)
            for robot in self.robots:
                robot.convert(channel)
        for robot in self.robots:
            robot.zero_encoders()
            robot.update_supply()
        self._check_state()
        self._check_warnings()

    def _exchange(self, time_ns: int) -> None:
        for robot in self.robots:
            if (next_ns := robot.uart.rx.next_ns) is not None and next_ns <= time_ns:
                robot.exchange(time_ns)

    def _step(self) -> None:
        channel = self._steps % units.N_SENSORS
        mujoco.mj_step(self.model, self.data)
        self._steps += 1
        if not self.lamps.steady:
            self._light()
        for robot in self.robots:
            robot.convert(channel)
        if self._steps % _STEPS_PER_TICK == 0:
            self._check_state()
            for robot in self.robots:
                robot.tick()
        if self._steps % _STEPS_PER_SAMPLE == 0:
            self._check_warnings()
            for robot in self.robots:
                robot.update_supply()
                robot.show_leds()
            self._show()

    def _light(self) -> None:
        if self.lamps.update(self.time_ns, [robot.disc for robot in self.robots]):
            self.log_event(None, f"{self.lamps.names[self.lamps.lit or 0]} is on")

    def _show(self) -> None:
        if self.observers:
            # A step leaves the bodies' positions as of its start; the observers sample them as of its end.
            mujoco.mj_kinematics(self.model, self.data)
            for observer in self.observers:
                observer.sample(self)

    def _check_warnings(self) -> None:
        """Raise a `DivergedError` if MuJoCo has warned."""
        if self._warnings.any():
            kind = mujoco.mjtWarning(int(np.flatnonzero(self._warnings)[0])).name
            raise self._diverged(f"MuJoCo warns of {kind}")

    def _check_state(self) -> None:
        """Raise a `DivergedError` if the state is out of bounds."""
        # Sums of squares are the fastest check that also finds NaN.
        places, speeds, joints = self._places, self.data.qvel, self.data.qpos
        fits = places.dot(places) <= len(places) * self._limit**2
        if not (fits and speeds.dot(speeds) <= len(speeds) * _FASTEST**2 and joints.dot(joints) < math.inf):
            raise self._diverged(
                f"something is {np.abs(places).max():g} m off, at {np.abs(speeds).max():g} m/s or rad/s"
            )

    def _diverged(self, reason: str) -> DivergedError:
        text = f"the simulation failed at {self.time_ns / 1e9:.4f} s, step {self._steps}: {reason}"
        self.log_event(None, text)
        self._failure = DivergedError(text)
        return self._failure


def keep_quiet(warning: str) -> None:
    """Ignore a warning, which the check of MuJoCo's counters finds."""
