"""`khep-twin rollout`: an episode without a serial line."""

import warnings
from collections.abc import Callable, Iterable
from contextlib import ExitStack
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from khep_twin import drawing
from khep_twin.cli.completion import controllers
from khep_twin.cli.option_groups import LengthOptions, LogOptions, RobotOptions, SceneOptions, with_help
from khep_twin.cli.options import (
    Faults,
    check_inputs,
    check_new,
    check_picture,
    note_firmware_only,
    notify,
    print_files,
    print_kept_log,
    usage,
)
from khep_twin.cli.progress import progress as progress_bar
from khep_twin.errors import ControllerError, DivergedError
from khep_twin.robots.model import robot_name

if TYPE_CHECKING:
    from khep_twin.board.fault_injection import Fault
    from khep_twin.episodes.controllers import Driver
    from khep_twin.episodes.episode import Episode, EpisodeSetup
    from khep_twin.episodes.episode_options import EpisodeOptions
    from khep_twin.playpen import Playpen

NO_LINE = {"line": "none"}
"""Metadata that marks the log of an episode, which `khep-twin repeat` cannot repeat."""

Pose = tuple[float, float, float]
"""x, y [m] and heading [rad]."""

_PROGRESS_NS = 2_000_000_000
"""Simulated time between two updates of the progress bar [ns]."""


@dataclass(frozen=True, slots=True)
class PhysicsOptions:
    """Options of the physics and of the controller's timing.

    Attributes:
        period: Period of the controller [ms]; by default the network's, or 20.
        step: Time step of the physics [ms]: 2.5, 5 or 10; by default 2.5, or 10 with --planar.
        line: Simulate the delays of a serial line at this baud rate; by default there are none.
        planar: Simulate a 2-D model, not MuJoCo.
        device: Run on the cpu, or, with --planar, on an NVIDIA GPU: cuda.
    """

    period: float | None = None
    step: float | None = None
    line: Annotated[int | None, typer.Option(min=1)] = None
    planar: bool = False
    device: str = "cpu"

    def setup(
        self, playpen: "Playpen", driver: object, faults: "Iterable[Fault]", log: Path | None
    ) -> "EpisodeSetup":
        """Return the setup of an episode."""
        from khep_twin.episodes import EpisodeSetup, Network
        from khep_twin.units import SCAN_NS

        if self.planar and log is not None:
            raise usage("--log and --planar: the 2-D model has no scene to replay; expected one of them")
        for option, time_ms in (("--period", self.period), ("--step", self.step)):
            if time_ms is not None and not 0 < time_ms <= 1e9:
                raise usage(f"{option} {time_ms:g}: expected a time in ms, above 0 and at most 1e9")
        default_ns = driver.period_ns if isinstance(driver, Network) else SCAN_NS
        return EpisodeSetup(
            playpen,
            step_ns=None if self.step is None else round(self.step * 1e6),
            period_ns=default_ns if self.period is None else round(self.period * 1e6),
            planar=self.planar,
            at_line=self.line is not None,
            faults=faults,
        )


@with_help
def rollout(
    *,
    controller: Annotated[str, typer.Argument(autocompletion=controllers)] = "braitenberg",
    scene: SceneOptions,
    length: LengthOptions,
    twin: RobotOptions,
    physics: PhysicsOptions,
    fault: Faults = None,
    picture: Path | None = None,
    logging: LogOptions,
) -> None:
    """Run one episode without a serial line and print its metrics.

    The metrics of several robots are printed side by side.

    Args:
        controller: braitenberg, a network's FILE.npz, or FILE.py[:NAME], a function of proximity, ambient
            light and named readings that returns both speeds.
        picture: Draw playpen and path as PNG, SVG or PDF.
    """
    from khep_twin.board.fault_injection import parse_fault
    from khep_twin.episodes import Episode, EpisodeOptions, Policy
    from khep_twin.episodes.controllers import terms_in
    from khep_twin.episodes.device import choose_device
    from khep_twin.lab.experiment.controller_files import find_driver
    from khep_twin.playpen.starts import at_spots
    from khep_twin.ports.twin import Twin, equip_playpen

    check_picture(picture)
    check_inputs([scene.playpen], picture, logging.log)
    check_new(logging.force, logging.log, picture)
    options = replace(twin.options(None), faults=tuple(fault or ()))
    playpen = scene.load()
    program = find_driver(controller)
    driver, function = (Policy(terms=terms_in(program, 2)), program) if callable(program) else (program, None)
    playpen, _ = equip_playpen(at_spots(playpen, options.seed), options)
    note_firmware_only(options.rom, playpen.robots)
    try:
        setup = physics.setup(playpen, program, map(parse_fault, options.faults), logging.log)
        periods = length.cycles or setup.periods(60.0 if length.seconds is None else length.seconds)
        device = choose_device(physics.device, setup, driver, physics.line, 1)
    except ValueError as error:
        raise usage(str(error)) from None
    episode_options = EpisodeOptions(noise=options.noise, vary=options.vary, line=physics.line)
    seconds = periods * setup.period_ns / 1e9
    draw = picture is not None
    if device == "cuda":
        results = _run_on_gpu(setup, driver, function, options.seed, episode_options, periods, draw)
        _print_results(periods, seconds, *results, playpen, picture, logging.force)
        return
    compiled = None if check_compiled() else False
    episode = Episode(setup, driver, compiled=compiled, observed=logging.log is not None)
    episode.begin(options.seed, episode_options)
    recorder = None
    with ExitStack() as stack:
        if logging.log is not None:
            recorded_twin = stack.enter_context(Twin(episode.world, episode.world.robots, options))
            recorded_twin.record(
                logging.log, facts={"controller": controller, **NO_LINE}, on_failure=logging.on_failure
            )
            recorder = recorded_twin.recorder
            print_kept_log(recorder)
        times, paths = _run_episode(episode, setup, function, periods, draw)
    metrics = [episode.metrics(robot) for robot in range(len(episode.boards))]
    _print_results(periods, seconds, metrics, times, paths, playpen, picture, logging.force)
    logging.check(recorder)
    if logging.log is not None:
        print_files("log", [logging.log])


def _run_episode(
    episode: "Episode", setup: "EpisodeSetup", function: Callable[..., Any] | None, periods: int, draw: bool
) -> tuple[list[float], list[list[Pose]]]:
    """Run an episode; return times [s] and each robot's path, at every period if `draw`."""
    # Without a path to draw, one call steps many periods, with the same results.
    periods_per_call = 1 if draw else max(_PROGRESS_NS // setup.period_ns, 1)
    times, paths = [0.0], [[pose] for pose in episode.poses]
    end_step = periods * setup.steps_per_period
    if episode.is_at_line:
        episode.next_reading(end_step)
    with progress_bar() as show:
        while episode.steps < end_step:
            if function is not None:
                for robot in range(len(paths)):
                    episode.drive(*_call_controller(function, *episode.readings(robot)), robot)
                episode.next_reading(end_step)
            else:
                episode.step(min(periods_per_call * setup.steps_per_period, end_step - episode.steps))
            times.append(episode.time_ns / 1e9)
            for path, pose in zip(paths, episode.poses, strict=True):
                path.append(pose)
            if show is not None:
                show(episode.steps / end_step)
    return times, paths


def _run_on_gpu(
    setup: "EpisodeSetup",
    driver: "Driver",
    function: Callable[..., Any] | None,
    seed: int,
    options: "EpisodeOptions",
    periods: int,
    draw: bool,
) -> tuple[list[dict[str, float]], list[float], list[list[Pose]]]:
    """Run an episode on a GPU; return metrics, times [s] and the robot's path, as in `_run_episode`."""
    from khep_twin.episodes import Policy, batch
    from khep_twin.episodes.controllers import terms_of

    if function is not None:
        decide = partial(_call_controller, function)

        def decide_for_one(*rows: Any) -> list[tuple[float, float]]:
            return [decide(*(row[0].tolist() for row in (*rows[:2], *rows[3:])))]  # without the index

        driver = Policy(decide_for_one, terms=terms_of(driver))
    period = setup.period_ns / 1e9
    path_interval_s = period if draw else None
    results = batch.rollout(
        setup, driver, [seed], periods * period, options=options, paths_every=path_interval_s, device="cuda"
    )
    for failure in results.failures:
        raise DivergedError(failure.reason)
    metrics = {name: float(values[0]) for name, values in results.metrics.items()}
    times = [period * sample for sample in range(periods + 1)] if draw else []
    return [metrics], times, [[tuple(pose) for pose in results.paths[0].tolist()]]


def check_compiled() -> bool:
    """Return whether episodes run JIT-compiled; print a note if they do not."""
    from khep_twin.episodes import episode

    with warnings.catch_warnings(record=True) as caught_warnings:
        warnings.simplefilter("always")
        compiled = episode.is_compiled(None)
    for warning in caught_warnings:
        notify(str(warning.message))
    return compiled


def _print_results(
    periods: int,
    seconds: float,
    robot_metrics: list[dict[str, float]],
    times: list[float],
    paths: list[list[Pose]],
    playpen: "Playpen",
    picture: Path | None,
    force: bool,
) -> None:
    """Print the metrics of each robot, and draw the paths."""
    from khep_twin.lab.experiment.series_run import metric_lines

    typer.echo(f"{periods} cycles in {seconds:.1f} s")
    if (n_robots := len(robot_metrics)) > 1:
        typer.echo(f"{'':20}" + "".join(f"{robot_name(robot):<12}" for robot in range(n_robots)).rstrip())
    for line in metric_lines(robot_metrics):  # homing is undefined without a home
        typer.echo(line)
    if picture is not None:
        import numpy as np

        drawn_paths = [
            drawing.DrawnPath(robot_name(robot), np.array(times), 1000 * np.array(path)[:, :2])
            for robot, path in enumerate(paths)
        ]
        drawing.save(drawing.draw(playpen, drawn_paths), picture, force)
        typer.echo(f"picture  {picture}")


def _call_controller(function: Callable[..., Any], *readings: list[int]) -> tuple[float, float]:
    """Return the left and right speed computed by a user's function from readings [register]."""
    from khep_twin.lab.experiment.controllers import call, name_of

    speeds = call(function, *readings)
    try:
        left, right = speeds
        return float(left), float(right)
    except (TypeError, ValueError):
        raise ControllerError(
            f"{name_of(function)}: returned {speeds!r}; expected two speeds, such as (10, 10)"
        ) from None
