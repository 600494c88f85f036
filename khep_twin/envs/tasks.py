"""Tasks for reinforcement learning: playpen, observation and reward.

    ObstacleAvoidance   forwards, fast and straight, away from obstacles
    LoopingMaze         the same along a looping corridor (Floreano and Mondada 1994)
    LightSeeking        into the light of a lamp behind a screen (this project)
    Homing              fast, away from obstacles, and to the charger in time (Floreano and Mondada 1996)
    WallOrCylinder      find the cylinder and stay beside it, and not beside a wall (Nolfi 1996)

A reward is that of one control period, 0 to 1. Published rewards are those of `khep_twin.episodes.fitness`,
with speeds counted by the wheels' encoders instead of setpoints. To define a task, create a `Task`, e.g. by
`dataclasses.replace(TASKS["Homing"], charge_s=30.0)`.

Models of robots may add tasks and observation terms (`RobotModel.tasks`, `robots.model.Term`). A task runs
with any model that has its terms: that of its playpen's robot.

A reward is a function of the `State` of one robot or, if it is marked by `batched`, of a state with arrays of
all robots. Observations are computed for all robots together.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cache, partial
from typing import Any, Literal, TypeVar, get_args

import numpy as np
from numpy.typing import NDArray

from khep_twin.envs.arguments import check_choice, is_number
from khep_twin.episodes import fitness
from khep_twin.episodes.fitness import Number
from khep_twin.errors import KhepTwinError, RobotModelError, choices, value_text
from khep_twin.robots.model import Interface
from khep_twin.robots.registry import default_model, find_family, installed_models

Starts = Literal["anywhere", "playpen"]
Observation = NDArray[np.float32]


@dataclass(frozen=True, slots=True)
class State:
    """One robot at the end of a control period, or n robots: then each number is an array (n,).

    Attributes:
        registers: Registers of the robot (n_registers,), or of each (n_registers, n).
        left: Speed of the left wheel over the period, as counted by its encoder, in the unit of the robot's
            register; a Khepera's is pulses/10 ms.
        right: Speed of the right wheel.
        dark: Ambient reading in the dark [counts].
        floor: Ambient reading in the brightest light [counts].
        at_goal: Whether the robot is at the goal.
        charge: Charge left, 1 to 0.
        model: Family of the robot.
    """

    registers: NDArray[np.int64]
    left: Number
    right: Number
    dark: Number
    floor: Number
    at_goal: Any
    charge: Number
    model: str = default_model().family

    @property
    def interface(self) -> Interface:
        """Registers of the robot."""
        return find_family(self.model).episode_interface

    def read(self, term: str) -> Any:
        """Return the readings of an observation term (n,), or of n_robots (n, n_robots)."""
        return terms_of(self.model)[term].read(self)

    @property
    def fitness_speeds(self) -> tuple[Number, Number]:
        """Speeds of both wheels as `khep_twin.episodes.fitness` needs them."""
        scale = fitness.TOP_SPEED_PULSES / self.interface.top_speed
        return self.left * scale, self.right * scale

    @property
    def nearest(self) -> Number:
        """Largest proximity reading, 0 to 1."""
        interface = self.interface
        counts = np.maximum(self.registers[slice(*interface.proximity)].max(axis=0) - interface.counts[0], 0)
        return counts / (interface.counts[1] - interface.counts[0])

    @property
    def brightness(self) -> Number:
        """Light at the brightest receiver, 0 to 1."""
        lowest = self.registers[slice(*self.interface.ambient)].min(axis=0)
        return fitness.light_seeking(lowest, self.dark, self.floor)

    def of_robot(self, index: int) -> "State":
        """Return the state of one of n robots."""
        numbers = (self.left, self.right, self.dark, self.floor, self.charge)
        left, right, dark, floor, charge = (float(number[index]) for number in numbers)
        registers, at_goal = self.registers[:, index].copy(), bool(self.at_goal[index])
        return State(registers, left, right, dark, floor, at_goal, charge, self.model)


Reward = Callable[[State], Number]
"""Function of a state that returns the reward of a control period, 0 to 1."""
RewardType = TypeVar("RewardType", bound=Reward)

RewardParts = Callable[[State], Mapping[str, Number]]
"""Function of a state of n robots that returns the parts of their rewards by name, (n,) each."""

_BATCHED_REWARDS: list[Reward] = []
_PARTS: dict[Reward, RewardParts] = {}


def batched(reward: RewardType) -> RewardType:
    """Mark a reward that also accepts a state of n robots, for which it returns (n,); return the reward."""
    _BATCHED_REWARDS.append(reward)
    return reward


def with_parts(parts: RewardParts) -> Callable[[RewardType], RewardType]:
    """Mark a reward with its parts, which `info` holds as "reward_parts" with `details`."""

    def mark(reward: RewardType) -> RewardType:
        _PARTS[reward] = parts
        return reward

    return mark


@dataclass(frozen=True, slots=True)
class ObservationTerm:
    """Part of an observation: numbers that are clipped to a range, and normalized to -1 to 1.

    Attributes:
        read: Function that returns the numbers of a state (n,), or of n_robots (n, n_robots).
        names: Names of the numbers (n,).
        low: Lower bound, normalized to -1 [unit].
        high: Upper bound, normalized to 1 [unit].
        unit: Unit of the numbers.
        ends: Function that returns the values normalized to -1 and 1, if these are not `low` and `high`.
    """

    read: Callable[[State], Any]
    names: tuple[str, ...]
    low: float
    high: float
    unit: str
    ends: Callable[[State], tuple[float, float]] | None = None

    def bounds(self, normalize: bool) -> tuple[float, float]:
        """Return the lower and upper bound of each number."""
        return (-1.0, 1.0) if normalize else (self.low, self.high)

    def observe(self, state: State, normalize: bool) -> NDArray[np.float64]:
        """Return the numbers of a state, within the bounds (n,), or (n, n_robots)."""
        numbers = np.asarray(self.read(state), np.float64)
        if normalize:
            start, end = self.ends(state) if self.ends else (self.low, self.high)
            numbers = (numbers - start) * (2 / (end - start)) - 1
        low, high = self.bounds(normalize)
        return np.minimum(np.maximum(numbers, low), high)


@cache
def terms_of(family: str) -> Mapping[str, ObservationTerm]:
    """Return the observation terms of a family of robots, by name.

    Raises:
        RobotModelError: The family is unknown, or runs in no episodes.
    """
    model = find_family(family)
    interface = model.episode_interface
    sensors, limit, top_speed = model.body.cameras, float(interface.counts[1]), interface.top_speed
    terms = {
        "proximity": ObservationTerm(
            lambda state: state.registers[slice(*interface.proximity)],
            sensors[: interface.n_proximity],
            0.0,
            limit,
            "counts",
        ),
        "light": ObservationTerm(
            lambda state: state.registers[slice(*interface.ambient)],
            sensors[: interface.n_ambient],
            0.0,
            limit,
            "counts, low in the light",
            lambda state: (state.dark, state.floor),
        ),
        "speed": ObservationTerm(
            lambda state: (state.left, state.right),
            ("left", "right"),
            -top_speed,
            top_speed,
            f"{model.channels['speed'][0][1]}, counted over the period",
        ),
        "charge": ObservationTerm(
            lambda state: (state.charge,), ("charge",), 0.0, 1.0, "part of a full charge"
        ),
    }
    for term in model.terms:
        read = partial(_read_registers, slice(*term.registers))
        terms[term.name] = ObservationTerm(read, term.names, term.low, term.high, term.unit)
    return terms


def _read_registers(registers: slice, state: State) -> NDArray[np.int64]:
    return state.registers[registers]


TERMS = terms_of(default_model().family)
"""Observation terms of a Khepera."""


@dataclass(frozen=True, slots=True)
class Task:
    """A task.

    Attributes:
        name: Name of the task, one word.
        playpen: Name or path of the playpen.
        observation_terms: Names of the observation's parts, keys of `terms_of` the model.
        reward: Reward of a control period, 0 to 1.
        seconds: Time limit of an episode [s].
        starts: "anywhere" for any free position, or "playpen" for the robot's pose or one of its spots.
        goal: Name of the playpen's patch or cylinder that is the robot's goal; none if empty.
        reach_mm: Largest distance of the robot's centre from the goal's centre at the goal [mm].
        charge_s: Duration of a charge [s], recharged at the goal; the episode is terminated when it is empty.
            0 for no limit.
        model: Family of the robot; an environment sets it to that of its playpen.
    """

    name: str
    playpen: str
    observation_terms: tuple[str, ...]
    reward: Reward
    seconds: float = 60.0
    starts: Starts = "anywhere"
    goal: str = ""
    reach_mm: float = 0.0
    charge_s: float = 0.0
    model: str = default_model().family

    def __post_init__(self) -> None:
        """Check the values.

        Raises:
            KhepTwinError: An observation term is unknown, or there is none, or a value is out of range.
        """
        for key in ("name", "playpen", "goal"):
            if not isinstance(getattr(self, key), str):
                text = value_text(getattr(self, key))
                raise KhepTwinError(f"task {value_text(self.name)}: {key} = {text}; expected a text")
        check_choice(f"task {self.name}: starts", self.starts, get_args(Starts))
        if not callable(self.reward):
            text = value_text(self.reward)
            raise KhepTwinError(f"task {self.name}: reward = {text}; expected a function of a State")
        for name, value in (("reach_mm", self.reach_mm), ("charge_s", self.charge_s)):
            if not is_number(value, high=1e9):
                raise KhepTwinError(
                    f"task {self.name}: {name} = {value_text(value)}; expected a finite number from 0"
                )
        if not isinstance(self.observation_terms, list | tuple):  # pyright: ignore[reportUnnecessaryIsInstance]
            text = value_text(self.observation_terms)
            raise KhepTwinError(f"task {self.name}: observation_terms = {text}; expected a tuple of texts")
        for term in self.observation_terms:
            check_choice(f"task {self.name}: model {self.model}: observation term", term, self.terms)
        if not self.observation_terms:
            raise KhepTwinError(f"task {self.name}: no observation terms; {choices('', self.terms)}")

    @property
    def terms(self) -> Mapping[str, ObservationTerm]:
        """Observation terms of the model."""
        return terms_of(self.model)

    @property
    def top_speed(self) -> float:
        """Top speed of a wheel in an action, forwards and backwards [register]."""
        return find_family(self.model).episode_interface.top_speed

    @property
    def labels(self) -> tuple[str, ...]:
        """Labels of an observation's numbers (n,), e.g. "proximity left_90"."""
        return tuple(f"{term} {name}" for term in self.observation_terms for name in self.terms[term].names)

    def bounds(self, normalize: bool = True) -> tuple[Observation, Observation]:
        """Return the lower and upper bounds of an observation (n,), (n,)."""
        terms = [self.terms[name] for name in self.observation_terms]
        bounds = [term.bounds(normalize) for term in terms for _ in term.names]
        low, high = np.array(bounds, np.float32).T
        return low, high

    def observe(self, state: State, normalize: bool = True) -> Observation:
        """Return the observation (n,), in the order of `labels`, or that of each robot (n_robots, n)."""
        parts = [self.terms[name].observe(state, normalize) for name in self.observation_terms]
        return np.concatenate(parts).T.astype(np.float32, order="C")

    def rewards(self, state: State) -> NDArray[np.float64]:
        """Return the reward of each of n robots (n,)."""
        if self.reward in _BATCHED_REWARDS:
            return np.asarray(self.reward(state), np.float64)
        rewards = (self.reward(state.of_robot(index)) for index in range(len(state.left)))
        return np.array([float(reward) for reward in rewards])

    def reward_parts(self, state: State) -> dict[str, NDArray[np.float64]]:
        """Return the parts of the reward of n robots by name, (n,) each; empty if there are none."""
        if self.reward not in _PARTS:
            return {}
        return {name: np.asarray(part, np.float64) for name, part in _PARTS[self.reward](state).items()}


def _parts_of_avoiding_either_way(state: State) -> dict[str, Number]:
    top_speed = state.interface.top_speed
    left, right = (np.clip(speed / top_speed, -1, 1) for speed in (state.left, state.right))
    return {
        "speed": (abs(left) + abs(right)) / 2,
        "straightness": 1 - np.sqrt(abs(left - right) / 2),
        "clearance": 1 - state.nearest,
    }


def _parts_of_avoiding(state: State) -> dict[str, Number]:
    return {**_parts_of_avoiding_either_way(state), "forwards": state.left + state.right > 0}


def _parts_of_homing(state: State) -> dict[str, Number]:
    parts = _parts_of_avoiding_either_way(state)
    return {name: parts[name] for name in ("speed", "clearance")} | {"away": np.logical_not(state.at_goal)}


@with_parts(_parts_of_avoiding)
@batched
def avoiding(state: State) -> Number:
    """Return V (1 - sqrt(dV)) (1 - i) forwards, 0 backwards.

    Floreano and Mondada's V has no sign, so learners may drive back and forth, which also avoids obstacles.
    """
    return avoiding_either_way(state) * (state.left + state.right > 0)


@with_parts(_parts_of_avoiding_either_way)
@batched
def avoiding_either_way(state: State) -> Number:
    """Return V (1 - sqrt(dV)) (1 - i) as published: see `fitness.obstacle_avoidance`."""
    return fitness.obstacle_avoidance(*state.fitness_speeds, state.nearest)


@with_parts(lambda state: {"brightness": state.brightness})
@batched
def seeking_light(state: State) -> Number:
    """Return the brightness."""
    return state.brightness


@with_parts(_parts_of_homing)
@batched
def homing(state: State) -> Number:
    """Return V (1 - i) away from home, 0 at home."""
    return fitness.homing(*state.fitness_speeds, state.nearest) * np.logical_not(state.at_goal)


@with_parts(lambda state: {"at_goal": state.at_goal})
@batched
def staying(state: State) -> Number:
    """Return 1 at the goal, 0 elsewhere."""
    return state.at_goal * 1.0


TASKS = {
    task.name: task
    for task in (
        Task("ObstacleAvoidance", "obstacles", ("proximity", "speed"), avoiding),
        Task("LoopingMaze", "looping-maze", ("proximity", "speed"), avoiding, starts="playpen"),
        Task("LightSeeking", "light-seeking", ("proximity", "light", "speed"), seeking_light),
        Task(
            "Homing",
            "homing",
            ("proximity", "light", "speed", "charge"),
            homing,
            starts="playpen",
            goal="charger",
            reach_mm=80.0,
            charge_s=20.0,  # the simulated accumulator of the paper
        ),
        Task(
            "WallOrCylinder",
            "wall-or-cylinder",
            ("proximity", "speed"),
            staying,
            starts="playpen",
            goal="target",
            reach_mm=65.0,  # 25 mm from edge to edge (assumed)
        ),
    )
}
"""Built-in tasks, by name."""


def speeds_of(action: object, top_speed: float, normalize: bool = True) -> NDArray[np.float64]:
    """Return an action, or several, as speeds of the same shape, clipped to the top speed [register].

    Args:
        action: Speeds of the left and right wheel (..., 2).
        top_speed: Top speed [register].
        normalize: Whether they are fractions of the top speed, -1 to 1.

    Raises:
        ValueError: The action is not two numbers.
    """
    limit = 1.0 if normalize else top_speed
    try:
        speeds = np.asarray(action, np.float64)
    except (TypeError, ValueError, OverflowError):
        speeds = np.zeros(0)
    if speeds.shape[-1:] != (2,):
        raise ValueError(
            f"action {value_text(action)}; expected two speeds, left and right, from {-limit:g} to {limit:g}"
        )
    return np.minimum(np.maximum(speeds, -limit), limit) * (top_speed / limit)


def task_names() -> list[str]:
    """Return the names of all tasks, built-in ones and those of models."""
    return [*TASKS, *(name for model in installed_models().values() for name in model.tasks)]


def find_task(task: Task | str) -> Task:
    """Return a task by name.

    Raises:
        KhepTwinError: The name is unknown, or the task of a model cannot be loaded.
    """
    if isinstance(task, Task):
        return task
    check_choice("task", task, task_names())
    if task in TASKS:
        return TASKS[task]
    (model,) = (model for model in installed_models().values() if task in model.tasks)
    if not isinstance(model_task := model.load_task(task), Task):
        raise RobotModelError(f"model {model.name}: task {task} is {model_task!r}; expected a Task")
    return model_task
