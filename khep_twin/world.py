"""The world: one scene, its robots, and their common clock.

Time is an integer in nanoseconds. Physics advances in whole steps of 2.5 ms, the bytes on the serial lines
fall between them. Only `World.advance_to` advances time.
"""

import copy
from collections.abc import Sequence
from functools import cache, partial
from threading import RLock
from typing import Protocol

import mujoco
import numpy as np
from numpy.typing import NDArray

from khep_twin import step, units
from khep_twin.board.fault_injection import WHEEL, Fault
from khep_twin.board.turrets import TurretBody
from khep_twin.board.uart import HostEvent, HostEventKind
from khep_twin.clock import to_ns
from khep_twin.copies import NotCopied
from khep_twin.errors import DivergedError, SnapshotError
from khep_twin.khepera4.robot import Khepera4Robot
from khep_twin.khepera_robot import KheperaRobot
from khep_twin.one_thread import one_thread
from khep_twin.playpen import Lamp, Lighting, Playpen, PlaypenLike
from khep_twin.playpen.starts import Start, at_spots
from khep_twin.randomness import position, resume, stream
from khep_twin.robot import Robot, RobotSettings
from khep_twin.sensing.lamps import Lamps
from khep_twin.simulation.mujoco_forms import MujocoForms, SceneModel
from khep_twin.simulation.physics_state import physics_state, set_physics_state
from khep_twin.simulation.simulation import Simulation
from khep_twin.simulation.snapshot_format import pack, unpack
from khep_twin.simulation.stepping_code import SteppingCode
from khep_twin.simulation.world_state import WorldState
from khep_twin.stepper import Stepper

SAMPLE_NS = units.SCAN_NS
"""Sampling period of the observers [ns]."""


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


class World(NotCopied):
    """A simulated playpen.

    The robots are switched on a scan and a step before time 0, so that every register holds a conversion.

    Args:
        playpen: Playpen, or the name or path of one; robots with spots start at a random one. A `SceneModel`
            is compiled already, and may have another step.
        seed: Seed of every random stream.
        noise: True for noisy sensors.
        unpaced: True for lines without delay.
        vary: True to draw each robot at random around its calibration: another one of the same make.
        strict_line: True to garble the bytes between a robot and a host whose line has another speed.
        faults: Faults of its robots.
        compiled: Whether to step by compiled code, with the same results; None to change over to it in a long
            run, once it is compiled.
        shared: True to share the model of a `SceneModel` with other worlds, until a run with `vary`; LEDs are
            not shown then, there are no observers, and `reset` switches the robots on. With faults of wheels
            it has a model of its own.

    Attributes:
        playpen: Playpen with the robots' starts.
        time_ns: Current time [ns].
        timing: Divisions of time.
        simulation: State that the stepping core works on.
        code: Code that steps it.
        model: Compiled scene.
        data: State of the scene.
        lamps: Lamps of the world.
        robots: Robots in the playpen's order.
        observers: Observers of the world.
        guard: Guard of its methods.
    """

    INSTEAD = "another World of the same playpen, and restore(world.snapshot()) in it"

    def __init__(
        self,
        playpen: PlaypenLike | SceneModel,
        *,
        seed: int = 0,
        noise: bool = True,
        vary: bool = False,
        unpaced: bool = False,
        strict_line: bool = False,
        faults: Sequence[Fault] = (),
        compiled: bool | None = None,
        shared: bool = False,
    ) -> None:
        # MuJoCo would write its warnings into a file in the working directory; they are checked here.
        mujoco.set_mju_user_warning(lambda warning: None)
        made, self.guard, self.time_ns = playpen, RLock(), 0
        if not isinstance(made, SceneModel):
            made = SceneModel.of(at_spots(Playpen.load(made), seed))
        self._base, self.spec, self.timing = made.playpen, made.spec, made.timing
        # LEDs and faulty wheels change the model.
        self._shares_model = shared = shared and not any(fault.device == WHEEL for fault in faults)
        if isinstance(playpen, SceneModel) and not shared:
            made = made._replace(model=copy.copy(made.model))
        self.model: mujoco.MjModel = made.model
        self.data = mujoco.MjData(self.model)
        self._forms = MujocoForms(made, self.data, shared)
        self._robot_settings = RobotSettings(unpaced, strict_line, tuple(faults))
        self.simulation = Simulation(self._forms, self.timing)
        self.code = SteppingCode(self.simulation, compiled)
        turrets = any(entry.turrets for entry in self._base.robots)
        stops = step.TICKED if turrets else 0
        if len(self._forms.numbers) < len(self._base.robots):
            stops = step.STEPPED | step.TICKED
        self._stepper = Stepper(self, self.simulation, self.code, stops=stops, shows_leds=not shared)
        self._rewind(seed, noise, vary, None, None)
        if not shared:
            self._stepper.begin(self.robots)

    @one_thread
    def reset(
        self,
        seed: int = 0,
        *,
        noise: bool = True,
        vary: bool = False,
        starts: Sequence[Start] | None = None,
        lamps: Sequence[Lamp] | None = None,
    ) -> None:
        """Start a new run at time 0 in the same scene, without observers; the result is that of a new world.

        Args:
            seed: Seed of every random stream.
            noise: True for noisy sensors.
            vary: True to draw each robot at random around its calibration.
            starts: Start of each robot; by default the playpen's.
            lamps: Other lamps than the playpen's.

        Raises:
            DivergedError: The physics leaves its bounds at once.
        """
        self._rewind(seed, noise, vary, starts, lamps)
        self._stepper.begin(self.robots)

    def _rewind(
        self, seed: int, noise: bool, vary: bool, starts: Sequence[Start] | None, lamps: Sequence[Lamp] | None
    ) -> None:
        """Return to time 0, with the robots not switched on yet; arguments are those of `reset`."""
        forms, simulation = self._forms, self.simulation
        self.observers: list[Observer] = []
        self._untold: list[tuple[int | None, str]] = []
        self._stepper.rewind()
        forms.restore_model()
        simulation.reset(seed, noise=noise, vary=vary)
        self.model = forms.model
        playpen = at_spots(self._base, seed) if starts is None else forms.started(starts)
        forms.reset(playpen)
        self.playpen = playpen if lamps is None else playpen.model_copy(update={"lamps": tuple(lamps)})
        self.lamps = Lamps(self.playpen, cache(partial(stream, seed, "lamps")))
        records = dict(zip(forms.numbers, simulation.records, strict=True))
        self.robots: tuple[Robot, ...] = tuple(
            self._robot(index, seed, records.get(index)) for index in range(len(forms.indices))
        )
        simulation.others = lambda: [robot.disc for robot in self.robots if robot.index not in records]
        simulation.set_lamps(self.lamps, self.playpen.lighting)

    def _robot(self, index: int, seed: int, record: NDArray[np.void] | None) -> Robot:
        """Return a robot with its record in the stepping core, if that runs it."""
        at, settings = self._forms.indices[index], self._robot_settings
        rng = partial(stream, seed, "robot", index)
        if record is not None:
            return KheperaRobot(self, index, at, record, rng, settings)
        return Khepera4Robot(self, index, at, self._forms.drawn(index), rng, settings)

    @property
    def poses(self) -> list[tuple[float, float, float]]:
        """True x, y [m] and heading [rad] of each robot."""
        return [robot.pose for robot in self.robots]

    @property
    def objects(self) -> NDArray[np.float64]:
        """Positions x, y [m] and headings [rad] of the movable objects, in the playpen's order (n, 3)."""
        return self._forms.objects

    def turret_bodies(self, name: str) -> list[TurretBody | None]:
        """Return the bodies of all turrets of a kind, by the index of their robot; None for one without."""
        return [robot.turret_bodies.get(name) for robot in self.robots]

    def add_observer(self, observer: Observer, *, at_once: bool = True) -> None:
        """Add an observer.

        Args:
            observer: Observer.
            at_once: Whether it receives the current state, with what it missed; or has it already.

        Raises:
            ValueError: The world shares its model.
        """
        if self._shares_model:
            raise ValueError("the world shares its model; expected one of its own, as of an observed Episode")
        self.observers.append(observer)
        if not at_once:
            return
        for robot, text in self._untold:
            observer.on_event(self.time_ns, robot, text)
        mujoco.mj_kinematics(self.model, self.data)
        for each in self.robots:
            each.refresh()
        observer.sample(self)

    def advance_to(self, time_ns: int) -> None:
        """Advance the world to `time_ns` [ns].

        Each step of 2.5 ms runs in this order:

            1. bytes that arrive before its end are read by the firmware, which answers from the registers
               of the last step
            2. the step itself, in the order of `khep_twin.step`; after its physics lamps blink, fade and
               switch, and after its control tick the turrets act
            3. after every eighth step the observers sample the world

        Raises:
            ValueError: `time_ns` is in the past.
            DivergedError: The physics left its bounds, now or before.
        """
        self._stepper.advance_to(time_ns)

    def advance(self, seconds: float) -> None:
        """Advance the world by a time [s], to the nearest ns; errors are those of `advance_to`."""
        self.advance_to(self.time_ns + to_ns(seconds))

    def step(self, n_steps: int = 1) -> None:
        """Advance the world to the end of the present step, or of some steps, as `advance_to` does."""
        self.advance_to((self.simulation.steps + n_steps) * self.timing.step_ns)

    @one_thread
    def finish_steps(self, reason: int, until: int) -> None:
        """Act for a return of the stepping core that was not called here, and run on to a step.

        Raises:
            DivergedError: The physics left its bounds.
        """
        self._stepper.finish_steps(reason, until)

    @property
    def is_self_contained(self) -> bool:
        """True if nothing outside the stepping core acts amid a run: no turret, LED, fault or observer."""
        return self._stepper.is_self_contained

    @one_thread
    def scan(self) -> None:
        """Convert all sensors of all robots now, without advancing time."""
        for look in (mujoco.mj_kinematics, mujoco.mj_comPos, mujoco.mj_camlight):
            look(self.model, self.data)
        self.simulation.scan(self.simulation.steps)
        for robot in self.robots:
            robot.scan()

    def snapshot(self) -> bytes:
        """Return the whole state of the world, without its observers, for `restore`.

        Raises:
            ValueError: A step has begun and not ended.
        """
        return pack(self.state(), self.scene)

    def restore(self, snapshot: bytes) -> None:
        """Go on from a snapshot, bit for bit as the world that it was taken of; observers stay.

        Any world of the same playpen can do so, if its robots were drawn by the same seed with `vary`, and
        its line and faults are the same.

        Raises:
            SnapshotError: The bytes are no snapshot, or of another version or scene; after a damaged one the
                world needs a `reset`.
        """
        self.set_state(unpack(snapshot, WorldState, self.scene))

    @property
    def scene(self) -> str:
        """Fingerprint of the compiled scene with its robots, in hexadecimal digits."""
        return self._forms.fingerprint

    @property
    def is_between_steps(self) -> bool:
        """True if no step has begun without having ended, so that the state is whole."""
        return bool(self.simulation.counters[step.PHASE] == step.DONE)

    @one_thread
    def state(self, since_ns: int = -1) -> WorldState:
        """Return the whole state, with the replies that reach a host after a time [ns].

        Raises:
            ValueError: A step has begun and not ended.
        """
        if not self.is_between_steps and self._stepper.failure is None:
            raise ValueError("no state amid a step; expected it between steps, as observers sample them")
        return WorldState(
            self.time_ns,
            physics_state(self.model, self.data),
            self.simulation.state(),
            tuple(robot.state(since_ns) for robot in self.robots),
            self.playpen.lamps,
            self.playpen.lighting,
            self.lamps.state(),
            position(self.lamps.rng()),
            tuple(self._untold),
            "" if self._stepper.failure is None else str(self._stepper.failure),
        )

    @one_thread
    def set_state(self, state: WorldState) -> None:
        """Take over a state.

        Raises:
            SnapshotError: It does not fit the world, which then needs a `reset`.
        """
        try:
            self._stepper.set_state(state)
            # After the robots: faulty wheels change the model, and the motion when they begin.
            set_physics_state(self.model, self.data, state.physics)
            self.playpen = self.playpen.model_copy(update={"lamps": state.lamps, "lighting": state.lighting})
            self.lamps = Lamps(self.playpen, self.lamps.rng, self.time_ns)
            self.lamps.set_state(state.lamps_state)
            resume(self.lamps.rng(), state.lamps_stream)
        except ValueError as error:
            self._stepper.failure = DivergedError(f"the world could not be restored: {error}")
            raise SnapshotError(f"the snapshot does not fit the world: {error}") from None
        self.simulation.set_lamps(self.lamps, self.playpen.lighting)
        self._untold = list(state.untold)

    def reseed(self, seed: int) -> None:
        """Draw from the random streams of another seed from now on."""
        self.simulation.reseed(seed)
        self.lamps.rng = cache(partial(stream, seed, "lamps"))
        for index, robot in enumerate(self.robots):
            robot.reseed(partial(stream, seed, "robot", index))

    @one_thread
    def set_lamps(
        self, lamps: Sequence[Lamp], lighting: Lighting | None = None, *, keep_switched: bool = False
    ) -> None:
        """Replace the lamps.

        Args:
            lamps: All lamps from now on.
            lighting: Their lighting; None for the present one.
            keep_switched: True to switch them as the present ones are.
        """
        lit = {"lamps": tuple(lamps), "lighting": lighting or self.playpen.lighting}
        self.playpen, before = self.playpen.model_copy(update=lit), self.lamps
        self.lamps = Lamps(self.playpen, before.rng, self.time_ns, before.phase)
        if keep_switched:
            self.lamps.take_over(before)
        self.simulation.set_lamps(self.lamps, self.playpen.lighting)

    def refresh(self) -> None:
        """Take over fixed geoms that were moved in the model, which no other world may share."""
        self._forms.refresh()
        self.simulation.take_scene()
        for robot in self.robots:
            robot.fit_turrets()
        self.simulation.set_lamps(self.lamps, self.playpen.lighting)

    def compile(self) -> None:
        """Step by compiled code from now on, with the same results: see `SteppingCode.compile`."""
        self.code.compile()

    def log_event(self, robot: int | None, text: str) -> None:
        """Log an event that does not follow from the state, such as an action of yours; logs repeat it.

        Args:
            robot: Index of the robot that it is about; None for none.
            text: Words of it.
        """
        data = bytes([robot is None]) + text.encode("utf-8")
        self.on_host_event(robot or 0, HostEvent(HostEventKind.NOTE, self.time_ns, None, data))
        self.on_event(robot, text)

    def on_event(self, robot: int | None, text: str) -> None:
        """Send an event that follows from the state to the observers."""
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

    def sample(self) -> None:
        """Let the observers sample the world."""
        if self.observers:
            # A step leaves the bodies' positions as of its start; the observers sample them as of its end.
            mujoco.mj_kinematics(self.model, self.data)
            for robot in self.robots:
                robot.refresh()
            for observer in self.observers:
                observer.sample(self)
