"""A task prepared for episodes: its playpen, goal, divisions of time, and units of actions.

Actions and observations are normalized to -1 to 1, or, with `TaskSetup(..., normalize=False)`, in the units
of the robot: pulses/10 ms, and counts.
"""

import math
import operator
from collections.abc import Mapping
from typing import SupportsIndex, TypeVar

import numpy as np
from numpy.typing import NDArray

from khep_twin import units
from khep_twin.clock import n_steps, to_ns
from khep_twin.copies import MadeAnew
from khep_twin.envs.tasks import TOP_SPEED, Task, find
from khep_twin.episodes.episode import Episode
from khep_twin.episodes.episode_options import checked_count
from khep_twin.episodes.episode_setup import EpisodeSetup
from khep_twin.errors import KhepTwinError, PlaypenError, choices
from khep_twin.playpen import Playpen, PlaypenLike
from khep_twin.playpen.starts import anywhere, at_spots
from khep_twin.randomness import SEED_LIMIT
from khep_twin.sensing import calibration

Drawn = TypeVar("Drawn", int, None)

PERIOD_NS = 50_000_000
"""Default control period [ns]."""


class TaskSetup(MadeAnew):
    """A prepared task; any number of episodes, in any threads, may share it.

    Args:
        task: Task, or its name.
        playpen: Playpen instead of the task's, as a name, path or object.
        robots: Number of robots.
        noise: Whether sensors are noisy.
        vary: Whether each episode has another robot of the same make, by its seed.
        period_ns: Control period [ns], whole ticks of 10 ms.
        seconds: Time limit of an episode [s]; by default the task's.
        planar: Whether the robot moves in a plane instead of MuJoCo (`EpisodeSetup`).
        compiled: Whether to run compiled; None if numba is installed.
        normalize: Whether actions and observations are normalized to -1 to 1; else actions are in pulses/10
            ms, and observations in the units of `tasks.TERMS`.

    Attributes:
        action_limit: Upper bound of an action, and the lower one with its sign changed.

    Raises:
        KhepTwinError: The task is unknown, or the playpen has no such goal.
        PlaypenError: The playpen cannot be used, or has a feature that a plane does not support.
        ValueError: A number is out of range.
    """

    def __init__(
        self,
        task: Task | str,
        *,
        playpen: PlaypenLike | None = None,
        robots: int = 1,
        noise: bool = True,
        vary: bool = False,
        period_ns: int = PERIOD_NS,
        seconds: float | None = None,
        planar: bool = False,
        compiled: bool | None = None,
        normalize: bool = True,
    ) -> None:
        robots = checked_count(robots, "robots")
        if period_ns <= 0 or period_ns % units.TICK_NS:
            raise ValueError(f"control period of {period_ns / 1e6:g} ms; expected whole ticks of 10 ms")
        switches = {"noise": noise, "vary": vary, "planar": planar, "normalize": normalize}
        for name, value in (switches | ({} if compiled is None else {"compiled": compiled})).items():
            if value not in (True, False):
                raise ValueError(f"{name} = {value!r}; expected True or False")
        self.task = find(task)
        given = self.task.playpen if playpen is None else playpen
        self.playpen = with_robots(Playpen.load(given), robots)
        if robots > 1 and self.task.starts == "playpen" and not self.playpen.robots[0].spots:
            found = f"{self.playpen.name}: robot 1 has no spots"
            raise PlaypenError(f"{found}; expected spots, at which {robots} robots start")
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
        self.planar, self._compiled = planar, compiled
        self._setup = EpisodeSetup(self.playpen, period_ns=period_ns, planar=planar)
        self.steps_per_period = self._setup.steps_per_period
        ambient = calibration.read(self.playpen.robots[0].calibration)[0].ambient
        self.dark, self.floor = ambient.dark_counts, ambient.floor_counts

    def episode(self) -> Episode:
        """Return the memory of an episode without a controller."""
        return Episode(self._setup, compiled=self._compiled)

    def speeds(self, action: object) -> NDArray[np.float64]:
        """Return an action, or several, as speeds clipped to the top speed, in its shape [pulses/10 ms].

        Args:
            action: Speeds of the left and right wheel (..., 2).

        Raises:
            ValueError: The action is not two numbers.
        """
        limit = self.action_limit
        try:
            given = np.asarray(action, np.float64)
        except (TypeError, ValueError):
            given = np.zeros(0)
        if given.shape[-1:] != (2,):
            raise ValueError(
                f"action {action!r}; expected two speeds, left and right, from {-limit:g} to {limit:g}"
            )
        return np.minimum(np.maximum(given, -limit), limit) * (TOP_SPEED / limit)

    def started(self, seed: int) -> Playpen:
        """Return the playpen at the start of an episode.

        Raises:
            PlaypenError: There is no room for the robots.
        """
        return (anywhere if self.task.starts == "anywhere" else at_spots)(self.playpen, seed)


def episode_seed(options: Mapping[str, object] | None, drawn: Drawn) -> int | Drawn:
    """Return the seed of an episode that the options of `reset` choose, or else the one that was drawn.

    Raises:
        ValueError: It is no integer from 0 to 2**63-1.
    """
    if (given := (options or {}).get("seed")) is None:
        return drawn
    if isinstance(given, SupportsIndex) and 0 <= (seed := operator.index(given)) < SEED_LIMIT:
        return seed
    raise ValueError(f"options: seed = {given!r}; expected an integer from 0 to 2**63-1")


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
