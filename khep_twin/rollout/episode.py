"""One episode of one robot in its playpen, without a serial line.

    setup = EpisodeSetup(playpen.load("obstacles"))
    episode = Episode(setup, Braitenberg())
    episode.begin(seed=1)
    episode.run(60.0)
    print(episode.pose, episode.metrics())

The same seed gives the same counts, registers and positions as a `World` whose robot receives the same speeds
at the same times over a line without delay, compiled or not, however often the `Episode` was used before.
Not supported, and refused: other robots, turrets, lamps that take turns. LEDs can be set, but have no effect.

With `EpisodeSetup(..., planar=True)` the robot moves in a plane (`planar`), for screening: the same firmware
and sensors, thirty times faster and more, and similar trajectories.
"""

import importlib.util
import math
import warnings
from collections.abc import Sequence

import mujoco
import numpy as np
from numpy.typing import NDArray

from khep_twin import units
from khep_twin.board import kernel
from khep_twin.board.battery import Supply
from khep_twin.board.rom import DEMO, ROMS
from khep_twin.errors import DivergedError, pip_install_extra
from khep_twin.playpen.starts import Start
from khep_twin.randomness import stream
from khep_twin.rollout import stepping
from khep_twin.rollout.controllers import ConstantSpeed, Driver, Floats, Function, controller_state
from khep_twin.rollout.episode_setup import EpisodeLamps, EpisodeSetup
from khep_twin.rollout.mujoco_backend import MujocoBackend
from khep_twin.rollout.planar.planar import Numbers, PlanarBackend, as_record
from khep_twin.sensing.ambient import ambient_optics
from khep_twin.sensors import proximity_optics

METRICS = ("obstacle_avoidance", "light_seeking", "homing", "wall_following", "distance_m", "forward_m")
"""Metrics of an episode: means over its control periods, distance, and distance forwards less backwards."""

_MEANS = stepping.AVOIDANCE, stepping.SEEKING, stepping.HOMING, stepping.FOLLOWING

SPAN_NS = 2_000_000_000
"""Simulated time per draw of random numbers [ns]."""

PLANAR_SPAN_NS = 20_000_000_000
"""Simulated time per draw in a plane [ns]: longer, as steps there are cheap; no effect on results."""


class SlowerWarning(UserWarning):
    """Warning that episodes run uncompiled, with the same results, as numba is not installed."""


def is_compiled(wanted: bool | None) -> bool:
    """Return whether episodes run compiled; None means if numba is installed, with a warning if not."""
    if wanted is not None:
        return wanted
    if importlib.util.find_spec("numba") is not None:
        return True
    warnings.warn(
        "numba is not installed: episodes run uncompiled, many times slower, with the same results; "
        f"to install it: {pip_install_extra('batch')}",
        SlowerWarning,
        stacklevel=3,
    )
    return False


class Episode:
    """One episode at a time; `begin` starts a new one in the same memory.

    Args:
        setup: Setup of the episodes.
        driver: Controller; a policy is left to the caller.
        compiled: Whether to run compiled; None if numba is installed.

    Attributes:
        registers: State of the board (N_REGISTERS,).
    """

    def __init__(
        self, setup: EpisodeSetup, driver: Driver | None = None, *, compiled: bool | None = None
    ) -> None:
        self._setup, self._driver = setup, driver or ConstantSpeed()
        self._compiled = is_compiled(compiled)
        self.registers: NDArray[np.int64] = np.zeros(kernel.N_REGISTERS, np.int64)
        self._to_data = _as_arrays if self._compiled else _as_it_is
        self._optics_data = as_record if self._compiled and setup.planar_scene else self._to_data
        self._backend: MujocoBackend | PlanarBackend
        if setup.planar_scene is None:
            model = setup.without_sensors if self._compiled else setup.model
            self._backend = MujocoBackend(model, setup.indices, self._compiled)
        else:
            self._backend = PlanarBackend(setup.planar_scene, self._compiled)
        self._state = np.zeros(stepping.N_STATE, np.int64)
        self._proximity = self._optics_data(proximity_optics(setup.model, setup.indices, setup.calibration))
        self._ambient = self._optics_data(ambient_optics(setup.calibration.ambient))
        self._supply = Supply(setup.entry.battery_used_min)
        self._rng: list[np.random.Generator] = []
        self._seed = 0
        self._light = setup.light
        self._begun = False

    def begin(
        self,
        seed: int = 0,
        *,
        start: Start | None = None,
        noise: bool = True,
        vary: bool = False,
        light: EpisodeLamps | None = None,
        genes: Sequence[float] | Floats = (),
        home: Sequence[float] = (0.0, 0.0, 0.0, 0.0),
    ) -> None:
        """Start an episode.

        Args:
            seed: Seed of every random stream.
            start: Start x, y [mm] and heading [deg]; None for the playpen's.
            noise: Whether sensors are noisy.
            vary: Whether to draw the sensors of another robot.
            light: Other lamps than the playpen's (`EpisodeSetup.lit`).
            genes: Genes of the controller.
            home: Home x, y, radius [m] and duration of a charge [s]; radius 0 for none.

        Raises:
            ControllerError: The genes do not fit the controller.
            DivergedError: The physics leaves its bounds at once.
        """
        setup, backend = self._setup, self._backend
        self._seed, self._light = seed, light or setup.light
        proximity, ambient = self._proximity, self._ambient
        if vary:
            measured = setup.another(seed)
            proximity = self._optics_data(proximity_optics(setup.model, setup.indices, measured))
            ambient = self._optics_data(ambient_optics(measured.ambient))
        self._rng = []
        if noise:
            self._rng = [stream(seed, "robot", 0, name) for name in ("proximity", "ambient", "idle")]
        begins = start or setup.start(seed)
        own = setup.entry.x_mm, setup.entry.y_mm, setup.entry.heading_deg
        backend.put(None if begins == own else begins)
        self.registers[:] = 0
        kernel.reset(self.registers.data)
        driver, mode = self._driver, ROMS[setup.entry.rom].modes[setup.entry.mode]
        self._state[:] = 0, 1, mode.function == DEMO, stepping.FINE
        self._robot = stepping.RobotState(
            backend.scene,
            proximity,
            ambient,
            self._to_data(self._light.bulbs),
            setup.sim_indices,
            self.registers if self._compiled else self.registers.data,
            *backend.arrays,
            self._state if self._compiled else self._state.data,
            np.zeros(1),
        )
        weights, place = np.asarray(genes, np.float64), np.array(home, np.float64)
        self._controller = controller_state(driver, weights, place, self._compiled)
        self._begun = True
        if isinstance(driver, ConstantSpeed) and (driver.left or driver.right):
            self.drive(driver.left, driver.right)
        self._backend.advance(
            self._robot, self._controller, self._inputs(self._light.at_start(), units.N_SENSORS, 1), -1
        )
        self._complain()

    @property
    def _data(self) -> mujoco.MjData:
        """State of MuJoCo's scene, if there is one."""
        if isinstance(self._backend, PlanarBackend):
            raise ValueError(
                "an episode in a plane has no MuJoCo scene; expected an EpisodeSetup that is not planar"
            )
        return self._backend.data

    @property
    def steps(self) -> int:
        """Number of physics steps done."""
        return int(self._state[stepping.STEPS])

    @property
    def time_ns(self) -> int:
        """Simulated time [ns]."""
        return self.steps * self._setup.step_ns

    @property
    def pose(self) -> tuple[float, float, float]:
        """True x, y [m] and heading [rad] in the playpen."""
        return self._backend.pose

    @property
    def joints(self) -> Floats:
        """Copy of all joint positions, MuJoCo's qpos or `plane.N_JOINTS` numbers."""
        return self._backend.joints

    def readings(self) -> tuple[list[int], list[int]]:
        """Return proximity and ambient counts of the registers, each (8,)."""
        return self.registers[kernel.PROXIMITY].tolist(), self.registers[kernel.AMBIENT].tolist()

    def run(self, seconds: float) -> None:
        """Run the episode for a time [s], in whole control periods.

        Raises:
            ValueError: The time is not a whole number of control periods, or no episode has begun.
            DivergedError: The physics left its bounds, or the controller gave a speed that is no number.
        """
        steps = self._setup.periods(seconds) * self._setup.sim_indices.steps_per_period
        longest = (SPAN_NS if self._setup.planar_scene is None else PLANAR_SPAN_NS) // self._setup.step_ns
        while steps > 0:
            self.step(min(steps, longest))
            steps -= longest

    def step(self, steps: int) -> None:
        """Run the episode for some steps; errors are those of `run`."""
        self._insist()
        sim_indices = self._setup.sim_indices
        n_supplies = steps // sim_indices.steps_per_supply + 1
        inputs = self._inputs(
            self._light.during(self.steps, steps), steps * sim_indices.conversions, n_supplies
        )
        if self._backend.advance(self._robot, self._controller, inputs, steps):
            self._complain()

    def drive(self, left: float, right: float) -> None:
        """Set both speeds [pulses/10 ms], as a controller does.

        Raises:
            DivergedError: A speed is no number.
        """
        self._insist()
        if self._state[stepping.POWERED] and not stepping.drive(self.registers.data, left, right):
            self._state[stepping.TERMINATION] = stepping.NO_SPEED
            self._complain()

    def metrics(self) -> dict[str, float]:
        """Return the metrics so far (`METRICS`); "homing" is NaN without a home."""
        self._insist()
        sums = self._controller.sums
        periods = max(float(sums[stepping.PERIODS]), 1.0)
        means = [float(sums[each]) / periods for each in _MEANS]
        if not self._controller.home[2]:
            means[2] = math.nan
        distances = float(sums[stepping.DISTANCE]), float(sums[stepping.FORWARD])
        return dict(zip(METRICS, [*means, *distances], strict=True))

    def _insist(self) -> None:
        """Raise a `ValueError` unless an episode has begun."""
        if not self._begun:
            raise ValueError("no episode has begun; expected begin() first")

    def _inputs(self, powers: list[list[float]], conversions: int, n_supplies: int) -> stepping.StepInputs:
        """Return the random draws and supply of the next steps."""
        draws: list[Floats] = [np.zeros(0)] * 3
        if self._rng:
            proximity, ambient, idle = self._rng
            draws = [each.standard_normal(conversions) for each in (proximity, ambient)]
            draws.append(idle.standard_exponential(conversions))
        sim_indices, step_ns = self._setup.sim_indices, self._setup.step_ns
        fed = self.steps // sim_indices.steps_per_supply + (n_supplies > 1 or self.steps > 0)
        feed_ns = sim_indices.steps_per_supply * step_ns
        if self._supply.steady:
            volts = np.full(n_supplies, self._supply.voltage(0))
        else:
            volts = np.array([self._supply.voltage((fed + i) * feed_ns) for i in range(n_supplies)])
        noisy = bool(self._rng)
        if not self._compiled:
            return stepping.StepInputs(powers, volts.tolist(), noisy, *(draw.tolist() for draw in draws))
        return stepping.StepInputs(np.array(powers).reshape(len(powers), -1), volts, noisy, *draws)  # type: ignore

    def _complain(self) -> None:
        """Raise a `DivergedError` if the episode has failed."""
        trouble = int(self._state[stepping.TERMINATION])
        if trouble == stepping.FINE:
            return
        reason = "the physics left its bounds"
        if trouble == stepping.WARNED:
            reason = f"MuJoCo warns of {self._backend.warning}"
        elif trouble == stepping.NO_SPEED:
            reason = "the controller gave a speed that is no number"
            if isinstance(self._driver, Function):
                reason += ", or raised an error"
        raise DivergedError(
            f"episode of seed {self._seed} failed at {self.time_ns / 1e9:.4f} s, step {self.steps}: {reason}"
        )


def _as_arrays(values: Numbers) -> Numbers:
    """Return a named tuple with its lists as arrays, for compiled code."""
    return values._make(
        np.array(value, np.int64 if name == "first" else np.float64) if isinstance(value, list) else value
        for name, value in zip(values._fields, values, strict=True)
    )


def _as_it_is(values: Numbers) -> Numbers:
    return values
