"""A task prepared for episodes: its playpen, goal, time steps, and units of actions.

Actions and observations are normalized to -1 to 1, or, with `TaskSetup(..., normalize=False)`, in the robot's
units: pulses/10 ms, and counts.
"""

import inspect
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from khep_twin import units
from khep_twin.clock import NS_PER_S, to_ns
from khep_twin.copies import CopiedByArguments
from khep_twin.envs.arguments import check_period, check_switch, count_periods
from khep_twin.envs.randomization import Randomization, place_robots, starts_of
from khep_twin.envs.reset_options import ResetOptions, is_nested, validate_lamps, validate_playpen
from khep_twin.envs.tasks import Task, find_task, speeds_of
from khep_twin.episodes.controllers import Policy
from khep_twin.episodes.device import Device, choose_device
from khep_twin.episodes.episode import Episode
from khep_twin.episodes.episode_options import EpisodeOptions, Home, check_count, check_numbers
from khep_twin.episodes.episode_setup import EpisodeSetup
from khep_twin.episodes.line import LineTimes, MeasuredCycle, check_line, longest_cycle_ns
from khep_twin.errors import KhepTwinError, PlaypenError, choices, value_text
from khep_twin.playpen import Lamp, Playpen, PlaypenLike
from khep_twin.playpen.starts import Start, anywhere, at_spots
from khep_twin.renamed import renamed_attribute
from khep_twin.sensing import calibration

PERIOD_NS = 50_000_000
"""Default control period [ns]."""

MAX_ROBOTS = 1000
"""Largest number of robots in an environment (assumed)."""

TERM_REQUESTS = {"proximity": "N", "light": "O", "speed": "H"}
"""Command that requests an observation term from a robot; other terms are not requested on the line."""

_NO_OPTIONS = ResetOptions()
_NO_RANDOMIZATION = Randomization()


@dataclass(frozen=True, slots=True, eq=False)
class EpisodeBeginning:
    """Initial conditions of an episode.

    Attributes:
        setup: Setup of its playpen.
        options: Options of the episode.
        drawn: Values drawn by a randomization, by name.
    """

    setup: "TaskSetup"
    options: EpisodeOptions
    drawn: dict[str, Any] = field(default_factory=dict[str, Any])


class TaskSetup(CopiedByArguments):
    """A prepared task, which any number of episodes, in any threads, may share.

    Args:
        task: Task, or its name.
        playpen: Playpen instead of the task's, as a name, path or object.
        robots: Number of robots.
        start: Start x, y [mm] and heading [deg] instead of the task's, or one for each robot.
        lamps: Lamps instead of the playpen's.
        randomize: `Randomization` of the episodes, or a mapping of its attributes.
        noise: Whether sensors are noisy.
        vary: Whether each episode has another robot of the same model, by its seed.
        period_ns: Control period [ns], whole ticks of 10 ms.
        seconds: Time limit of an episode [s]; by default the task's.
        planar: Whether a 2-D model replaces MuJoCo (`EpisodeSetup`).
        compiled: Whether to run JIT-compiled; None for yes if numba is installed.
        normalize: Whether actions and observations are normalized to -1 to 1; otherwise actions are in the
            unit of the robot's register, and observations in the units of `tasks.terms_of` its model.
        details: Whether `info` has parts of the reward and contacts, and at the end metrics and return.
        max_episode_steps: Time limit of an episode in control periods, if it is shorter than `seconds`.
        line: Line between policy and robot, as a baud rate or a `MeasuredCycle`; None for exchanges without
            delay.
        unknown_options: None; any other option is an error.

    Attributes:
        action_limit: Upper bound of an action, and the lower one with its sign changed.
        interface: Registers of the robots.

    Raises:
        KhepTwinError: The task or an option is unknown, or the playpen lacks the goal, or room at the start.
        PlaypenError: The playpen cannot be used, or has a feature that the 2-D model does not support.
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
        max_episode_steps: int | None = None,
        line: LineTimes = None,
        **unknown_options: object,
    ) -> None:
        for name in unknown_options:
            raise KhepTwinError(f"option {name!r}: unknown; {choices(name, OPTIONS)}")
        robots = check_count(robots, "robots")
        if robots > MAX_ROBOTS:
            raise ValueError(f"{value_text(robots)} robots; expected up to {MAX_ROBOTS}")
        period_ns = check_period(period_ns)
        switches = dict(noise=noise, vary=vary, planar=planar, normalize=normalize, details=details)
        for name, value in (switches | ({} if compiled is None else {"compiled": compiled})).items():
            check_switch(name, value)
        task = find_task(task)
        playpen_source = task.playpen if playpen is None else playpen
        self.playpen = with_robots(Playpen.load(validate_playpen(playpen_source)), robots)
        self.task = replace(task, model=self.playpen.robots[0].robot_model.family)
        positions = {(robot.x_mm, robot.y_mm) for robot in self.playpen.robots}
        if len(positions) < robots and self.task.starts == "playpen" and not self.playpen.robots[0].spots:
            problem = f"{self.playpen.name}: robot 1 has no spots"
            raise PlaypenError(f"{problem}; expected spots, at which {robots} robots start")
        self.noise = noise
        self.vary = vary
        self.period_ns = period_ns
        self.normalize = normalize
        self.details = details
        self.randomize = Randomization.of(randomize)
        self._start = None if start is None else self._validate_starts(start)
        self._lamps = None if lamps is None else validate_lamps(lamps)
        self.line = line
        self._requests = "".join(TERM_REQUESTS.get(term, "") for term in self.task.observation_terms) or "N"
        if self.randomize and self.randomize.delay:
            _check_delay(self.randomize.delay, line, period_ns)
        self.action_limit = 1.0 if normalize else self.task.top_speed
        self.seconds = self.task.seconds if seconds is None else seconds
        self.n_steps = count_periods(self.seconds, period_ns)
        if max_episode_steps is not None:
            self.n_steps = min(self.n_steps, check_count(max_episode_steps, "max_episode_steps"))
        _check_period(line, self._requests, period_ns, to_ns(self.seconds))
        self.goal = 0.0, 0.0
        self._home: Home | None = None
        if self.task.goal:
            x_mm, y_mm = _goal_position(self.playpen, self.task.goal)
            self.goal = units.metres(x_mm), units.metres(y_mm)
            if self.task.charge_s and self.task.reach_mm:
                self._home = x_mm, y_mm, self.task.reach_mm, self.task.charge_s
        self.planar = planar
        self._compiled = compiled
        at_line = line is not None or (self.randomize is not None and self.randomize.delay is not None)
        self._setup = EpisodeSetup(self.playpen, period_ns=period_ns, planar=planar, at_line=at_line)
        self.interface = self._setup.interface
        self.steps_per_period = self._setup.steps_per_period
        ambient = calibration.read(self.playpen.robots[0].calibration)[0].ambient
        self.dark, self.floor = ambient.dark_counts, ambient.floor_counts
        if self._start is not None:
            place_robots(self.playpen, self._start)
        self._playpen_setups: list[tuple[PlaypenLike, Self]] = []

    def episode(self, device: Device = "cpu") -> Episode:
        """Return an episode whose speeds the caller sets; for a GPU, one that is only prepared."""
        known_terms = {term.name for term in self.playpen.robots[0].robot_model.terms}
        terms = tuple(name for name in self.task.observation_terms if name in known_terms)
        driver = Policy(requests=self._requests, terms=terms)
        if device == "cuda":
            from khep_twin.episodes.cuda.card_batch import PreparedEpisode

            return PreparedEpisode(self._setup, driver)
        return Episode(self._setup, driver, compiled=self._compiled)

    def device(
        self, requested: Device, count: int, reference: "TaskSetup", lamps: Sequence[Lamp] | None = None
    ) -> Device:
        """Return where episodes run beside those of another setup, as `device.choose_device` does."""
        delay = self.randomize.delay if self.randomize else None
        line = self.line if delay is None else MeasuredCycle(delay[1], self.period_ns / NS_PER_S)
        lamps = self._lamps if lamps is None else lamps
        lamp_lists = None if lamps is None else [lamps]
        return choose_device(requested, self._setup, Policy(), line, count, lamp_lists, reference._setup)

    def speeds(self, action: object) -> NDArray[np.float64]:
        """Return an action, or several, as speeds: see `tasks.speeds_of`."""
        return speeds_of(action, self.task.top_speed, self.normalize)

    started = renamed_attribute("started", "start_playpen")

    def start_playpen(self, seed: int) -> Playpen:
        """Return the playpen at the start of an episode.

        Raises:
            PlaypenError: There is no room for the robots.
        """
        return (anywhere if self.task.starts == "anywhere" else at_spots)(self.playpen, seed)

    def beginning(self, seed: int, reset_options: ResetOptions = _NO_OPTIONS) -> EpisodeBeginning:
        """Return the beginning of the episode of a seed.

        Args:
            seed: Seed of the episode.
            reset_options: Options that replace the setup's, and the values drawn by its randomization.

        Raises:
            PlaypenError: There is no room for the robots, or the playpen cannot be used.
            KhepTwinError: There is no room at the start, or the playpen lacks the goal.
        """
        setup, randomization, drawn = self, self.randomize or _NO_RANDOMIZATION, dict[str, Any]()
        if reset_options.playpen is not None:
            setup = self._with_playpen(reset_options.playpen)
        elif randomization.blocks_mm:
            drawn["playpen"] = randomization.playpen_index(seed)
            setup = self._with_playpen(self._randomized_playpens[drawn["playpen"]])
        lamps = self._lamps if reset_options.lamps is None else reset_options.lamps
        if randomization.lamps is not None and reset_options.lamps is None:
            playpen = setup.playpen if lamps is None else setup.playpen.model_copy(update={"lamps": lamps})
            lamps = randomization.draw_lamps(playpen, seed)
            drawn["lamps"] = tuple((lamp.x_mm, lamp.y_mm, lamp.power_w) for lamp in lamps)
        noise = randomization.is_noisy(seed, self.noise)
        if randomization.noise is not None:
            drawn["noise"] = noise
        if (line := randomization.line(seed, self.period_ns)) is not None:
            drawn["delay"] = line.delay
        start = self._start if reset_options.start is None else self._validate_starts(reset_options.start)
        if randomization.starts is not None and reset_options.start is None:
            start = randomization.draw_starts(setup.playpen, seed, start)
        elif start is not None:
            place_robots(setup.playpen, start)
        else:
            start = starts_of(setup.start_playpen(seed))
        options = EpisodeOptions(
            start=start,
            noise=noise,
            vary=self.vary or randomization.robots,
            lamps=lamps,
            home=setup._home,
            line=line or self.line,
        )
        return EpisodeBeginning(setup, options, drawn)

    def _validate_starts(self, start: Any) -> list[Start]:
        """Return the start of each robot; raise a `ValueError` unless there is one for each."""
        count = len(self.playpen.robots)
        starts = start if is_nested(start) else [start]
        description = "x, y [mm] and heading [deg]" + (f" of {count} robots" if count > 1 else "")
        check_numbers("start", starts, description, (count, 3))
        return [(x_mm, y_mm, heading_deg) for x_mm, y_mm, heading_deg in np.asarray(starts, float).tolist()]

    def _with_playpen(self, playpen: PlaypenLike) -> Self:
        """Return the setup of the same task in another playpen; each is prepared only once."""
        for other_playpen, setup in self._playpen_setups:
            if other_playpen is playpen or other_playpen == playpen:
                return setup
        arguments, options = self._arguments
        keywords: Any = {**options, "playpen": playpen, "start": None}
        setup = type(self)(*arguments, **keywords)  # pyright: ignore[reportArgumentType]
        self._playpen_setups.append((playpen, setup))
        return setup

    @cached_property
    def _randomized_playpens(self) -> tuple[Playpen, ...]:
        """Playpens that the randomization draws from."""
        playpen = self.playpen if self._start is None else place_robots(self.playpen, self._start)
        return (self.randomize or _NO_RANDOMIZATION).pool(playpen)


OPTIONS = tuple(inspect.signature(TaskSetup.__init__).parameters)[2:-1]
"""Names of the options of a task."""


def _check_period(line: LineTimes, requests: str, period_ns: int, episode_ns: int) -> None:
    """Raise a `ValueError` if a cycle at a line takes longer than the control period.

    The message names a sufficient period that divides the episode.
    """
    check_line(line)
    if line is None:
        return
    cycle_ns = to_ns(line.period) if isinstance(line, MeasuredCycle) else longest_cycle_ns(line, requests)
    if cycle_ns > period_ns:
        names = " and ".join(filter(None, (", ".join(requests), "D")))
        ticks = range(-(-cycle_ns // units.TICK_NS), episode_ns // units.TICK_NS)
        divisors = (tick for tick in ticks if episode_ns % (tick * units.TICK_NS) == 0)
        least_ms = next(divisors, episode_ns // units.TICK_NS) * units.TICK_NS // 1_000_000
        raise ValueError(
            f"line = {line}: a cycle of {names} takes up to {cycle_ns / 1e6:.0f} ms; expected period_ns = "
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
    """Return the playpen with `count` copies of its first robot.

    They start at the poses of its robots of this model, the remaining ones at that of the first.

    Raises:
        PlaypenError: The playpen has no robot.
    """
    if not playpen.robots:
        raise PlaypenError(f"{playpen.name}: no robot; expected one to copy")
    first_robot = playpen.robots[0].model_copy(update={"name": None} if count > 1 else {})
    peers = [robot for robot in playpen.robots[1:] if robot.model == first_robot.model][: count - 1]
    poses = [robot.model_dump(include={"x_mm", "y_mm", "heading_deg", "spots"}) for robot in peers]
    robots = (first_robot, *(first_robot.model_copy(update=pose) for pose in poses))
    return playpen.model_copy(update={"robots": robots + (first_robot,) * (count - len(robots))})


def _goal_position(playpen: Playpen, name: str) -> tuple[float, float]:
    """Return the position of a playpen's named patch or cylinder [mm]."""
    positions = {
        item.name: (item.x_mm, item.y_mm) for item in (*playpen.patches, *playpen.cylinders) if item.name
    }
    if name not in positions:
        raise KhepTwinError(
            f"{playpen.name}: has no patch or cylinder {value_text(name)}; {choices(name, positions)}"
        )
    return positions[name]
