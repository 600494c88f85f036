"""A task prepared for episodes: its playpen, goal, divisions of time, and units of actions.

Actions and observations are normalized to -1 to 1, or, with `TaskSetup(..., normalize=False)`, in the units
of the robot: pulses/10 ms, and counts.
"""

import inspect
import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from khep_twin import units
from khep_twin.clock import NS_PER_S, n_steps, to_ns
from khep_twin.copies import MadeAnew
from khep_twin.envs.randomization import Randomization, placed_at, starts_of
from khep_twin.envs.reset_options import ResetOptions, checked_lamps, checked_playpen, is_nested
from khep_twin.envs.tasks import Task, action_limit, find, speeds_of
from khep_twin.episodes.controllers import Policy
from khep_twin.episodes.device import Device, chosen_device
from khep_twin.episodes.episode import Episode
from khep_twin.episodes.episode_options import EpisodeOptions, Home, check_numbers, checked_count
from khep_twin.episodes.episode_setup import EpisodeSetup
from khep_twin.episodes.line import LineTimes, MeasuredCycle, check_line, longest_cycle_ns
from khep_twin.errors import KhepTwinError, PlaypenError, choices
from khep_twin.playpen import Lamp, Playpen, PlaypenLike
from khep_twin.playpen.starts import Start, anywhere, at_spots
from khep_twin.sensing import calibration

PERIOD_NS = 50_000_000
"""Default control period [ns]."""

TERM_REQUESTS = {"proximity": "N", "light": "O", "speed": "H"}
"""Command that asks a robot for an observation term; others are not asked on the line."""

_AS_IT_IS = ResetOptions()


@dataclass(frozen=True, slots=True, eq=False)
class EpisodeBeginning:
    """Beginning of an episode.

    Attributes:
        setup: Setup of its playpen.
        options: Options of the episode.
        drawn: Values drawn by a randomization, by name.
    """

    setup: "TaskSetup"
    options: EpisodeOptions
    drawn: dict[str, Any] = field(default_factory=dict[str, Any])


class TaskSetup(MadeAnew):
    """A prepared task; any number of episodes, in any threads, may share it.

    Args:
        task: Task, or its name.
        playpen: Playpen instead of the task's, as a name, path or object.
        robots: Number of robots.
        start: Start x, y [mm] and heading [deg] instead of the task's, or one for each robot.
        lamps: Lamps instead of the playpen's.
        randomize: `Randomization` of the episodes, or a mapping of its attributes.
        noise: Whether sensors are noisy.
        vary: Whether each episode has another robot of the same make, by its seed.
        period_ns: Control period [ns], whole ticks of 10 ms.
        seconds: Time limit of an episode [s]; by default the task's.
        planar: Whether the robot moves in a plane instead of MuJoCo (`EpisodeSetup`).
        compiled: Whether to run compiled; None if numba is installed.
        normalize: Whether actions and observations are normalized to -1 to 1; else actions are in pulses/10
            ms, and observations in the units of `tasks.TERMS`.
        details: Whether `info` has parts of the reward and contacts, and at the end metrics and return.
        line: Line between policy and robot, as a speed [baud] or a `MeasuredCycle`; None for exchanges that
            take no time.
        unknown: None, as any other option is an error.

    Attributes:
        action_limit: Upper bound of an action, and the lower one with its sign changed.

    Raises:
        KhepTwinError: The task or an option is unknown, or the playpen has no such goal, or no room at the
            start.
        PlaypenError: The playpen cannot be used, or has a feature that a plane does not support.
        ValueError: A number is out of range.
    """

    def __init__(
        self,
        task: Task | str,
        *,
        playpen: PlaypenLike | None = None,
        robots: int = 1,
        start: Start | Sequence[Start] | None = None,
        lamps: Sequence[Lamp] | None = None,
        randomize: Randomization | dict[str, Any] | None = None,
        noise: bool = True,
        vary: bool = False,
        period_ns: int = PERIOD_NS,
        seconds: float | None = None,
        planar: bool = False,
        compiled: bool | None = None,
        normalize: bool = True,
        details: bool = False,
        line: LineTimes = None,
        **unknown: object,
    ) -> None:
        for name in unknown:
            raise KhepTwinError(f"option {name!r}: unknown; {choices(name, OPTIONS)}")
        robots = checked_count(robots, "robots")
        if period_ns <= 0 or period_ns % units.TICK_NS:
            raise ValueError(f"control period of {period_ns / 1e6:g} ms; expected whole ticks of 10 ms")
        switches = {"noise": noise, "vary": vary, "planar": planar, "normalize": normalize}
        switches["details"] = details
        for name, value in (switches | ({} if compiled is None else {"compiled": compiled})).items():
            if value not in (True, False):
                raise ValueError(f"{name} = {value!r}; expected True or False")
        self.task = find(task)
        given = self.task.playpen if playpen is None else playpen
        self.playpen = with_robots(Playpen.load(checked_playpen(given)), robots)
        if robots > 1 and self.task.starts == "playpen" and not self.playpen.robots[0].spots:
            found = f"{self.playpen.name}: robot 1 has no spots"
            raise PlaypenError(f"{found}; expected spots, at which {robots} robots start")
        self.noise, self.vary, self.period_ns, self.normalize = noise, vary, period_ns, normalize
        self.details, self.randomize = details, Randomization.of(randomize)
        self._start = None if start is None else self._starts(start)
        self._lamps = None if lamps is None else checked_lamps(lamps)
        self.line = line
        self._requests = "".join(TERM_REQUESTS.get(term, "") for term in self.task.observation_terms)
        if self.randomize and self.randomize.delay:
            _check_delay(self.randomize.delay, line, period_ns)
        self.action_limit = action_limit(normalize)
        self.seconds = self.task.seconds if seconds is None else seconds
        if not 0 < self.seconds < math.inf or to_ns(self.seconds) % period_ns:
            raise ValueError(
                f"seconds = {self.seconds}; expected one or more whole control periods of "
                f"{period_ns / 1e6:g} ms"
            )
        self.n_steps = n_steps(to_ns(self.seconds), period_ns)
        _check_period(line, self._requests, period_ns, to_ns(self.seconds))
        self.goal, self._home = (0.0, 0.0), None
        if self.task.goal:
            x_mm, y_mm = _place_of(self.playpen, self.task.goal)
            self.goal = units.metres(x_mm), units.metres(y_mm)
            if self.task.charge_s and self.task.reach_mm:
                self._home: Home | None = x_mm, y_mm, self.task.reach_mm, self.task.charge_s
        self.planar, self._compiled = planar, compiled
        at_line = line is not None or (self.randomize is not None and self.randomize.delay is not None)
        self._setup = EpisodeSetup(self.playpen, period_ns=period_ns, planar=planar, at_line=at_line)
        self.steps_per_period = self._setup.steps_per_period
        ambient = calibration.read(self.playpen.robots[0].calibration)[0].ambient
        self.dark, self.floor = ambient.dark_counts, ambient.floor_counts
        if self._start is not None:
            placed_at(self.playpen, self._start)
        self._variants: list[tuple[PlaypenLike, Self]] = []

    def episode(self, device: Device = "cpu") -> Episode:
        """Return the memory of an episode whose speeds are the caller's; on a card it is only begun."""
        driver = Policy(requests=self._requests)
        if device == "cuda":
            from khep_twin.episodes.cuda.card_batch import PreparedEpisode

            return PreparedEpisode(self._setup, driver)
        return Episode(self._setup, driver, compiled=self._compiled)

    def device(
        self, wanted: Device, count: int, like: "TaskSetup", lamps: Sequence[Lamp] | None = None
    ) -> Device:
        """Return where episodes run beside those of another setup, as `device.chosen_device` does."""
        delay = self.randomize.delay if self.randomize else None
        line = self.line if delay is None else MeasuredCycle(delay[1], self.period_ns / NS_PER_S)
        lamps = self._lamps if lamps is None else lamps
        lit = None if lamps is None else [lamps]
        return chosen_device(wanted, self._setup, Policy(), line, count, lit, like._setup)

    def speeds(self, action: object) -> NDArray[np.float64]:
        """Return an action, or several, as speeds: see `tasks.speeds_of`."""
        return speeds_of(action, self.normalize)

    def started(self, seed: int) -> Playpen:
        """Return the playpen at the start of an episode.

        Raises:
            PlaypenError: There is no room for the robots.
        """
        return (anywhere if self.task.starts == "anywhere" else at_spots)(self.playpen, seed)

    def beginning(self, seed: int, given: ResetOptions = _AS_IT_IS) -> EpisodeBeginning:
        """Return the beginning of the episode of a seed.

        Args:
            seed: Seed of the episode.
            given: Options in place of the setup's own, and of what its randomization would draw.

        Raises:
            PlaypenError: There is no room for the robots, or the playpen cannot be used.
            KhepTwinError: There is no room at the start, or the playpen has no such goal.
        """
        setup, random, drawn = self, self.randomize or _NOTHING, dict[str, Any]()
        if given.playpen is not None:
            setup = self._with_playpen(given.playpen)
        elif random.blocks_mm:
            drawn["playpen"] = random.chosen(seed)
            setup = self._with_playpen(self._pool[drawn["playpen"]])
        lamps = self._lamps if given.lamps is None else given.lamps
        if random.lamps is not None and given.lamps is None:
            lit = setup.playpen
            lamps = random.relit(lit if lamps is None else lit.model_copy(update={"lamps": lamps}), seed)
            drawn["lamps"] = tuple((lamp.x_mm, lamp.y_mm, lamp.power_w) for lamp in lamps)
        noise = random.is_noisy(seed, self.noise)
        if random.noise is not None:
            drawn["noise"] = noise
        if (line := random.line(seed, self.period_ns)) is not None:
            drawn["delay"] = line.delay
        start = self._start if given.start is None else self._starts(given.start)
        if random.starts is not None and given.start is None:
            start = random.placed(setup.playpen, seed, start)
        elif start is not None:
            placed_at(setup.playpen, start)
        else:
            start = starts_of(setup.started(seed))
        options = EpisodeOptions(
            start=start,
            noise=noise,
            vary=self.vary or random.robots,
            lamps=lamps,
            home=setup._home,
            line=line or self.line,
        )
        return EpisodeBeginning(setup, options, drawn)

    def _starts(self, start: Any) -> list[Start]:
        """Return the start of each robot; raise a `ValueError` unless there is one for each."""
        count = len(self.playpen.robots)
        table = start if is_nested(start) else [start]
        what = "x, y [mm] and heading [deg]" + (f" of {count} robots" if count > 1 else "")
        check_numbers("start", table, what, (count, 3))
        return [(x_mm, y_mm, heading_deg) for x_mm, y_mm, heading_deg in np.asarray(table, float).tolist()]

    def _with_playpen(self, playpen: PlaypenLike) -> Self:
        """Return the setup of the same task in another playpen, which is prepared once."""
        for known, setup in self._variants:
            if known is playpen or known == playpen:
                return setup
        arguments, options = self._arguments
        given: Any = {**options, "playpen": playpen, "start": None}
        setup = type(self)(*arguments, **given)  # pyright: ignore[reportArgumentType]
        self._variants.append((playpen, setup))
        return setup

    @cached_property
    def _pool(self) -> tuple[Playpen, ...]:
        """Playpens that the randomization draws from."""
        playpen = self.playpen if self._start is None else placed_at(self.playpen, self._start)
        return (self.randomize or _NOTHING).pool(playpen)


_NOTHING = Randomization()

OPTIONS = tuple(inspect.signature(TaskSetup.__init__).parameters)[2:-1]
"""Names of the options of a task."""


def _check_period(line: LineTimes, requests: str, period_ns: int, episode_ns: int) -> None:
    """Raise a `ValueError` if a cycle at a line takes longer than the control period.

    It names a period that would do, of which an episode has a whole number.
    """
    check_line(line)
    if line is None:
        return
    took = to_ns(line.period) if isinstance(line, MeasuredCycle) else longest_cycle_ns(line, requests)
    if took > period_ns:
        names = " and ".join(filter(None, (", ".join(requests), "D")))
        ticks = range(-(-took // units.TICK_NS), episode_ns // units.TICK_NS)
        whole = (tick for tick in ticks if episode_ns % (tick * units.TICK_NS) == 0)
        least_ms = next(whole, episode_ns // units.TICK_NS) * units.TICK_NS // 1_000_000
        raise ValueError(
            f"line = {line}: a cycle of {names} takes up to {took / 1e6:.0f} ms; expected period_ns = "
            f"{least_ms}_000_000 or more, not {period_ns}"
        )


def _check_delay(delay: tuple[float, float], line: LineTimes, period_ns: int) -> None:
    """Raise a `KhepTwinError` if delays are drawn at a line, or are longer than a control period."""
    if line is not None:
        raise KhepTwinError(f"randomize: delay = {delay}: and line = {line}; expected one of them")
    if to_ns(delay[1]) > period_ns:
        period = f"a control period of {period_ns / NS_PER_S:g} s"
        raise KhepTwinError(f"randomize: delay = {delay}; expected times up to {period}")


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
    """Return the position of a playpen's named patch or cylinder [mm]."""
    positions = {
        item.name: (item.x_mm, item.y_mm) for item in (*playpen.patches, *playpen.cylinders) if item.name
    }
    if name not in positions:
        raise KhepTwinError(f"{playpen.name}: has no patch or cylinder {name!r}; {choices(name, positions)}")
    return positions[name]
