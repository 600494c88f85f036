"""One episode of a playpen's robots, without a serial line.

    setup = EpisodeSetup(Playpen.load("obstacles"))
    episode = Episode(setup, Braitenberg())
    episode.begin(seed=1)
    episode.run(60.0)
    print(episode.pose, episode.metrics())

For the same seed, sensor counts, registers and positions equal those of a `World` whose robots receive the
same speeds at the same times over lines without delay, compiled or not, after any earlier episodes.

With `EpisodeSetup(..., planar=True)` the robot moves in a plane (`planar`), for screening: with the same
firmware and sensors, at least thirty times faster, and with similar trajectories.
"""

import warnings
from collections.abc import Sequence
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from khep_twin.copies import NotCopied
from khep_twin.episodes import stepping
from khep_twin.episodes.contacts import in_contact
from khep_twin.episodes.controllers import (
    ConstantSpeed,
    Driver,
    Floats,
    board_shape,
    make_controllers,
    readings_of,
    terms_of,
)
from khep_twin.episodes.episode_options import DEFAULT_OPTIONS, EpisodeOptions
from khep_twin.episodes.episode_setup import EpisodeSetup
from khep_twin.episodes.line import NEVER
from khep_twin.episodes.metrics import compute_metrics
from khep_twin.episodes.planar.planar_world import PlanarWorld
from khep_twin.episodes.turret_link import TurretLink
from khep_twin.errors import DivergedError
from khep_twin.playpen import Playpen
from khep_twin.playpen.checks import require_feature
from khep_twin.playpen.starts import Start
from khep_twin.process.one_thread import one_thread
from khep_twin.robots.core import update_registers
from khep_twin.robots.model import Feature, robot_name
from khep_twin.simulation.ready import find_missing_numba, function_of, part_of, when_ready
from khep_twin.world import World

_CHECK_INTERVAL = 2000
"""Steps between two checks whether compiled code is ready."""


class SlowerWarning(UserWarning):
    """Warning that episodes run uncompiled, with the same results, as numba is missing or disabled."""


def is_compiled(requested: bool | None) -> bool:
    """Return whether episodes run compiled; None means if numba is installed, with a warning if not."""
    if requested is not None:
        return requested
    if (missing := find_missing_numba()) is None:
        return True
    warnings.warn(
        f"{missing.reason}: episodes run uncompiled, many times slower, with the same results; "
        f"{missing.remedy}",
        SlowerWarning,
        stacklevel=3,
    )
    return False


class Episode(NotCopied):
    """An episode; `begin` starts a new one in the same memory.

    Args:
        setup: Setup of the episodes.
        driver: Controller of the robots; a policy is left to the caller.
        compiled: Whether to run compiled; None to run compiled once the code is ready, if numba is installed.
        observed: Whether the episode's world may have observers; then it does not share its model.

    Attributes:
        boards: Registers of each robot (n_robots, n_registers); some models update them when they are read.
        registers: Registers of the first robot (n_registers,).
        shape: Numbers of robots, of their registers with readings of turrets, and of speeds with commands.
        guard: Lock of its methods, shared with its world.
    """

    COPY_ADVICE = "another Episode of the same setup, started with the same seed"

    def __init__(
        self,
        setup: EpisodeSetup,
        driver: Driver | None = None,
        *,
        compiled: bool | None = None,
        observed: bool = False,
    ) -> None:
        self._setup = setup
        self._driver = driver or ConstantSpeed()
        kind = "episodes" if setup.planar_scene is None else "plane"
        self._code_name = part_of(kind, [setup.core.name])
        self._check_step = None
        run: stepping.Run | None = None
        if compiled:
            run = function_of(self._code_name)
        elif compiled is None and is_compiled(None):
            run = when_ready(self._code_name)
            self._check_step = 0 if run is None else None
        self._run: stepping.Run = run or stepping.run
        self._compiled = run is not None
        self._world: World | PlanarWorld
        if setup.planar_scene is None:
            self._world = World(
                setup.scene_model, unpaced=True, faults=setup.faults, compiled=False, shared=not observed
            )
        else:
            self._world = PlanarWorld(setup.scene_model, setup.planar_scene)
        self.guard = self._world.guard
        self._simulation = self._world.simulation
        self._simulation.step_with(self._advance, self._compiled)
        self.boards: NDArray[np.int64] = self._simulation.robots.records[0]["registers"]
        self.registers: NDArray[np.int64] = self.boards[0]
        self._has_started = False
        self.shape = len(self.boards), *board_shape(self._driver, setup)
        self._lamps = DEFAULT_OPTIONS.lamps

    @one_thread
    def begin(self, seed: int = 0, options: EpisodeOptions = DEFAULT_OPTIONS) -> None:
        """Start an episode.

        Args:
            seed: Seed of every random stream.
            options: Options of the episode.

        Raises:
            ControllerError: The genes do not fit the controller.
            DivergedError: The physics leaves its bounds at the start.
        """
        self._genes = np.asarray(options.genes, np.float64)
        self._home = np.array(options.home_in_metres, np.float64)
        self._line = options.line
        if isinstance(self._line, int):
            require_feature(self._setup.playpen, Feature.LINE)
        self._lamps = options.lamps
        if self._check_step is not None:
            self._use_compiled_if_ready()
        self._controllers = self._new_controllers()
        self._turrets = TurretLink(self._driver, self._line, self._setup)
        starts = None if options.start is None else _check_starts(options.start, len(self.boards))
        self._simulation.terms = terms_of(self._driver)
        self._simulation.title = f"episode of seed {seed}"
        self._world.reset(seed, noise=options.noise, vary=options.vary, starts=starts, lamps=options.lamps)
        self._has_started = True
        if isinstance(self._driver, ConstantSpeed) and (self._driver.left or self._driver.right):
            for robot in range(len(self.boards)):
                self.drive(self._driver.left, self._driver.right, robot)

    @property
    def setup(self) -> EpisodeSetup:
        """Setup of the episodes."""
        return self._setup

    @property
    def playpen(self) -> Playpen:
        """Playpen with the lamps of the episode; `poses` has the current poses of the robots."""
        playpen = self._setup.playpen
        return playpen if self._lamps is None else playpen.model_copy(update={"lamps": tuple(self._lamps)})

    @property
    def world(self) -> World:
        """World of the episode, for observers and for MuJoCo's state.

        Raises:
            ValueError: The episode is in a plane.
        """
        if isinstance(self._world, PlanarWorld):
            raise ValueError(
                "an episode in a plane has no MuJoCo scene; expected an EpisodeSetup that is not planar"
            )
        return self._world

    @property
    def data(self) -> mujoco.MjData:
        """State of MuJoCo's scene."""
        return self.world.data

    @property
    def steps(self) -> int:
        """Number of physics steps since the start."""
        return self._simulation.steps

    @property
    def time_ns(self) -> int:
        """Simulated time [ns]."""
        return self.steps * self._setup.step_ns

    @property
    def poses(self) -> list[tuple[float, float, float]]:
        """True x, y [m] and heading [rad] of each robot in the playpen."""
        return self._world.poses

    @property
    def pose(self) -> tuple[float, float, float]:
        """True x, y [m] and heading [rad] of the first robot."""
        return self._world.poses[0]

    @property
    def objects(self) -> Floats:
        """Positions x, y [m] and headings [rad] of the movable objects, in the playpen's order (n, 3)."""
        return self._world.objects

    @property
    def joints(self) -> Floats:
        """Copy of all joint positions, MuJoCo's qpos or `plane.N_JOINTS` numbers in a plane."""
        return self._world.joints if isinstance(self._world, PlanarWorld) else self.data.qpos.copy()

    def readings(self, robot: int = 0) -> tuple[list[int], ...]:
        """Return proximity, ambient counts and the driver's terms of a robot, or at a line as last read."""
        self._turrets.read(self._world, self._controllers.host_registers)
        turret_readings = self._controllers.host_registers[robot][self.boards.shape[1] :]
        registers = np.append(self.read_registers(robot), turret_readings)
        ranges = readings_of(self._driver, self._setup)
        return tuple(registers[slice(*pair)].tolist() for pair in ranges)

    def read_registers(self, robot: int = 0) -> NDArray[np.int64]:
        """Return a robot's registers, measured now, or at a line as last read (n_registers,)."""
        if self.is_at_line:
            return np.asarray(self._controllers.host_registers[robot])
        simulation = self._simulation
        update_registers(simulation.robots.state_of(robot), simulation.plain, simulation.inputs)
        return self.boards[robot]

    def run(self, seconds: float) -> None:
        """Run the episode for a time [s], in whole control periods.

        Raises:
            ValueError: The time is not a whole number of control periods, or no episode was started.
            DivergedError: The physics left its bounds, or the controller returned a speed that is not finite.
        """
        self.step(self._setup.periods(seconds) * self._setup.steps_per_period)

    @one_thread
    def step(self, steps: int) -> None:
        """Run the episode for a number of steps; errors are those of `run`."""
        self._require_start()
        if self._check_step is not None and self.steps >= self._check_step and self._use_compiled_if_ready():
            previous, self._controllers = self._controllers, self._new_controllers()
            for name in ("memory", "sums", "events", "host_registers"):
                getattr(self._controllers, name)[:] = getattr(previous, name)
        self._world.advance_to((self.steps + steps) * self._setup.step_ns)

    @one_thread
    def drive(self, left: float, right: float, robot: int = 0, commands: Sequence[float] = ()) -> None:
        """Set speeds [register] and commands of a robot like a controller, at a line with its delay.

        Raises:
            DivergedError: A speed is not finite.
        """
        self._require_start()
        if self._awaits_speeds:
            is_finite = stepping.drive_by_line(self._simulation.plain, self._controllers, robot, left, right)
        else:
            is_finite = stepping.drive(self._simulation.robots.state_of(robot), left, right)
        if not is_finite:
            raise DivergedError(
                f"{self._simulation.title} failed at {self.time_ns / 1e9:.4f} s, step {self.steps}: "
                f"robot {robot} was given the speeds {left}, {right}; expected finite numbers"
            )
        if commands:
            self._controllers.outputs[robot][2:] = commands
        self._turrets.give_orders(self._world, self._controllers.outputs)

    @one_thread
    def next_reading(self, end_step: int = NEVER) -> None:
        """Run for a control period; at a line, until the robots have answered the requests of a policy.

        Args:
            end_step: Step at which to stop at a line.

        Raises:
            DivergedError: The physics left its bounds.
        """
        if not self._awaits_speeds:
            self.step(self._setup.steps_per_period)
            return
        self._require_start()
        while self.steps < end_step:
            stepping.control(self._simulation.plain, self._simulation.inputs, self._controllers)
            if (event_step := stepping.next_step(self._controllers)) == NEVER:
                return
            self._world.advance_to(min(event_step, end_step) * self._setup.step_ns)

    @property
    def is_at_line(self) -> bool:
        """True if a line delays the readings and the speeds of a policy."""
        return self._has_started and self._awaits_speeds

    def finish_steps(self, reason: int, end_step: int) -> None:
        """Handle an early return of the stepping core in a batch, and run the remaining steps.

        Args:
            reason: Reason of the return.
            end_step: Number of steps since the start to run.

        Raises:
            DivergedError: The physics left its bounds, or a speed is not finite.
        """
        if self._awaits_speeds:
            self._world.finish_steps(reason, self.steps)
            self.next_reading(end_step)
        else:
            self._world.finish_steps(reason, end_step)

    @property
    def compiled_call(self) -> tuple[stepping.Run, stepping.EpisodeArguments] | None:
        """Compiled code with its arguments, for batches; None if Python must act within a run."""
        arguments = self._simulation.arguments
        if arguments is None or not self._world.is_self_contained:
            return None
        return self._run, stepping.EpisodeArguments(self._controllers, *arguments)

    def observe(self, slots: stepping.SlotArrays, slot: int) -> None:
        """Copy the robots' registers and poses into the arrays of a batch at a slot."""
        simulation = self._simulation
        self._turrets.read(self._world, self._controllers.host_registers)
        stepping.observe(simulation.plain, simulation.inputs, self._controllers, slots, slot)

    def touches(self, robot: int = 0) -> bool:
        """Return whether a robot touched anything but the floor in the last step."""
        if isinstance(self._world, PlanarWorld):
            return self._world.is_pushed
        return in_contact(self.data, f"{robot_name(robot)}/base")

    @one_thread
    def metrics(self, robot: int = 0) -> dict[str, float]:
        """Return a robot's metrics so far (`metrics.METRICS`); "homing" is NaN without a home."""
        self._require_start()
        return compute_metrics(self.sums[robot])

    @property
    def sums(self) -> Floats:
        """Sums of the metrics of each robot so far (n_robots, metrics.N_SUMS)."""
        return np.asarray(self._controllers.sums, np.float64)

    @property
    def _awaits_speeds(self) -> bool:
        return self._controllers.kind == stepping.CALLER

    def _advance(self, *arguments: Any) -> int:
        self._turrets.read(self._world, self._controllers.host_registers)
        if self._compiled:
            reason = self._run((self._controllers, *arguments[:-2]), *arguments[-2:], stepping.NO_SLOTS)
        else:
            reason = self._run(self._controllers, *arguments)
        self._turrets.give_orders(self._world, self._controllers.outputs)
        return reason

    def _use_compiled_if_ready(self) -> bool:
        """Switch to compiled code if it is ready; return whether it is."""
        if (run := when_ready(self._code_name)) is None:
            self._check_step = self.steps + _CHECK_INTERVAL
            return False
        self._run = run
        self._compiled = True
        self._check_step = None
        self._simulation.step_with(self._advance, compiled=True)
        return True

    def _new_controllers(self) -> stepping.Controllers:
        """Return the controllers in their state at the start of an episode."""
        return make_controllers(
            self._driver, self._genes, self._home, self._line, self._setup, self._compiled
        )

    def _require_start(self) -> None:
        """Raise a `ValueError` unless an episode was started."""
        if not self._has_started:
            raise ValueError("no episode has begun; expected begin() first")


def _check_starts(start: Start | Sequence[Start], n_robots: int) -> list[Start]:
    """Return the start of each robot; raise a `ValueError` unless there is one per robot."""
    starts = np.atleast_2d(np.asarray(start, np.float64))
    if starts.shape != (n_robots, 3):
        raise ValueError(f"start = {start}; expected x, y [mm] and heading [deg] of {n_robots} robots")
    return [(x_mm, y_mm, heading_deg) for x_mm, y_mm, heading_deg in starts.tolist()]
