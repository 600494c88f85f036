"""Episodes of a task: `begin` with a seed, then `step` by step, with observations and rewards.

    episode = TaskEpisode(TaskSetup("ObstacleAvoidance"))
    episode.begin(seed=1)
    while not episode.over:
        result, = episode.step([(0.5, 0.5)])
        print(result.observation, result.reward)

The dm_env, Gymnasium and PettingZoo environments are built on these episodes. A step is one control period,
50 ms by default (the cycle of the Khepera Toolbox's controllers): the speeds are set as by a command D
without delay, physics, sensors and control loops run at their own rates, and the robots are observed again.
An episode depends on its seed and its actions alone, not on earlier episodes.

Actions and observations are normalized to -1 to 1, or, with `TaskSetup(..., normalize=False)`, in the units
of the robot: pulses/10 ms, and counts.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import mujoco
import numpy as np
from numpy.typing import NDArray

from khep_twin import units
from khep_twin.board.kernel import LEFT, RIGHT, Wheel
from khep_twin.clock import n_steps, to_ns
from khep_twin.envs.tasks import TOP_SPEED, Observation, State, Task, find
from khep_twin.errors import KhepTwinError, PlaypenError, choices
from khep_twin.playpen import Playpen, load
from khep_twin.playpen.starts import anywhere, at_spots
from khep_twin.rollout.episode import Episode, EpisodeSetup
from khep_twin.sensing import calibration

PERIOD_NS = 50_000_000
"""Default control period [ns]."""

_ENCODERS = (LEFT + Wheel.ENCODER, RIGHT + Wheel.ENCODER)


@dataclass(frozen=True, slots=True)
class StepResult:
    """Results of one robot's step.

    Attributes:
        observation: Observation after the step (n,).
        reward: Reward for this control period, 0 to 1.
        ended: Whether the charge has run out.
    """

    observation: Observation
    reward: float
    ended: bool


class TaskSetup:
    """A prepared task; any number of episodes, in any threads, may share it.

    Args:
        task: Task, or its name.
        playpen: Playpen instead of the task's, as a name, path or object.
        robots: Number of robots.
        noise: Whether sensors are noisy.
        vary: Whether each episode has another robot of the same make, by its seed.
        period_ns: Control period [ns], whole ticks of 10 ms.
        seconds: Time limit of an episode [s]; by default the task's.
        compiled: Whether to run compiled; None if numba is installed.
        normalize: Whether actions and observations are normalized to -1 to 1; else actions are in pulses/10
            ms, and observations in the units of `tasks.TERMS`.

    Attributes:
        action_limit: Upper bound of an action, and the lower one with its sign changed.

    Raises:
        KhepTwinError: The task is unknown, or the playpen has no such goal.
        PlaypenError: The playpen cannot be used.
        ValueError: A number is out of range.
    """

    def __init__(
        self,
        task: Task | str,
        *,
        playpen: Playpen | str | None = None,
        robots: int = 1,
        noise: bool = True,
        vary: bool = False,
        period_ns: int = PERIOD_NS,
        seconds: float | None = None,
        compiled: bool | None = None,
        normalize: bool = True,
    ) -> None:
        if robots < 1:
            raise ValueError(f"{robots} robots; expected 1 or more")
        if period_ns <= 0 or period_ns % units.TICK_NS:
            raise ValueError(f"control period of {period_ns / 1e6:g} ms; expected whole ticks of 10 ms")
        self.task = find(task)
        given = self.task.playpen if playpen is None else playpen
        self.playpen = with_robots(given if isinstance(given, Playpen) else load(given), robots)
        self.noise, self.vary, self.period_ns, self.normalize = noise, vary, period_ns, normalize
        self.action_limit = 1.0 if normalize else TOP_SPEED
        self.seconds = self.task.seconds if seconds is None else seconds
        if not 0 < self.seconds < math.inf or to_ns(self.seconds) % period_ns:
            raise ValueError(
                f"seconds = {self.seconds}; expected one or more whole control periods of "
                f"{period_ns / 1e6:g} ms"
            )
        self.n_steps = n_steps(to_ns(self.seconds), period_ns)
        self.goal = _place_of(self.playpen, self.task.goal) if self.task.goal else (0.0, 0.0)
        self._compiled = compiled
        self._setup = EpisodeSetup(self.playpen, period_ns=period_ns)
        self.steps_per_period = self._setup.steps_per_period
        ambient = calibration.read(self.playpen.robots[0].calibration)[0].ambient
        self.dark, self.floor = ambient.dark_counts, ambient.floor_counts

    def episode(self) -> Episode:
        """Return the memory of an episode without a controller."""
        return Episode(self._setup, compiled=self._compiled)

    def speeds(self, action: object) -> tuple[float, float]:
        """Return an action as the speeds of left and right wheel, clipped to the top speed [pulses/10 ms].

        Raises:
            ValueError: The action is not two numbers.
        """
        limit = self.action_limit
        try:
            left, right = np.asarray(action, np.float64).tolist()
            left, right = (min(max(speed, -limit), limit) * (TOP_SPEED / limit) for speed in (left, right))
        except (TypeError, ValueError):
            raise ValueError(
                f"action {action!r}; expected two speeds, left and right, from {-limit:g} to {limit:g}"
            ) from None
        return left, right

    def started(self, seed: int) -> Playpen:
        """Return the playpen at the start of an episode.

        Raises:
            PlaypenError: There is no room for the robots.
        """
        return (anywhere if self.task.starts == "anywhere" else at_spots)(self.playpen, seed)


class TaskEpisode:
    """One episode at a time; `begin` starts a new one.

    Args:
        setup: Prepared task.
    """

    def __init__(self, setup: TaskSetup) -> None:
        self.setup = setup
        self._episode = setup.episode()
        self._n_robots = len(setup.playpen.robots)
        self._pulses = [[0, 0]] * self._n_robots
        self._charges_ns = [0] * self._n_robots
        self._steps = setup.n_steps

    def begin(self, seed: int) -> list[Observation]:
        """Start an episode; return each robot's observation.

        Raises:
            PlaypenError: There is no room for the robots.
            ValueError: The seed is negative or too large.
        """
        setup = self.setup
        robots = setup.started(seed).robots
        starts = [(robot.x_mm, robot.y_mm, robot.heading_deg) for robot in robots]
        self._episode.begin(seed, start=starts, noise=setup.noise, vary=setup.vary)
        self._steps = 0
        self._charges_ns = [to_ns(setup.task.charge_s)] * self._n_robots
        self._pulses = [self._counted(robot) for robot in range(self._n_robots)]
        states = [self._state(robot, (0.0, 0.0)) for robot in range(self._n_robots)]
        return [setup.task.observe(state, setup.normalize) for state in states]

    def step(self, actions: Sequence[object]) -> list[StepResult]:
        """Advance by a control period.

        Args:
            actions: Speeds of each robot's wheels, left and right, as parts of the top speed, or, if not
                normalized, in pulses/10 ms; clipped, and rounded to whole pulses.

        Raises:
            DivergedError: A speed is no number, or the physics left its bounds.
            ValueError: The episode is over, the number of actions is not that of the robots, or one of them
                is not two numbers.
        """
        if self.over:
            raise ValueError("the episode is over; expected begin() first")
        if len(actions) != self._n_robots:
            raise ValueError(f"{len(actions)} actions; expected {self._n_robots}, one for each robot")
        for robot, speeds in enumerate([self.setup.speeds(action) for action in actions]):
            self._episode.drive(*speeds, robot)
        self._episode.step(self.setup.steps_per_period)
        self._steps += 1
        return [self._outcome(robot) for robot in range(self._n_robots)]

    @property
    def over(self) -> bool:
        """True if the time is over, or no episode has begun."""
        return self._steps >= self.setup.n_steps

    @property
    def time_s(self) -> float:
        """Simulated time [s]."""
        return self._steps * self.setup.period_ns / 1e9

    @property
    def poses(self) -> Sequence[tuple[float, float, float]]:
        """True x, y [m] and heading [rad] of the robots."""
        return self._episode.poses

    @property
    def registers(self) -> Sequence[NDArray[np.int64]]:
        """Registers of each robot's board (N_REGISTERS,), live."""
        return list(self._episode.boards)

    @property
    def data(self) -> mujoco.MjData:
        """State of the scene, live."""
        return self._episode.data

    def _outcome(self, robot: int) -> StepResult:
        task, ticks = self.setup.task, self.setup.period_ns // units.TICK_NS
        before, self._pulses[robot] = self._pulses[robot], self._counted(robot)
        left, right = ((now - then) / ticks for now, then in zip(self._pulses[robot], before, strict=True))
        if task.charge_s:
            left_ns = max(self._charges_ns[robot] - self.setup.period_ns, 0)
            self._charges_ns[robot] = to_ns(task.charge_s) if self._at_goal(robot) else left_ns
        state = self._state(robot, (left, right))
        observation = task.observe(state, self.setup.normalize)
        return StepResult(observation, task.reward(state), bool(task.charge_s) and state.charge <= 0)

    def _state(self, robot: int, speed: tuple[float, float]) -> State:
        setup = self.setup
        full_ns = to_ns(setup.task.charge_s)
        charge = self._charges_ns[robot] / full_ns if full_ns else 1.0
        registers = self._episode.boards[robot].tolist()
        return State(registers, *speed, setup.dark, setup.floor, self._at_goal(robot), charge)

    def _at_goal(self, robot: int) -> bool:
        if not self.setup.task.goal:
            return False
        x, y, _ = self._episode.poses[robot]
        goal_x, goal_y = self.setup.goal
        reach = units.metres(self.setup.task.reach_mm)
        return (x - goal_x) ** 2 + (y - goal_y) ** 2 <= reach * reach

    def _counted(self, robot: int) -> list[int]:
        """Return the pulses of both encoders."""
        registers = self._episode.boards[robot]
        return [int(registers[index]) for index in _ENCODERS]


def with_robots(playpen: Playpen, count: int) -> Playpen:
    """Return the playpen with `count` copies of its first robot, not yet placed.

    Raises:
        PlaypenError: The playpen has no robot.
    """
    if not playpen.robots:
        raise PlaypenError(f"{playpen.name}: no robot; expected one to copy")
    first = playpen.robots[0].model_copy(update={"name": None} if count > 1 else {})
    return playpen.model_copy(update={"robots": (first,) * count})


def _place_of(playpen: Playpen, name: str) -> tuple[float, float]:
    """Return the position of a playpen's named patch or cylinder [m]."""
    positions = {
        item.name: (units.metres(item.x_mm), units.metres(item.y_mm))
        for item in (*playpen.patches, *playpen.cylinders)
        if item.name
    }
    if name not in positions:
        raise KhepTwinError(f"{playpen.name}: has no patch or cylinder {name!r}; {choices(name, positions)}")
    return positions[name]
