"""The world: one scene, its robots, and their common clock.

Time is an integer in nanoseconds. Physics advances in steps of 2.5 ms; bytes on the serial lines arrive
between steps. Only `World.advance_to` advances time.
"""

import copy
from collections.abc import Callable, Sequence
from functools import cache, partial
from threading import RLock
from typing import cast

import mujoco
import numpy as np
from numpy.typing import NDArray

from khep_twin import step
from khep_twin.board.fault_injection import WHEEL, Fault
from khep_twin.board.turrets import TurretBody
from khep_twin.board.uart import HostEvent, HostEventKind
from khep_twin.clock import to_ns
from khep_twin.copies import NotCopied
from khep_twin.errors import DivergedError, SnapshotError
from khep_twin.observers import Observer, Observers
from khep_twin.playpen import Lamp, Lighting, Playpen, PlaypenLike
from khep_twin.playpen.starts import Start, at_spots
from khep_twin.process.one_thread import one_thread, second_thread_error
from khep_twin.randomness import position, resume, stream
from khep_twin.renamed import renamed_arguments
from khep_twin.robots.robot import Robot, RobotSetup
from khep_twin.sensing.lamps import Lamps
from khep_twin.sensing.simulated import PHASE
from khep_twin.simulation.moments import Moments
from khep_twin.simulation.mujoco_forms import MujocoForms, SceneModel
from khep_twin.simulation.physics_state import physics_state, set_physics_state
from khep_twin.simulation.simulation import Simulation
from khep_twin.simulation.snapshot_format import pack, unpack
from khep_twin.simulation.stepping_code import SteppingCode
from khep_twin.simulation.world_state import WorldState
from khep_twin.stepper import Stepper


class World(NotCopied):
    """A simulated playpen.

    The robots are switched on one scan and one step before time 0, so that all registers are filled.

    Args:
        playpen: Playpen, its name or path; robots with spots start at a random one. A `SceneModel` is already
            compiled, and may have another step.
        seed: Seed of every random stream.
        noise: True for noisy sensors, or a scale of their noise.
        unpaced: True for lines without delay.
        vary: True to draw each robot's parameters at random around its calibration.
        strict_line: True to garble the bytes between a robot and a host with different baud rates.
        faults: Faults of the robots.
        compiled: Whether to run compiled, with the same results; None to switch to it in a long run, once it
            is compiled.
        shared: True to share the model of a `SceneModel` with other worlds, until a run with `vary`. Such a
            world shows no LEDs, accepts no observers, and only `reset` switches its robots on. A world with
            faults of wheels never shares its model.

    Attributes:
        playpen: Playpen with the robots' starts.
        timing: Durations in steps.
        simulation: State of the stepping core.
        code: Code that runs it, plain or compiled.
        model: Compiled scene.
        data: State of the scene.
        lamps: Lamps of the world.
        robots: Robots in the playpen's order.
        observers: Observers of the world.
        guard: Lock of its methods.
    """

    COPY_ADVICE = "another World of the same playpen, and restore(world.snapshot()) in it"

    def __init__(
        self,
        playpen: PlaypenLike | SceneModel,
        *,
        seed: int = 0,
        noise: float = True,
        vary: bool = False,
        unpaced: bool = False,
        strict_line: bool = False,
        faults: Sequence[Fault] = (),
        compiled: bool | None = None,
        shared: bool = False,
    ) -> None:
        # Prevents MuJoCo from writing warnings into a file; `Stepper` checks for them.
        mujoco.set_mju_user_warning(lambda warning: None)
        scene_model, self.guard = playpen, RLock()
        if not isinstance(scene_model, SceneModel):
            scene_model = SceneModel.of(at_spots(Playpen.load(scene_model), seed))
        self._base_playpen = scene_model.playpen
        self.spec = scene_model.spec
        self.timing = scene_model.timing
        # LEDs and faulty wheels change the model.
        self._shares_model = shared = shared and not any(fault.device == WHEEL for fault in faults)
        if isinstance(playpen, SceneModel) and not shared:
            scene_model = scene_model._replace(model=copy.copy(scene_model.model))
        self.model: mujoco.MjModel = scene_model.model
        self.data = mujoco.MjData(self.model)
        self._forms = MujocoForms(scene_model, self.data, shared)
        self._make_setup = partial(
            RobotSetup, self, unpaced=unpaced, strict_line=strict_line, faults=tuple(faults)
        )
        self.simulation = Simulation(self._forms, self.timing)
        self.code = SteppingCode(self.simulation, compiled)
        has_turrets = any(entry.turrets for entry in self._base_playpen.robots)
        stops = int(step.Stop.TICKED) if has_turrets else 0
        self._stepper = Stepper(self.simulation, self.code, stops=stops, shows_leds=not shared)
        self._rewind(seed, noise, vary, starts=None, lamps=None)
        if not shared:
            self._stepper.begin(self.robots)

    @one_thread
    def reset(
        self,
        seed: int = 0,
        *,
        noise: float = True,
        vary: bool = False,
        starts: Sequence[Start] | None = None,
        lamps: Sequence[Lamp] | None = None,
    ) -> None:
        """Start a new run at time 0 in the same scene, without observers, with the results of a new world.

        Args:
            seed: Seed of every random stream.
            noise: True for noisy sensors, or a scale of their noise.
            vary: True to draw each robot's parameters at random around its calibration.
            starts: Start of each robot; by default the playpen's.
            lamps: Lamps that replace those of the playpen.

        Raises:
            ValueError: The noise is out of range.
            DivergedError: The physics leaves its bounds at the start.
        """
        self._rewind(seed, noise, vary, starts, lamps)
        self._stepper.begin(self.robots)

    def _rewind(
        self,
        seed: int,
        noise: float,
        vary: bool,
        starts: Sequence[Start] | None,
        lamps: Sequence[Lamp] | None,
    ) -> None:
        """Return to time 0, with the robots switched off; arguments are those of `reset`."""
        forms, simulation = self._forms, self.simulation
        self.observers = Observers(self)
        self._stepper.rewind(self.observers)
        forms.restore_model()
        simulation.reset(seed, noise=noise, vary=vary)
        self.model = forms.model
        playpen = at_spots(self._base_playpen, seed) if starts is None else forms.with_starts(starts)
        forms.reset(playpen)
        self.playpen = playpen if lamps is None else playpen.model_copy(update={"lamps": tuple(lamps)})
        self.lamps = Lamps(self.playpen, cache(partial(stream, seed, "lamps")))
        self.robots: tuple[Robot, ...] = tuple(
            self._make_robot(index, seed) for index in range(len(forms.indices))
        )
        self._apply_lamps()

    def _apply_lamps(self) -> None:
        """Pass the lamps to the stepping core."""
        if self._forms.reserve_lamps(len(self.playpen.lamps)):
            self.simulation.refresh_scene()
        self.simulation.set_lamps(self.lamps, self.playpen.lighting)

    def _make_robot(self, index: int, seed: int) -> Robot:
        """Return a robot."""
        model = self._base_playpen.robots[index].robot_model
        make = cast(Callable[[RobotSetup], Robot], model.load_class("robot", Robot))
        rng = partial(stream, seed, "robot", index)
        return make(self._make_setup(index=index, indices=self._forms.indices[index], make_rng=rng))

    @property
    def time_ns(self) -> int:
        """Current time [ns]."""
        return self._stepper.time_ns

    @property
    def poses(self) -> list[tuple[float, float, float]]:
        """True x, y [m] and heading [rad] of each robot."""
        return [robot.pose for robot in self.robots]

    @property
    def objects(self) -> NDArray[np.float64]:
        """Positions x, y [m] and headings [rad] of the movable objects, in the playpen's order (n, 3)."""
        return self._forms.objects

    @property
    def moments(self) -> Moments:
        """Moments that robots have recorded."""
        return self._forms.moments

    def turret_bodies(self, name: str) -> list[TurretBody | None]:
        """Return the turrets of a kind by the index of their robot; None for a robot without one."""
        return [robot.turret_bodies.get(name) for robot in self.robots]

    @renamed_arguments(at_once="sample_now")
    def add_observer(self, observer: Observer, *, sample_now: bool = True) -> None:
        """Add an observer.

        Args:
            observer: Observer.
            sample_now: Whether to send it the events at time 0 and a sample of the current state.

        Raises:
            ValueError: The world shares its model.
        """
        if self._shares_model:
            raise ValueError("the world shares its model; expected one of its own, as of an observed Episode")
        self.observers.append(observer)
        if sample_now:
            for robot, text in self.observers.early_events:
                observer.on_event(self.time_ns, robot, text)
            self.observers.sample(observer)

    def advance_to(self, time_ns: int) -> None:
        """Advance the world to `time_ns` [ns].

        Each step of 2.5 ms runs in this order:

            1. the firmware reads bytes that arrive before the end of the step, and answers from the registers
               of the previous step
            2. the step, in the order of `khep_twin.step`; lamps blink, fade and switch after its physics,
               turrets act after its control tick
            3. after every eighth step the observers sample the world

        Raises:
            ValueError: `time_ns` is in the past.
            DivergedError: The physics left its bounds, in this call or an earlier one.
        """
        # Like `one_thread`, but faster, as each read and write of a host calls it.
        if not self.guard.acquire(False):
            raise second_thread_error(self, "advance_to")
        try:
            self._stepper.advance_to(time_ns)
        finally:
            self.guard.release()

    def advance(self, seconds: float) -> None:
        """Advance the world by a time [s], to the nearest ns; errors are those of `advance_to`."""
        self.advance_to(self.time_ns + to_ns(seconds))

    def step(self, n_steps: int = 1) -> None:
        """Advance the world by a number of steps, the current one included, as `advance_to` does."""
        self.advance_to((self.simulation.steps + n_steps) * self.timing.step_ns)

    @one_thread
    def finish_steps(self, reason: int, end_step: int) -> None:
        """Handle a return of the stepping core, which another object has called, and run up to a step.

        Raises:
            DivergedError: The physics left its bounds.
        """
        self._stepper.finish_steps(reason, end_step)

    @property
    def is_self_contained(self) -> bool:
        """True if no turret, LED, fault or observer acts within a run of the stepping core."""
        return self._stepper.is_self_contained

    @one_thread
    def scan(self) -> None:
        """Convert all sensors of all robots now, without advancing time."""
        for update in (mujoco.mj_kinematics, mujoco.mj_comPos, mujoco.mj_camlight):
            update(self.model, self.data)
        self.simulation.scan()

    def snapshot(self) -> bytes:
        """Return the complete state of the world, without its observers, for `restore`.

        Raises:
            ValueError: The world is within a step.
        """
        return pack(self.state(), self.scene)

    def restore(self, snapshot: bytes) -> None:
        """Restore a snapshot and continue bitwise like the world that it is from; observers remain.

        The snapshot may be from any world of the same playpen, line and faults, and with `vary` of the same
        seed.

        Raises:
            SnapshotError: The bytes are no snapshot, or one of another version or scene. After a damaged one,
                the world needs a `reset`.
        """
        self.set_state(unpack(snapshot, WorldState, self.scene))

    @property
    def scene(self) -> str:
        """Fingerprint of the compiled scene with its robots, in hexadecimal digits."""
        return self._forms.fingerprint

    @property
    def is_between_steps(self) -> bool:
        """True if the world is not within a step, so that its state is complete."""
        return bool(self.simulation.counters[PHASE] == step.Phase.DONE)

    @one_thread
    def state(self, since_ns: int = -1) -> WorldState:
        """Return the complete state, with the replies that reach a host after a time [ns].

        Raises:
            ValueError: The world is within a step.
        """
        if not self.is_between_steps and self._stepper.failure is None:
            raise ValueError("no state within a step; expected a call between steps, when observers sample")
        return WorldState(
            self.time_ns,
            physics_state(self.model, self.data),
            self.simulation.state(),
            tuple(robot.state(since_ns) for robot in self.robots),
            self.playpen.lamps,
            self.playpen.lighting,
            self.lamps.state(),
            position(self.lamps.make_rng()),
            tuple(self.observers.early_events),
            "" if self._stepper.failure is None else str(self._stepper.failure),
        )

    @one_thread
    def set_state(self, state: WorldState) -> None:
        """Restore a state.

        Raises:
            SnapshotError: It does not fit the world, which then needs a `reset`.
        """
        try:
            self._stepper.set_state(state)
            # After the robots: the start of a wheel's fault changes the model and the motion.
            set_physics_state(self.model, self.data, state.physics, has_diverged=bool(state.failure))
            self.playpen = self.playpen.model_copy(update={"lamps": state.lamps, "lighting": state.lighting})
            self.lamps = Lamps(self.playpen, self.lamps.make_rng, self.time_ns)
            self.lamps.set_state(state.lamps_state)
            resume(self.lamps.make_rng(), state.lamps_stream)
        except ValueError as error:
            self._stepper.failure = DivergedError(f"the world could not be restored: {error}")
            raise SnapshotError(f"the snapshot does not fit the world: {error}") from None
        self._apply_lamps()
        self.observers.early_events = list(state.pending_events)

    def reseed(self, seed: int) -> None:
        """Switch to the random streams of another seed."""
        self.observers.evaluate()
        self.simulation.reseed(seed)
        self.lamps.make_rng = cache(partial(stream, seed, "lamps"))
        for index, robot in enumerate(self.robots):
            robot.reseed(partial(stream, seed, "robot", index))

    @one_thread
    def set_lamps(
        self, lamps: Sequence[Lamp], lighting: Lighting | None = None, *, keep_switched: bool = False
    ) -> None:
        """Replace the lamps.

        Args:
            lamps: New lamps.
            lighting: New lighting; None for the current one.
            keep_switched: True to keep the switching state of the current lamps.
        """
        self.observers.evaluate()
        changes = {"lamps": tuple(lamps), "lighting": lighting or self.playpen.lighting}
        self.playpen, previous = self.playpen.model_copy(update=changes), self.lamps
        self.lamps = Lamps(self.playpen, previous.make_rng, self.time_ns, previous.flicker_phase)
        if keep_switched:
            self.lamps.continue_from(previous)
        self._apply_lamps()

    def refresh(self) -> None:
        """Update the scene after fixed geoms were moved in the model, which no other world may share."""
        self._forms.refresh()
        self.simulation.refresh_scene()
        for robot in self.robots:
            robot.fit_turrets()
        self._apply_lamps()

    def compile(self) -> None:
        """Switch to compiled code, with the same results: see `SteppingCode.compile`."""
        self.code.compile()

    def log_event(self, robot: int | None, text: str) -> None:
        """Log an event that does not follow from the state, such as a user's action; replays repeat it.

        Args:
            robot: Index of the robot concerned; None for none.
            text: Description of the event.
        """
        data = bytes([robot is None]) + text.encode("utf-8")
        self.observers.on_host_event(robot or 0, HostEvent(HostEventKind.NOTE, self.time_ns, None, data))
        self.observers.on_event(robot, text)
