"""`khep-twin rollout`: an episode without a serial line."""

import warnings
from collections.abc import Callable, Iterable
from contextlib import ExitStack
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from khep_twin.cli.completion import controllers
from khep_twin.cli.option_groups import LengthOptions, LogOptions, RobotOptions, SceneOptions, grouped
from khep_twin.cli.options import (
    Faults,
    check_apart,
    check_body,
    check_new,
    check_picture,
    complain,
    tell_kept,
    tell_written,
    usage,
)
from khep_twin.cli.progress import progress as progress_bar

if TYPE_CHECKING:
    from khep_twin.board.fault_injection import Fault
    from khep_twin.episodes.controllers import Driver
    from khep_twin.episodes.episode import Episode, EpisodeSetup
    from khep_twin.episodes.episode_options import EpisodeOptions
    from khep_twin.playpen import Playpen

NO_LINE = {"line": "none"}
"""Metadata in the log of an episode, which `khep-twin repeat` cannot repeat."""

Pose = tuple[float, float, float]
"""x, y [m] and heading [rad]."""

_SPAN_NS = 2_000_000_000
"""Simulated time between two updates of the progress bar [ns]."""


@dataclass(frozen=True, slots=True)
class PhysicsOptions:
    """Options of the physics, and of the controller's time in it."""

    period: Annotated[
        float | None,
        typer.Option(help="Period of the controller [ms]; without, the network's own, or 20."),
    ] = None
    step: Annotated[
        float | None,
        typer.Option(
            help="Step of the physics [ms]: 2.5, or coarser, 5 or 10; without, 2.5, or 10 with --planar."
        ),
    ] = None
    line: Annotated[
        int | None,
        typer.Option(
            min=1,
            help="Speed of a serial line whose times the controller keeps [baud]; without, it has none.",
        ),
    ] = None
    planar: Annotated[bool, typer.Option("--planar", help="Simulate in a plane, not in MuJoCo.")] = False
    device: Annotated[
        str, typer.Option(help="Run on the cpu, or, with --planar, on an NVIDIA card: cuda.")
    ] = "cpu"

    def setup(
        self, playpen: "Playpen", driver: object, faults: "Iterable[Fault]", log: Path | None
    ) -> "EpisodeSetup":
        """Return the setup of an episode."""
        from khep_twin.episodes import EpisodeSetup, Network
        from khep_twin.units import SCAN_NS

        if self.planar and log is not None:
            raise usage("--log and --planar: a plane has no scene to replay; expected one of them")
        for option, time_ms in (("--period", self.period), ("--step", self.step)):
            if time_ms is not None and not 0 < time_ms <= 1e9:
                raise usage(f"{option} {time_ms:g}: expected a time in ms, above 0 and at most 1e9")
        own_ns = driver.period_ns if isinstance(driver, Network) else SCAN_NS
        return EpisodeSetup(
            playpen,
            step_ns=None if self.step is None else round(self.step * 1e6),
            period_ns=own_ns if self.period is None else round(self.period * 1e6),
            planar=self.planar,
            at_line=self.line is not None,
            faults=faults,
        )


@grouped
def rollout(
    *,
    controller: Annotated[
        str,
        typer.Argument(
            help="braitenberg, a network's FILE.npz, or FILE.py[:NAME], a function of proximity and ambient "
            "light that returns both speeds.",
            autocompletion=controllers,
        ),
    ] = "braitenberg",
    scene: SceneOptions,
    length: LengthOptions,
    twin: RobotOptions,
    physics: PhysicsOptions,
    fault: Faults = None,
    picture: Annotated[Path | None, typer.Option(help="Draw playpen and path as PNG, SVG or PDF.")] = None,
    logging: LogOptions,
) -> None:
    """Run one episode without a serial line and print its metrics.

    With several robots, print those of each.
    """
    from khep_twin.board.fault_injection import parse_fault
    from khep_twin.episodes import Episode, EpisodeOptions, Policy
    from khep_twin.episodes.device import chosen_device
    from khep_twin.lab.experiment.controller_files import find_driver
    from khep_twin.playpen.starts import at_spots
    from khep_twin.ports.twin import Twin, equipped

    check_picture(picture)
    check_apart([scene.playpen], picture, logging.log)
    check_new(logging.force, logging.log, picture)
    options = replace(twin.options(None), faults=tuple(fault or ()))
    playpen = scene.load()
    found = find_driver(controller)
    driver, function = (Policy(), found) if callable(found) else (found, None)
    playpen, _ = equipped(at_spots(playpen, options.seed), options)
    check_body(options.rom, playpen.robots)
    try:
        setup = physics.setup(playpen, found, map(parse_fault, options.faults), logging.log)
        periods = length.cycles or setup.periods(60.0 if length.seconds is None else length.seconds)
        device = chosen_device(physics.device, setup, driver, physics.line, 1)
    except ValueError as error:
        raise usage(str(error)) from None
    own = EpisodeOptions(noise=options.noise, vary=options.vary, line=physics.line)
    seconds = periods * setup.period_ns / 1e9
    if device == "cuda":
        on_card = _run_on_card(setup, driver, function, options.seed, own, periods, picture is not None)
        _print(periods, seconds, *on_card, playpen, picture, logging.force)
        return
    compiled = None if is_compiled() else False
    episode = Episode(setup, driver, compiled=compiled, observed=logging.log is not None)
    episode.begin(options.seed, own)
    recorder = None
    with ExitStack() as stack:
        if logging.log is not None:
            recorded = stack.enter_context(Twin(episode.world, episode.world.robots, options))
            recorded.record(
                logging.log, facts={"controller": controller, **NO_LINE}, on_failure=logging.on_failure
            )
            recorder = recorded.recorder
            tell_kept(recorder)
        times, paths = _run(episode, setup, function, periods, picture is not None)
    metrics = [episode.metrics(robot) for robot in range(len(episode.boards))]
    _print(periods, seconds, metrics, times, paths, playpen, picture, logging.force)
    logging.check(recorder)
    if logging.log is not None:
        tell_written("log", [logging.log])


def _run(
    episode: "Episode", setup: "EpisodeSetup", function: Callable[..., Any] | None, periods: int, drawn: bool
) -> tuple[list[float], list[list[Pose]]]:
    """Run an episode; return times [s] and the path of each robot, with each period if it is to be drawn."""
    # Where the path is not needed in between, many periods pass at once, with the same results.
    at_once = 1 if drawn else max(_SPAN_NS // setup.period_ns, 1)
    times, paths = [0.0], [[pose] for pose in episode.poses]
    until = periods * setup.steps_per_period
    if episode.is_at_line:
        episode.next_reading(until)
    with progress_bar() as show:
        while episode.steps < until:
            if function is not None:
                for robot in range(len(paths)):
                    episode.drive(*_speeds(function, *episode.readings(robot)), robot)
                episode.next_reading(until)
            else:
                episode.step(min(at_once * setup.steps_per_period, until - episode.steps))
            times.append(episode.time_ns / 1e9)
            for path, pose in zip(paths, episode.poses, strict=True):
                path.append(pose)
            if show is not None:
                show(episode.steps / until)
    return times, paths


def _run_on_card(
    setup: "EpisodeSetup",
    driver: "Driver",
    function: Callable[..., Any] | None,
    seed: int,
    options: "EpisodeOptions",
    periods: int,
    drawn: bool,
) -> tuple[list[dict[str, float]], list[float], list[list[Pose]]]:
    """Run an episode on a card; return metrics, times [s] and path of the robot, as `_run` does."""
    from khep_twin.episodes import Policy, batch
    from khep_twin.errors import DivergedError

    if function is not None:
        decide = partial(_speeds, function)
        driver = Policy(lambda proximity, ambient, _: [decide(proximity[0].tolist(), ambient[0].tolist())])
    period = setup.period_ns / 1e9
    every = period if drawn else None
    results = batch.rollout(
        setup, driver, [seed], periods * period, options=options, paths_every=every, device="cuda"
    )
    for failure in results.failures:
        raise DivergedError(failure.reason)
    metrics = {name: float(values[0]) for name, values in results.metrics.items()}
    times = [period * sample for sample in range(periods + 1)] if drawn else []
    return [metrics], times, [[tuple(pose) for pose in results.paths[0].tolist()]]


def is_compiled() -> bool:
    """Return whether episodes run compiled; print a note where they do not."""
    from khep_twin.episodes import episode

    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        compiled = episode.is_compiled(None)
    for warning in told:
        complain(str(warning.message))
    return compiled


def _print(
    periods: int,
    seconds: float,
    each: list[dict[str, float]],
    times: list[float],
    paths: list[list[Pose]],
    playpen: "Playpen",
    picture: Path | None,
    replace: bool,
) -> None:
    """Print the metrics of each robot, and draw the paths."""
    from khep_twin.lab.experiment.series_run import metric_lines

    typer.echo(f"{periods} cycles in {seconds:.1f} s")
    if (n_robots := len(each)) > 1:
        typer.echo(f"{'':20}" + "".join(f"{f'khepera{robot}':<12}" for robot in range(n_robots)).rstrip())
    for line in metric_lines(each):  # homing is undefined without a home
        typer.echo(line)
    if picture is not None:
        _draw(playpen, times, paths, picture, replace)
        typer.echo(f"picture  {picture}")


def _draw(
    playpen: "Playpen", times: list[float], paths: list[list[Pose]], picture: Path, replace: bool
) -> None:
    """Draw the robots' paths."""
    import numpy as np

    from khep_twin.drawing.map import draw, save
    from khep_twin.drawing.paths import DrawnPath

    drawn = [
        DrawnPath(f"khepera{robot}", np.array(times), 1000 * np.array(path)[:, :2])
        for robot, path in enumerate(paths)
    ]
    save(draw(playpen, drawn), picture, replace)


def _speeds(function: Callable[..., Any], *readings: list[int]) -> tuple[float, float]:
    """Return the left and right speed that a user's function makes of the readings [pulses/10 ms]."""
    from khep_twin.errors import ControllerError
    from khep_twin.lab.experiment.controllers import call, name_of

    speeds = call(function, *readings)
    try:
        left, right = speeds
        return float(left), float(right)
    except (TypeError, ValueError):
        raise ControllerError(
            f"{name_of(function)}: returned {speeds!r}; expected two speeds in pulses per 10 ms, such as "
            "(10, 10)"
        ) from None
