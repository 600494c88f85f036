"""Tasks for the Khepera IV as Gymnasium environments (extra `rl`).

    import gymnasium, khep_twin

    environment = gymnasium.make("khep_twin/KheperaIVObstacleAvoidance-v0")
    observation, info = environment.reset(seed=1)
    observation, reward, terminated, truncated, info = environment.step(environment.action_space.sample())

Tasks, each with the terms of its observation (`TERMS`):

    KheperaIVObstacleAvoidance   proximity, ultrasonic, speed   fast and straight, clear of obstacles (arena4)
    KheperaIVLineFollowing       ground, speed, gyroscope       fast along a black line (arena4-line)

Observations are normalized to -1 to 1. An action is the speeds of left and right wheel, -1 to 1, as setpoints
of the dsPIC's speed control; 1 is 600 pulses/10 ms, 407 mm/s. An episode is truncated at its time limit, and
terminates when the robot has fallen.
"""

# Gymnasium's spaces are only partly typed.
# pyright: reportMissingTypeStubs=false, reportUnknownMemberType=false

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from khep_twin.copies import CopiedByArguments
from khep_twin.envs.arguments import (
    check_choice,
    check_mapping,
    check_period,
    check_switch,
    count_periods,
)
from khep_twin.envs.gymnasium import RENDER_MODES, open_window, render_metadata
from khep_twin.envs.registration import TimeLimitedSpec
from khep_twin.envs.renderer import Picture
from khep_twin.envs.reset_options import validate_playpen, validate_seed
from khep_twin.episodes import fitness
from khep_twin.episodes.episode_options import check_numbers
from khep_twin.errors import MissingExtraError, PlaypenError
from khep_twin.playpen import Playpen, PlaypenLike
from khep_twin.playpen.starts import Start, anywhere, at_spots
from khep_twin.robots.khepera4.infrared import N_AROUND
from khep_twin.robots.khepera4.registers import Control, DspicRegister
from khep_twin.robots.khepera4.robot import Khepera4Robot
from khep_twin.units import COUNTS_LIMIT, TICK_NS
from khep_twin.world import World

try:
    import gymnasium
    from gymnasium.spaces import Box
except ModuleNotFoundError as error:
    raise MissingExtraError("gymnasium", "rl") from error

TOP_SPEED_PULSES = 600
"""Speed of a wheel for an action of 1 [pulses/10 ms]: 407 mm/s, half of the robot's top speed (assumed)."""

TOP_RATE_COUNTS = 8_000
"""Rate of turn about the vertical for an observation of 1 [gyroscope counts]: 528 deg/s (assumed)."""

_FALL_HEIGHT = 0.02
"""Height below its start at which a robot counts as fallen [m]."""

_MAX_RANGE_CM = 250

_START = "x, y [mm] and heading [deg]"

TermReader = Callable[[Khepera4Robot, tuple[float, float]], Sequence[float]]

TERMS: dict[str, tuple[int, TermReader]] = {
    "proximity": (N_AROUND, lambda robot, speeds: _infrared(robot, 0, N_AROUND)),
    "ground": (4, lambda robot, speeds: _infrared(robot, N_AROUND, 4)),
    "ultrasonic": (5, lambda robot, speeds: _distances(robot)),
    "speed": (2, lambda robot, speeds: [speed / TOP_SPEED_PULSES for speed in speeds]),
    "gyroscope": (1, lambda robot, speeds: [_turn_rate(robot) / TOP_RATE_COUNTS]),
}
"""Size and reader of each term of an observation: proximity around and of the floor in the order of the
registers, 1 for the maximum; distances, 1 for 2.5 m and without an echo, -1 below 25 cm; speeds from the
encoders over the period; the last rate of turn to the left."""


@dataclass(frozen=True, slots=True)
class Khepera4Task:
    """A task for the Khepera IV.

    Attributes:
        playpen: Name of its playpen.
        terms: Terms of its observation.
        reward: Function of the observation's terms by name that returns the reward of a period, 0 to 1.
        anywhere: Whether an episode starts anywhere; otherwise at the playpen's start.
    """

    playpen: str
    terms: tuple[str, ...]
    reward: Callable[[dict[str, Sequence[float]]], float]
    anywhere: bool = True


def _avoidance(terms: dict[str, Sequence[float]]) -> float:
    """Return Floreano and Mondada's V (1 - sqrt(dV)) (1 - i), forwards; i is 0 without objects."""
    left, right = (speed * fitness.TOP_SPEED_PULSES for speed in terms["speed"])
    if left + right <= 0:
        return 0.0
    background = 100 / COUNTS_LIMIT  # reading without objects
    nearest = max(((max(terms["proximity"]) + 1) / 2 - background) / (1 - background), 0.0)
    return float(fitness.obstacle_avoidance(left, right, min(nearest, 1.0)))


def _line_following(terms: dict[str, Sequence[float]]) -> float:
    """Return the forward speed if a front ground sensor sees the line, otherwise 0."""
    _, left, right, _ = terms["ground"]
    return max(sum(terms["speed"]) / 2, 0.0) if min(left, right) < 0 else 0.0


TASKS = {
    "KheperaIVObstacleAvoidance": Khepera4Task("arena4", ("proximity", "ultrasonic", "speed"), _avoidance),
    "KheperaIVLineFollowing": Khepera4Task(
        "arena4-line", ("ground", "speed", "gyroscope"), _line_following, anywhere=False
    ),
}
"""Tasks by name."""


class KheperaIVEnvironment(  # pyright: ignore[reportIncompatibleVariableOverride]
    TimeLimitedSpec, CopiedByArguments, gymnasium.Env[NDArray[np.float32], NDArray[np.float32]]
):
    """A task for one Khepera IV in MuJoCo.

    `info` has ground truth: "x" and "y" [m], "heading" [rad], "time" [s], and "seed", which repeats the
    episode: `reset(options={"seed": ...})`.

    Args:
        task: Name of the task.
        playpen: Playpen in place of the task's, whose only robot is a Khepera IV.
        start: Start x, y [mm] and heading [deg] in place of the task's.
        noise: Whether sensors are noisy.
        vary: Whether each episode draws another robot of the same model.
        period_ns: Control period [ns], whole ticks of 10 ms.
        seconds: Time limit [s].
        render_mode: "rgb_array" for maps, "human" for a window that shows them in real time, or None.

    Attributes:
        labels: Labels of the observation's numbers.
        max_episode_steps: Time limit of an episode in steps, also that of `spec`.

    Raises:
        KhepTwinError: The task or the render mode is unknown.
        PlaypenError: The playpen's only robot is no Khepera IV.
        ValueError: The period is not in whole ticks, or the time not in whole periods.
    """

    COPIED_ATTRIBUTES = ("_spec", "_np_random", "_np_random_seed")
    metadata: dict[str, Any] = {"render_modes": list(RENDER_MODES), "render_fps": 20}  # noqa: RUF012

    def __init__(
        self,
        task: str = "KheperaIVObstacleAvoidance",
        *,
        playpen: PlaypenLike | None = None,
        start: Start | None = None,
        noise: bool = True,
        vary: bool = False,
        period_ns: int = 5 * TICK_NS,
        seconds: float = 60.0,
        render_mode: str | None = None,
    ) -> None:
        check_choice("task", task, TASKS)
        period_ns = check_period(period_ns)
        self.metadata = render_metadata(render_mode, period_ns)
        self.max_episode_steps = count_periods(seconds, period_ns)
        check_switch("noise", noise)
        check_switch("vary", vary)
        if start is not None:
            check_numbers("start", start, _START, (3,))
        self._task = TASKS[task]
        self._start = start
        self._noise = noise
        self._vary = vary
        self._playpen = Playpen.load(validate_playpen(self._task.playpen if playpen is None else playpen))
        if [robot.model for robot in self._playpen.robots] != ["khepera4"]:
            raise PlaypenError(f"{self._playpen.name}: robots; expected one Khepera IV")
        self._period_ns = period_ns
        self._world = World(self._playpen)
        self._steps_left = 0
        term_sizes = [(term, TERMS[term][0]) for term in self._task.terms]
        self.labels = tuple(f"{term} {index}" for term, size in term_sizes for index in range(size))
        self.render_mode = render_mode
        self._window = open_window(render_mode, self.metadata)
        self.observation_space = Box(-1.0, 1.0, (len(self.labels),), np.float32)
        self.action_space = Box(-1.0, 1.0, (2,), np.float32)
        self._map: Any = None

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.float32], dict[str, Any]]:
        """Start an episode; a seed makes it and all later ones reproducible.

        Args:
            seed: Seed of this and all later episodes.
            options: "seed" of only this episode, and its "start".
        """
        super().reset(seed=seed)
        drawn_seed = int(self.np_random.integers(2**31))
        options = {**check_mapping("options", options)}
        for name in options:
            check_choice("options:", name, ("seed", "start"))
        requested_seed = options.get("seed")
        self._seed = drawn_seed if requested_seed is None else validate_seed(requested_seed)
        start: Start | None = options.get("start")
        if start is None:
            start = self._start
        else:
            check_numbers("start", start, _START, (3,))
        if start is None:
            robot = (anywhere if self._task.anywhere else at_spots)(self._playpen, self._seed).robots[0]
            start = robot.x_mm, robot.y_mm, robot.heading_deg
        self._world.reset(self._seed, noise=self._noise, vary=self._vary, starts=[start])
        self._start_height = float(self._world.data.qpos[2])
        self._steps_left = self.max_episode_steps
        self._wheel_pulses = 0, 0
        self._robot.dspic.write(bytes([DspicRegister.CONTROL, Control.SPEED]))
        self._show()
        return self._observe((0.0, 0.0))[0], self._info()

    def step(
        self, action: NDArray[np.float32]
    ) -> tuple[NDArray[np.float32], float, bool, bool, dict[str, Any]]:
        """Advance by a control period with these speeds of left and right wheel (2,).

        Raises:
            ValueError: No episode is running, or the action is not two numbers.
        """
        if self._steps_left <= 0:
            raise ValueError("the episode is over, or none has begun; expected reset() first")
        check_numbers("action", action, "two speeds, left and right, from -1 to 1", (2,))
        commands = np.asarray(action, np.float64)
        speed_setpoints = np.rint(np.clip(commands, -1, 1) * TOP_SPEED_PULSES).astype("<i2")
        self._robot.dspic.write(bytes([DspicRegister.SPEED_ORDER_LEFT]) + speed_setpoints.tobytes())
        self._world.advance_to(self._world.time_ns + self._period_ns)
        self._steps_left -= 1
        previous_pulses = self._wheel_pulses
        _, (left, right, *_), _ = self._robot.dspic.motor_numbers
        self._wheel_pulses = left, right
        ticks = self._period_ns // TICK_NS
        speeds = (left - previous_pulses[0]) / ticks, (right - previous_pulses[1]) / ticks
        observation, terms = self._observe(speeds)
        has_fallen = float(self._world.data.qpos[2]) < self._start_height - _FALL_HEIGHT
        if has_fallen:
            self._steps_left = 0
        self._show()
        is_truncated = not has_fallen and self._steps_left == 0
        return observation, self._task.reward(terms), has_fallen, is_truncated, self._info()

    def render(self) -> Picture | None:  # pyright: ignore[reportIncompatibleMethodOverride]
        """Return a map of the present state in mode "rgb_array"; otherwise None."""
        return self._picture() if self.render_mode == "rgb_array" else None

    def close(self) -> None:
        """Close the window."""
        if self._window is not None:
            self._window.close()

    def _show(self) -> None:
        if self._window is not None:
            self._window.show(self._picture())

    def _picture(self) -> Picture:
        if self._map is None:
            from khep_twin.drawing.moving_map import MovingMap

            self._map = MovingMap(self._world.playpen)
        objects = [(x, y, heading) for x, y, heading in self._world.objects.tolist()]
        return self._map.picture(self._world.poses, objects)

    @property
    def _robot(self) -> Khepera4Robot:
        robot = self._world.robots[0]
        assert isinstance(robot, Khepera4Robot)
        return robot

    def _observe(self, speeds: tuple[float, float]) -> tuple[NDArray[np.float32], dict[str, Sequence[float]]]:
        """Return the observation, and its terms by name."""
        terms = {term: TERMS[term][1](self._robot, speeds) for term in self._task.terms}
        numbers = np.array([value for term in terms.values() for value in term])
        return np.clip(numbers, -1, 1).astype(np.float32), terms

    def _info(self) -> dict[str, Any]:
        x, y, heading = self._world.poses[0]
        return {"x": x, "y": y, "heading": heading, "time": self._world.time_ns / 1e9, "seed": self._seed}


def _infrared(robot: Khepera4Robot, first: int, count: int) -> list[float]:
    """Return the readings of `count` infrared sensors, scaled to -1 to 1."""
    readings = robot.dspic.read_words(DspicRegister.PROXIMITY, first + count)[first:]
    return [2 * counts / COUNTS_LIMIT - 1 for counts in readings]


def _distances(robot: Khepera4Robot) -> list[float]:
    """Return the ultrasonic distances, scaled to -1 to 1."""
    readings = robot.dspic.read_words(DspicRegister.ULTRASONIC, TERMS["ultrasonic"][0])
    return [2 * min(cm, _MAX_RANGE_CM) / _MAX_RANGE_CM - 1 for cm in readings]


def _turn_rate(robot: Khepera4Robot) -> int:
    """Return the newest rate of turn to the left [0.066 deg/s]."""
    (word,) = robot.dspic.read_words(DspicRegister.GYROSCOPE + 40, 1)
    return word - (word >> 15 << 16)  # two's complement
