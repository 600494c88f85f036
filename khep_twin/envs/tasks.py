"""Tasks: what a robot is to learn, where, what it sees, and what it is rewarded for.

    ObstacleAvoidance   forwards, fast, straight and clear of things, among obstacles
    LoopingMaze         the same along a corridor without an end (Floreano and Mondada 1994)
    LightSeeking        into the light of a lamp behind a screen (ours)
    Homing              fast and clear of things, and back to the charger in time (Floreano and Mondada 1996)
    WallOrCylinder      find the cylinder and stay beside it, and not beside a wall (Nolfi 1996)

A reward is that of one control period, 0 to 1; the rewards of the classics are those of
`khep_twin.rollout.fitness`, with the speeds that the wheels' encoders have counted, not those that were asked
for.
A task of your own is one more `Task`, e.g. `dataclasses.replace(TASKS["Homing"], charge_s=30.0)`.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from khep_twin.board.kernel import AMBIENT, PROXIMITY
from khep_twin.errors import KhepTwinError, choices
from khep_twin.rollout import fitness
from khep_twin.units import COUNTS_LIMIT, Sensor

Observation = NDArray[np.float32]


@dataclass(frozen=True, slots=True)
class Moment:
    """One robot at the end of a control period.

    Attributes:
        registers: of its board (N_REGISTERS,).
        left: speed of the wheel over the period, as counted by its encoder [pulses/10 ms].
        right: likewise.
        dark: ambient reading in the dark [counts].
        floor: in the brightest light.
        at_goal: whether it is where the task wants it.
        charge: what is left of its charge, 1 to 0.
    """

    registers: Sequence[int]
    left: float
    right: float
    dark: float
    floor: float
    at_goal: bool
    charge: float

    @property
    def nearest(self) -> float:
        """The largest proximity reading, 0 to 1."""
        return max(self.registers[index] for index in PROXIMITY) / COUNTS_LIMIT

    @property
    def brightness(self) -> float:
        """How brightly the receiver that sees most light is lit, 0 to 1."""
        darkest = min(self.registers[index] for index in AMBIENT)
        return fitness.light_seeking(float(darkest), self.dark, self.floor)


@dataclass(frozen=True, slots=True)
class Sense:
    """A part of what a robot sees, a row of numbers within bounds.

    Attributes:
        read: the numbers of a moment (n,).
        names: of each of them (n,).
        low: none is below.
        high: none is above.
        unit: what 1 means.
    """

    read: Callable[[Moment], Sequence[float]]
    names: tuple[str, ...]
    low: float
    high: float
    unit: str


def _proximity(moment: Moment) -> Sequence[float]:
    return [moment.registers[index] / COUNTS_LIMIT for index in PROXIMITY]


def _light(moment: Moment) -> Sequence[float]:
    dark, floor = moment.dark, moment.floor
    return [min(max((dark - moment.registers[index]) / (dark - floor), 0.0), 1.0) for index in AMBIENT]


def _speed(moment: Moment) -> Sequence[float]:
    top = float(fitness.TOP_SPEED_PULSES)
    return [min(max(pulses / top, -1.0), 1.0) for pulses in (moment.left, moment.right)]


def _charge(moment: Moment) -> Sequence[float]:
    return [moment.charge]


_SENSORS = tuple(sensor.name.lower() for sensor in Sensor)

SENSES = {
    "proximity": Sense(_proximity, _SENSORS, 0.0, 1.0, "1023 counts of command N"),
    "light": Sense(_light, _SENSORS, 0.0, 1.0, "from the dark reading of command O to the brightest one"),
    "speed": Sense(_speed, ("left", "right"), -1.0, 1.0, "20 pulses/10 ms, 160 mm/s, counted, cut"),
    "charge": Sense(_charge, ("charge",), 0.0, 1.0, "a full charge"),
}
"""All that a task may let a robot see, in the order of an observation."""

TOP_SPEED = float(fitness.TOP_SPEED_PULSES)
"""What an action may ask of a wheel, forwards and backwards [pulses/10 ms]: 160 mm/s."""


@dataclass(frozen=True, slots=True)
class Task:
    """A task.

    Attributes:
        name: of the task, in one word.
        playpen: name or path of where it is.
        senses: what the robot sees, of `SENSES`.
        reward: of a control period, 0 to 1.
        seconds: how long a trial lasts at most [s].
        starts: "anywhere" there is room, or as the "playpen" has it: in its place or at one of its spots.
        goal: name of the playpen's patch or cylinder that is the robot's goal; none if empty.
        reach_mm: how near to the goal's centre the robot's centre is at the goal [mm].
        charge_s: how long a charge lasts, full again at the goal; a trial ends without any [s]. 0 for always.
    """

    name: str
    playpen: str
    senses: tuple[str, ...]
    reward: Callable[[Moment], float]
    seconds: float = 60.0
    starts: Literal["anywhere", "playpen"] = "anywhere"
    goal: str = ""
    reach_mm: float = 0.0
    charge_s: float = 0.0

    def __post_init__(self) -> None:
        """Refuses senses that there are not.

        Raises:
            KhepTwinError: a sense is unknown, or there is none.
        """
        for sense in self.senses:
            if sense not in SENSES:
                raise KhepTwinError(f"task {self.name}: sense {sense!r}: unknown; {choices(sense, SENSES)}")
        if not self.senses:
            raise KhepTwinError(f"task {self.name}: no senses; {choices('', SENSES)}")

    @property
    def labels(self) -> tuple[str, ...]:
        """Of an observation's numbers (n,), e.g. "proximity left_90"."""
        return tuple(f"{sense} {name}" for sense in self.senses for name in SENSES[sense].names)

    @property
    def bounds(self) -> tuple[Observation, Observation]:
        """What an observation's numbers are not below and not above (n,), (n,)."""
        senses = [SENSES[name] for name in self.senses]
        sizes = [len(sense.names) for sense in senses]
        low, high = ([sense.low for sense in senses], [sense.high for sense in senses])
        return np.repeat(np.array(low, np.float32), sizes), np.repeat(np.array(high, np.float32), sizes)

    def observe(self, moment: Moment) -> Observation:
        """What the robot sees (n,), in the order of `labels`."""
        numbers: list[float] = []
        for name in self.senses:
            numbers += SENSES[name].read(moment)
        return np.array(numbers, np.float32)


def avoiding(moment: Moment) -> float:
    """V (1 - sqrt(dV)) (1 - i) forwards, nothing backwards.

    Floreano and Mondada's V has no sign. By that, learners find that to and fro is clear of things, too.
    """
    return avoiding_either_way(moment) if moment.left + moment.right > 0 else 0.0


def avoiding_either_way(moment: Moment) -> float:
    """V (1 - sqrt(dV)) (1 - i) as published: see `fitness.obstacle_avoidance`."""
    return fitness.obstacle_avoidance(moment.left, moment.right, moment.nearest)


def seeking_light(moment: Moment) -> float:
    """How bright it is."""
    return moment.brightness


def homing(moment: Moment) -> float:
    """V (1 - i) away from home, nothing at home."""
    return 0.0 if moment.at_goal else fitness.homing(moment.left, moment.right, moment.nearest)


def staying(moment: Moment) -> float:
    """1 at the goal, 0 elsewhere."""
    return float(moment.at_goal)


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
"""The tasks that ship with the package, by name."""


def find(task: Task | str) -> Task:
    """A task by name.

    Raises:
        KhepTwinError: there is none.
    """
    if isinstance(task, Task):
        return task
    if task not in TASKS:
        raise KhepTwinError(f"task {task!r}: unknown; {choices(task, TASKS)}")
    return TASKS[task]
