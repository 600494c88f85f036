"""Policies trained with a task, as controllers of a robot on any port.

    from stable_baselines3 import PPO
    from khep_twin import TaskController

    controller = TaskController("ObstacleAvoidance", PPO.load("avoid"))

With these lines in FILE.py, `khep-twin run FILE.py --port /dev/ttyUSB0` drives a robot. Observations and
actions have the terms, units and scaling of the task, and a cycle has its period.
"""

import inspect
from collections.abc import Callable, Mapping, Sequence
from os import fspath
from typing import Any, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from khep_twin import units
from khep_twin.clock import to_ns
from khep_twin.envs.task_setup import PERIOD_NS
from khep_twin.envs.tasks import Observation, State, Task, find_task, speeds_of
from khep_twin.errors import ControllerError
from khep_twin.files.paths import StrPath
from khep_twin.host.host_robot import HostRobot
from khep_twin.lab.experiment.controllers import error_in_file, source_file
from khep_twin.lab.experiment.periodic_controllers import PeriodicController
from khep_twin.playpen import Playpen
from khep_twin.process.signals import is_interruption
from khep_twin.robots.model import RobotModel
from khep_twin.robots.registry import find_family
from khep_twin.sensing import calibration as calibrations


@runtime_checkable
class Model(Protocol):
    """Model of stable-baselines3, or any object with its `predict` method."""

    def predict(self, observation: Observation, /, *, deterministic: bool) -> tuple[Any, Any]:
        """Return an action and a state."""
        ...


class TaskController(PeriodicController):
    """Policy that drives a robot as in the task with which it was trained.

    Each cycle asks for the registers of the terms that the task observes, in its order; a Khepera's for
    proximity, light and speed by N, O and H. It then evaluates the policy and sends the speeds (D). The speed
    is the encoders' mean since the previous cycle.

    Args:
        task: Task, or its name.
        policy: Model with the method `predict` of stable-baselines3, or function of an observation (n,) that
            returns an action (2,).
        period_ns: Control period [ns].
        normalize: Whether actions and observations are normalized to -1 to 1, as in the environment.
        calibration: Calibration of the robot, by name or path, for the scale of light; by default that of
            the task's playpen.

    Raises:
        ControllerError: The task observes a term that no robot reports, or the policy has other observations
            or actions.
        KhepTwinError: The task is unknown.
        ValueError: The period is not above 0.
    """

    def __init__(
        self,
        task: Task | str,
        policy: Model | Callable[[Observation], Any],
        *,
        period_ns: int = PERIOD_NS,
        normalize: bool = True,
        calibration: StrPath | None = None,
    ) -> None:
        if period_ns <= 0:
            raise ValueError(f"control period of {period_ns} ns; expected a time above 0")
        super().__init__(period_ns)
        self._task = find_task(task)
        self._policy = policy
        self._normalize = normalize
        self._model = find_family(self._task.model)
        self._registers = _registers_of(self._model)
        read_of = self._model.dialect.read_of
        reported = [name for name, part in self._registers.items() if all(map(read_of, part))]
        for term in self._task.observation_terms:
            if term not in reported:
                raise ControllerError(
                    f"{self.subject}: no robot reports its {term}; expected a task that observes "
                    f"{', '.join(reported)} alone"
                )
        self._name = type(policy).__name__
        if inspect.isfunction(policy):
            self.defined_by, self._name = policy, source_file(policy)
        limit = 1.0 if normalize else self._task.top_speed
        self._check_space("observation", *self._task.bounds(normalize))
        self._check_space("action", np.full(2, -limit), np.full(2, limit))
        default = Playpen.load(self._task.playpen).robots[0].calibration
        ambient = calibrations.read(default if calibration is None else fspath(calibration))[0].ambient
        self._dark, self._floor = ambient.dark_counts, ambient.floor_counts
        self._previous: tuple[int, Sequence[int]] | None = None

    @property
    def family(self) -> str:
        """Family of the robots that it drives."""
        return self._model.family

    @property
    def subject(self) -> str:
        """Name for messages."""
        return f"task {self._task.name}"

    def start(self, robot: HostRobot) -> None:
        """Reset the counters, so that the first speed is 0, as in the environment."""
        self._previous = None

    def decide(self, robot: HostRobot) -> tuple[float, float]:
        """Read the robot's sensors and evaluate the policy."""
        start_ns, interface = to_ns(robot.time), self._model.episode_interface
        observed = [number for term in self._task.observation_terms for number in self._registers[term]]
        registers, left, right = np.zeros(interface.n_registers, np.int64), 0.0, 0.0
        registers[observed] = robot.read_registers(observed)
        if "speed" in self._task.observation_terms:
            left, right = self._speed(registers[list(interface.positions)].tolist(), start_ns)
        numbers = left, right, self._dark, self._floor
        state = State(registers, *numbers, at_goal=False, charge=1.0, model=self.family)
        action = self._action(self._task.observe(state, self._normalize))
        left, right = speeds_of(action, self._task.top_speed, self._normalize).tolist()
        return left, right

    def _speed(self, positions: Sequence[int], start_ns: int) -> tuple[float, float]:
        """Return the mean speeds of both wheels since the previous cycle [register]."""
        previous_ns, previous = self._previous or (start_ns, positions)
        self._previous = start_ns, positions
        ticks = max(start_ns - previous_ns, 1) / units.TICK_NS
        scale = self._model.episode_interface.speed_per_pulse
        left, right = (new - old for new, old in zip(positions, previous, strict=True))
        return left / ticks * scale, right / ticks * scale

    def _action(self, observation: Observation) -> NDArray[np.float64]:
        """Return the policy's action (2,); raise a `ControllerError` if it is not an action."""
        policy = self._policy
        try:
            is_model = isinstance(policy, Model)
            action = policy.predict(observation, deterministic=True)[0] if is_model else policy(observation)
        except BaseException as error:
            if is_interruption(error):
                raise
            raise error_in_file(self._name, error, f"at an observation {self._observation_text}: ") from error
        try:
            speeds = np.asarray(action, np.float64)
        except (TypeError, ValueError):
            speeds = np.zeros(0)
        if speeds.shape != (2,) or not np.isfinite(speeds).all():
            limit = 1.0 if self._normalize else self._task.top_speed
            expected = f"two finite numbers, left and right, from {-limit:g} to {limit:g}"
            raise ControllerError(f"{self._name}: the policy returned {action!r:.200}; expected {expected}")
        return speeds

    @property
    def _observation_text(self) -> str:
        """Shape and terms of an observation, in words."""
        low, high = self._task.bounds(self._normalize)
        terms = ", ".join(self._task.observation_terms)
        return f"of {len(low)} numbers ({terms}) from {low.min():g} to {high.max():g}"

    def _check_space(self, kind: str, low: NDArray[np.generic], high: NDArray[np.generic]) -> None:
        """Raise a `ControllerError` if a model declares a different space of observations or actions."""
        space = getattr(self._policy, f"{kind}_space", None)
        if space is None:
            return
        bounds = [np.asarray(getattr(space, bound_name, ()), np.float64) for bound_name in ("low", "high")]
        has_shape = bounds[0].shape == bounds[1].shape == low.shape
        if has_shape and np.allclose(bounds, [low, high]):
            return
        expected = f"of two numbers from {low[0]:g} to {high[0]:g}"
        expected = self._observation_text if kind == "observation" else expected
        problem = f"{self._name}: made for {kind}s {' '.join(str(space).split())[:200]}"
        hint = f", or normalize={not self._normalize}" if has_shape else ""
        raise ControllerError(f"{problem}; expected those of task {self._task.name}, {expected}{hint}")


def _registers_of(model: RobotModel) -> Mapping[str, Sequence[int]]:
    """Return the registers of the observation terms of a model, by name."""
    interface = model.episode_interface
    return {
        "proximity": range(*interface.proximity),
        "light": range(*interface.ambient),
        "speed": interface.positions,
        **{name: range(first, first + len(names)) for name, first, names, *_ in model.terms},
    }
