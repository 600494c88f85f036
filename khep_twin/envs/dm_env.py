"""Tasks as dm_env environments on dm_control, with a `Physics` with named accessors.

    environment = load("ObstacleAvoidance", seed=1)
    step = environment.reset()
    while not step.last():
        step = environment.step([0.5, 0.4])
        print(step.observation["proximity"], step.reward, environment.physics.pose())

Observations are the task's terms by name (`tasks.TERMS`). An action is the speeds of left and right wheel;
1 is 20 pulses/10 ms, 160 mm/s. Both are normalized to -1 to 1, or in the robot's own units with
`normalize=False`. One step is one control period, 50 ms by default. An episode ends with discount 1 at its
time limit, with 0 when the charge has run out.
"""

# dm_control and dm_env are not typed.
# pyright: reportMissingTypeStubs=false, reportUnknownMemberType=false, reportUnknownVariableType=false
# pyright: reportUnknownArgumentType=false, reportUntypedBaseClass=false, reportIncompatibleMethodOverride=false

from collections import OrderedDict
from typing import Any

import numpy as np
from numpy.typing import NDArray

from khep_twin.board.kernel import AMBIENT, PROXIMITY, SETPOINTS
from khep_twin.envs.task_episode import StepResult, TaskEpisode
from khep_twin.envs.task_setup import TaskSetup
from khep_twin.envs.tasks import TERMS, Task
from khep_twin.episodes import version_check
from khep_twin.errors import KhepTwinError
from khep_twin.randomness import stream

version_check.check()

import dm_env  # noqa: E402
from dm_control import mujoco  # noqa: E402
from dm_control.mujoco import wrapper  # noqa: E402
from dm_control.rl import control  # noqa: E402
from dm_env import specs  # noqa: E402


class Physics(mujoco.Physics):
    """An episode's scene in dm_control, `named.data.xpos["khepera0/base"]`, with accessors for the robot.

    Time advances by whole control periods: sensors and control loops are part of the step.

    Args:
        episode: Episode to simulate.

    Attributes:
        episode: Simulated episode.
        outcome: Result of the last period; None at an episode's start.
        observation: Observation, all terms concatenated (n,).
    """

    def __init__(self, episode: TaskEpisode) -> None:
        self.episode = episode
        self.outcome: StepResult | None = None
        self.observation = episode.begin(0)[0]
        self._action: object = (0.0, 0.0)
        super().__init__(wrapper.MjData(episode.data))

    def proximity(self) -> NDArray[np.int64]:
        """Return the counts of command N (8,)."""
        return self.episode.registers[0][PROXIMITY]

    def ambient(self) -> NDArray[np.int64]:
        """Return the counts of command O (8,), low in the light."""
        return self.episode.registers[0][AMBIENT]

    def setpoints(self) -> NDArray[np.int64]:
        """Return the speed setpoints of the wheels (2,) [pulses/10 ms]."""
        return self.episode.registers[0][SETPOINTS]

    def pose(self) -> NDArray[np.float64]:
        """Return the true x, y [m] and heading [rad] (3,)."""
        return np.array(self.episode.poses[0])

    def time(self) -> float:
        """Return the episode's simulated time [s]."""
        return self.episode.time_s

    def begin(self, seed: int) -> None:
        """Start an episode."""
        self.observation, self.outcome = self.episode.begin(seed)[0], None
        if self.episode.data is not self._scene:
            # Each episode of a world creates a new one, so the view is reloaded.
            self._reload_from_data(wrapper.MjData(self.episode.data))

    def set_control(self, control: object) -> None:
        """Set the action of the next period (2,): speeds, not voltages."""
        self._action = control

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
        """Do nothing: an episode that has begun must not change."""

    def __deepcopy__(self, memo: dict[int, object]) -> "Physics":
        """Raise a `TypeError`, as `copy` does."""
        return self.copy()

    def copy(self, share_model: bool = False) -> "Physics":
        """Raise a `TypeError`, as an episode cannot be copied.

        Raises:
            TypeError: Always; an episode is repeated by its seed and actions.
        """
        raise TypeError("an episode cannot be copied; expected another environment with the same seed")

    @property
    def _scene(self) -> object:
        return self.data.ptr


class TrialTask(control.Task):
    """A task of `tasks` as a dm_control task.

    Args:
        setup: Prepared task.
        seed: Seed of the sequence of episodes.
    """

    def __init__(self, setup: TaskSetup, seed: int) -> None:
        self._setup, self._terms = setup, {name: TERMS[name] for name in setup.task.observation_terms}
        self._rng = stream(seed, "trials")
        self.seed = 0

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
        """Return 0 when the charge has run out, 1 at the time limit, else None."""
        if physics.outcome is not None and physics.outcome.ended:
            return 0.0
        return 1.0 if physics.episode.over else None


def load(task: Task | str, *, seed: int = 0, **options: Any) -> dm_env.Environment:
    """Return an environment.

    Args:
        task: Task, or its name.
        seed: Seed of its episodes; the same seed and actions give the same steps.
        options: Options of `TaskSetup`: playpen, noise, vary, period_ns, seconds, compiled, normalize.

    Raises:
        KhepTwinError: The task is unknown, or in a plane.
    """
    setup = TaskSetup(task, **options)
    if setup.planar:
        raise KhepTwinError(
            "planar = True: dm_env shows MuJoCo's physics; expected False, or Gymnasium's environments"
        )
    return control.Environment(Physics(TaskEpisode(setup)), TrialTask(setup, seed))
