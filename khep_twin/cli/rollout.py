"""`khep-twin rollout`: an episode without a serial line."""

import math
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from khep_twin.cli.completion import controllers
from khep_twin.cli.option_groups import LengthOptions, RobotOptions, SceneOptions, grouped
from khep_twin.cli.options import check_apart, check_body, check_picture, complain, usage
from khep_twin.cli.progress import progress as progress_bar

if TYPE_CHECKING:
    from khep_twin.rollout.episode import Episode

_SPAN_NS = 2_000_000_000
"""Simulated time between two updates of the progress bar [ns]."""


@grouped
def rollout(
    *,
    controller: Annotated[
        str,
        typer.Argument(
            help="braitenberg, or FILE.py[:NAME], a function of proximity and ambient light that returns "
            "both speeds.",
            autocompletion=controllers,
        ),
    ] = "braitenberg",
    scene: SceneOptions,
    length: LengthOptions,
    twin: RobotOptions,
    period: Annotated[float, typer.Option(help="Period of the controller [ms].")] = 20.0,
    step: Annotated[
        float | None,
        typer.Option(
            help="Step of the physics [ms]: 2.5, or coarser, 5 or 10; without, 2.5, or 10 with --planar."
        ),
    ] = None,
    planar: Annotated[bool, typer.Option("--planar", help="Simulate in a plane, not in MuJoCo.")] = False,
    picture: Annotated[Path | None, typer.Option(help="Draw playpen and path as PNG, SVG or PDF.")] = None,
) -> None:
    """Run one episode without a serial line and print its metrics; compiled if numba is installed."""
    import numpy as np

    from khep_twin.lab.experiment.experiment import find_function
    from khep_twin.playpen.starts import at_spots
    from khep_twin.ports.twin import equipped
    from khep_twin.rollout.controllers import Braitenberg, ConstantSpeed
    from khep_twin.rollout.episode import Episode, EpisodeSetup

    check_picture(picture)
    check_apart([scene.playpen], picture)
    options = twin.options()
    playpen = scene.load()
    target = None if picture is None else picture.absolute()  # a controller may go to another folder
    function = None
    if controller != "braitenberg":
        function = find_function(controller, "proximity and ambient light", 2)
    playpen, on_the_line = equipped(at_spots(playpen, options.seed), options)
    check_body(options.rom, (playpen.robots[index] for index in on_the_line))
    try:
        step_ns = None if step is None else round(step * 1e6)
        setup = EpisodeSetup(playpen, step_ns=step_ns, period_ns=round(period * 1e6), planar=planar)
        periods = length.cycles or setup.periods(60.0 if length.seconds is None else length.seconds)
    except ValueError as error:
        raise usage(str(error)) from None
    episode = Episode(
        setup,
        Braitenberg() if function is None else ConstantSpeed(),
        compiled=None if is_compiled() else False,
    )
    episode.begin(options.seed, noise=options.noise, vary=options.vary)
    way = [episode.pose]
    # Where the path is not needed in between, many periods pass at once, with the same results.
    at_once = 1 if function is not None or picture is not None else max(_SPAN_NS // setup.period_ns, 1)
    with progress_bar() as show:
        for done in range(0, periods, at_once):
            if function is not None:
                episode.drive(*_speeds(function, episode))
            now = min(at_once, periods - done)
            episode.step(now * setup.steps_per_period)
            way.append(episode.pose)
            if show is not None:
                show((done + now) / periods)
    _print_metrics(episode, periods)
    if target is not None:
        from khep_twin.drawing.map import DrawnPath, draw, save

        times = np.arange(len(way)) * setup.period_ns / 1e9
        save(draw(playpen, [DrawnPath("khepera0", times, 1000 * np.array(way)[:, :2])]), target)
        typer.echo(f"picture  {picture}")


def is_compiled() -> bool:
    """Return whether episodes run compiled; print a note where they do not."""
    from khep_twin.rollout import episode

    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        compiled = episode.is_compiled(None)
    for warning in told:
        complain(str(warning.message))
    return compiled


def _print_metrics(episode: "Episode", periods: int) -> None:
    typer.echo(f"{periods} cycles in {episode.time_ns / 1e9:.1f} s")
    for name, value in episode.metrics().items():
        if not math.isnan(value):  # homing is undefined without a home
            typer.echo(f"{name.replace('_', ' '):20}{value:.4g}")


def _speeds(function: Callable[..., Any], episode: "Episode") -> tuple[float, float]:
    """Return the left and right speed that a user's function makes of the readings [pulses/10 ms]."""
    from khep_twin.errors import ControllerError
    from khep_twin.lab.experiment.experiment import call, name_of

    speeds = call(function, *episode.readings())
    try:
        left, right = speeds
        return float(left), float(right)
    except (TypeError, ValueError):
        raise ControllerError(
            f"{name_of(function)}: returned {speeds!r}; expected two speeds in pulses per 10 ms, such as "
            "(10, 10)"
        ) from None
