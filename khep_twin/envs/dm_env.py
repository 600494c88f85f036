"""Tasks as dm_env environments on dm_control, with a `Physics` with named accessors.

    environment = load("ObstacleAvoidance", seed=1)
    step = environment.reset()
    while not step.last():
        step = environment.step([0.5, 0.4])
        print(step.observation["proximity"], step.reward, environment.physics.pose())

Observations are the observation terms by name (`tasks.terms_of`). An action is the speeds of both wheels;
1 is 20 pulses/10 ms, 160 mm/s. Both are normalized to -1 to 1, or in the robot's units with
`normalize=False`. One step is one control period, 50 ms by default. An episode ends with discount 1 at its
time limit, with 0 when the charge has run out.

`load` also accepts options like dm_control's `suite.load`, in `task_kwargs` and `environment_kwargs`.
"""

# dm_control and dm_env are not typed.
# pyright: reportMissingTypeStubs=false, reportUnknownMemberType=false, reportUnknownVariableType=false
# pyright: reportUnknownArgumentType=false, reportUntypedBaseClass=false, reportIncompatibleMethodOverride=false

from collections import OrderedDict
from collections.abc import Mapping, Sequence
from typing import Any, NoReturn

import numpy as np
from numpy.typing import NDArray

from khep_twin.copies import CopiedByArguments, NotCopied
from khep_twin.envs.arguments import check_mapping, check_switch
from khep_twin.envs.reset_options import validate_seed
from khep_twin.envs.task_episode import StepResult, TaskEpisode
from khep_twin.envs.task_setup import TaskSetup
from khep_twin.envs.tasks import Task
from khep_twin.episodes import version_check
from khep_twin.errors import KhepTwinError, value_text
from khep_twin.process.one_thread import one_thread
from khep_twin.randomness import stream

version_check.check()

import dm_env  # noqa: E402
from dm_control import mujoco  # noqa: E402
from dm_control.mujoco import wrapper  # noqa: E402
from dm_control.rl import control  # noqa: E402
from dm_env import specs  # noqa: E402


class Physics(NotCopied, mujoco.Physics):
    """Physics of dm_control for an episode, e.g. `named.data.xpos["khepera0/base"]`, with robot accessors.

    Time advances by whole control periods: sensors and control loops are part of the step.

    Args:
        episode: Episode to simulate.

    Attributes:
        episode: Simulated episode.
        outcome: Result of the last period; None at an episode's start.
        observation: Observation, all terms concatenated (n,).
        guard: Lock by which its methods refuse a second thread, the episode's.
    """

    COPY_ADVICE = "another environment with the same seed, whose episode is repeated by its actions"

    def __init__(self, episode: TaskEpisode) -> None:
        self.guard = episode.guard
        self.episode = episode
        self.outcome: StepResult | None = None
        self.observation = episode.begin(0)[0]
        self._action: object = (0.0, 0.0)
        super().__init__(wrapper.MjData(episode.data))

    def proximity(self) -> NDArray[np.int64]:
        """Return the counts of the sensors (n_sensors,)."""
        return self._read(range(*self.episode.setup.interface.proximity))

    def ambient(self) -> NDArray[np.int64]:
        """Return the counts of ambient light (n_sensors,), of a Khepera low in bright light."""
        return self._read(range(*self.episode.setup.interface.ambient))

    def setpoints(self) -> NDArray[np.int64]:
        """Return the speed setpoints of the wheels (2,) [register]."""
        return self._read(self.episode.setup.interface.setpoints)

    def _read(self, registers: Sequence[int]) -> NDArray[np.int64]:
        return self.episode.registers[0][list(registers)]

    def pose(self) -> NDArray[np.float64]:
        """Return the true x, y [m] and heading [rad] (3,)."""
        return np.array(self.episode.poses[0])

    def time(self) -> float:
        """Return the episode's simulated time [s]."""
        return self.episode.time_s

    @one_thread
    def begin(self, seed: int) -> None:
        """Start an episode."""
        self.observation, self.outcome = self.episode.begin(seed)[0], None
        if self.episode.data is not self._data_pointer:
            # Each episode of a world creates new data, so the view is reloaded.
            self._reload_from_data(wrapper.MjData(self.episode.data))

    def set_control(self, control: object) -> None:
        """Set the action of the next period (2,): speeds, not voltages."""
        self._action = control

    @one_thread
    def step(self, nstep: int = 1) -> None:
        """Advance by control periods."""
        for _ in range(nstep):
            (self.outcome,) = self.episode.step([self._action])
            self.observation = self.outcome.observation

    def timestep(self) -> float:
        """Return the control period [s]."""
        return self.episode.setup.period_ns / 1e9

    def reset(self, keyframe_id: int | None = None) -> None:
        """Do nothing: an episode starts by `begin`, with its seed."""

    def after_reset(self) -> None:
        """Do nothing: a running episode must not change."""

    @one_thread
    def render(self, *arguments: Any, **options: Any) -> Any:
        """Return a picture, as dm_control's `Physics.render` does."""
        return super().render(*arguments, **options)

    def copy(self, share_model: bool = False) -> NoReturn:
        """Raise a `TypeError`, as `copy.copy` does."""
        self.__reduce_ex__(None)

    @property
    def _data_pointer(self) -> object:
        return self.data.ptr


class TrialTask(control.Task):
    """A task of `tasks` as a dm_control task.

    Args:
        setup: Prepared task.
        seed: Seed of the sequence of episodes.

    Attributes:
        seed: Seed of the episode.
        bounds: Lower and upper bounds of all observation terms concatenated (n,), (n,).
    """

    def __init__(self, setup: TaskSetup, seed: int) -> None:
        self._setup = setup
        self._terms = {name: setup.task.terms[name] for name in setup.task.observation_terms}
        self._rng = stream(seed, "trials")
        self.seed = 0
        self.bounds = setup.task.bounds(setup.normalize)

    def initialize_episode(self, physics: Physics) -> None:
        """Start an episode with the next seed."""
        self.seed = int(self._rng.integers(2**31))
        physics.begin(self.seed)

    def action_spec(self, physics: Physics) -> specs.BoundedArray:
        """Return the bounds of the speeds of left and right wheel."""
        limit = self._setup.action_limit
        return specs.BoundedArray((2,), np.float64, -limit, limit, name="left\tright")

    def before_step(self, action: object, physics: Physics) -> None:
        """Set the action."""
        physics.set_control(action)

    def after_step(self, physics: Physics) -> None:
        """Do nothing."""

    def get_observation(self, physics: Physics) -> "OrderedDict[str, NDArray[np.float32]]":
        """Return each observation term by name."""
        ends = np.cumsum([len(term.names) for term in self._terms.values()])
        parts = np.split(physics.observation.copy(), ends[:-1])
        return OrderedDict(zip(self._terms, parts, strict=True))

    def observation_spec(self, physics: Physics) -> "OrderedDict[str, specs.BoundedArray]":
        """Return the bounds of each observation term."""
        normalize = self._setup.normalize
        return OrderedDict(
            (name, specs.BoundedArray((len(term.names),), np.float32, *term.bounds(normalize), name=name))
            for name, term in self._terms.items()
        )

    def get_reward(self, physics: Physics) -> float:
        """Return the reward of the last period."""
        return physics.outcome.reward if physics.outcome else 0.0

    def get_termination(self, physics: Physics) -> float | None:
        """Return 0 if the charge has run out, 1 at the time limit, and None before."""
        if physics.outcome is not None and physics.outcome.terminated:
            return 0.0
        return 1.0 if physics.episode.over else None


class Environment(CopiedByArguments, control.Environment):
    """A task as an environment of dm_control.

    A copy, also by `pickle`, has the same arguments, and starts with the first episode.

    Args:
        task: Task, or its name.
        seed: Seed of its episodes.
        flat_observation: Whether to observe all terms concatenated, as "observations".
        options: Options of `TaskSetup`.

    Attributes:
        max_episode_steps: Time limit of an episode in steps.
    """

    def __init__(
        self, task: Task | str, seed: int, *, flat_observation: bool = False, **options: Any
    ) -> None:
        check_switch("flat_observation", flat_observation)
        setup = TaskSetup(task, **options)
        self.max_episode_steps = setup.n_steps
        if setup.planar:
            raise KhepTwinError(
                "planar = True: dm_env needs MuJoCo's physics; expected False, or Gymnasium's environments"
            )
        if setup.details:
            raise KhepTwinError(
                "details = True: dm_env has no infos; expected False, or Gymnasium's environments"
            )
        physics, trial = Physics(TaskEpisode(setup)), TrialTask(setup, seed)
        super().__init__(physics, trial, flat_observation=flat_observation)

    def observation_spec(self) -> Any:
        """Return the bounds of an observation by name."""
        term_specs = super().observation_spec()
        if not self._flat_observation:
            return term_specs
        low, high = self._task.bounds
        name = control.FLAT_OBSERVATION_KEY
        return OrderedDict({name: specs.BoundedArray(low.shape, np.float32, low, high, name=name)})


_SUITE_NAMES = {"random": "seed", "time_limit": "seconds"}
"""Options of `load` by their names in dm_control's suite."""


def load(
    task: Task | str,
    *,
    seed: int = 0,
    task_kwargs: Mapping[str, Any] | None = None,
    environment_kwargs: Mapping[str, Any] | None = None,
    visualize_reward: bool = False,
    **options: Any,
) -> dm_env.Environment:
    """Return an environment.

    Args:
        task: Task, or its name.
        seed: Seed of its episodes; the same seed and actions give the same steps.
        task_kwargs: Further options; dm_control's names `random` for the seed and `time_limit` for the
            seconds are also accepted.
        environment_kwargs: Only `flat_observation`; the task sets dm_control's other arguments.
        visualize_reward: False, as no scene shows rewards.
        options: Options of `TaskSetup`: playpen, start, lamps, randomize, noise, vary, period_ns,
            seconds, compiled, normalize.

    Raises:
        KhepTwinError: The task or an option is unknown, or `planar` is set.
        ValueError: The seed is no integer from 0 to 2**63-1.
    """
    if visualize_reward is not False:
        raise KhepTwinError(
            key="visualize_reward", value=visualize_reward, expected="False, as no scene shows rewards"
        )
    suite_options = check_mapping("environment_kwargs", environment_kwargs)
    for name in suite_options:
        if name != "flat_observation":
            raise KhepTwinError(
                f"environment_kwargs: {value_text(name)}: unknown; expected 'flat_observation', or "
                "seconds and period_ns as options of the task"
            )
    task_kwargs = check_mapping("task_kwargs", task_kwargs)
    task_options = {_SUITE_NAMES.get(name, name): value for name, value in task_kwargs.items()}
    arguments: dict[str, Any] = {"seed": seed, **options, **task_options, **suite_options}
    arguments["seed"] = validate_seed(0 if arguments["seed"] is None else arguments["seed"])
    return Environment(task, **arguments)
