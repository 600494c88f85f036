"""`khep-twin run --fast`: an episode without a serial line."""

import math
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

from khep_twin.cli.options import check_body, complain, usage
from khep_twin.cli.progress import progress as progress_bar

if TYPE_CHECKING:
    from khep_twin.playpen import Playpen
    from khep_twin.ports.twin import TwinOptions
    from khep_twin.rollout.life import Episode

KNOWN = {
    "controller",
    "playpen",
    "seconds",
    "cycles",
    "fast",
    "force",
    "period",
    "step",
    "planar",
    "picture",
    "seed",
    "noise",
    "spread",
    "mode",
    "model",
    "rom",
    "battery_used_min",
    "lighting",
    "without_lamp",
}
"""Options of `run` that go with --fast, by the names of their parameters."""


def check_fast(given: set[str], fast: bool) -> None:
    """Refuse options that do not go together."""
    if fast and (strange := given - KNOWN):
        option = min(strange).replace("_", "-")
        raise usage(f"--{option} does not go with --fast, which has no serial line and no log")
    if not fast and (lonely := given & {"period", "step", "planar"}):
        raise usage(f"--{min(lonely)} goes with --fast")


def run_fast(
    controller: str,
    playpen: "Playpen",
    options: "TwinOptions",
    *,
    seconds: float,
    cycles: int | None,
    period: float,
    step: float | None,
    planar: bool,
    picture: Path | None,
) -> None:
    """Run one episode and print its result.

    Args:
        controller: Controller as typed.
        playpen: Playpen with one robot.
        options: Options of the robot.
        seconds: Duration [s].
        cycles: Duration in control periods, instead.
        period: Period of the controller [ms].
        step: Step of the physics [ms]; None for 2.5 ms, and 10 ms in a plane.
        planar: Simulate in a plane instead of MuJoCo.
        picture: File to draw the path in, if any.
    """
    import numpy as np

    from khep_twin.lab.experiment.experiment import find_function
    from khep_twin.playpen import placed
    from khep_twin.ports.twin import equipped
    from khep_twin.randomness import stream
    from khep_twin.rollout.life import SPAN_NS, Episode, EpisodeSetup, is_compiled
    from khep_twin.rollout.minds import Braitenberg, ConstantSpeed

    target = None if picture is None else picture.absolute()  # a controller may go to another folder
    function = None
    if controller != "braitenberg":
        function = find_function(controller, "proximity and ambient light", 2)
    scene, on_the_line = equipped(placed(playpen, stream(options.seed, "spots")), options)
    check_body(options.rom, (scene.robots[index] for index in on_the_line))
    try:
        step_ns = None if step is None else round(step * 1e6)
        ground = EpisodeSetup(scene, step_ns=step_ns, period_ns=round(period * 1e6), planar=planar)
        periods = cycles or ground.periods(seconds)
    except ValueError as error:
        raise usage(str(error)) from None
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        compiled = is_compiled(None)
    for warning in told:
        complain(str(warning.message))
    life = Episode(ground, Braitenberg() if function is None else ConstantSpeed(), compiled=compiled)
    life.begin(options.seed, noise=options.noise, spread=options.spread)
    way = [life.pose]
    # Where the path is not needed in between, many periods pass at once, with the same results.
    at_once = 1 if function is not None or picture is not None else max(SPAN_NS // ground.period_ns, 1)
    with progress_bar() as show:
        for done in range(0, periods, at_once):
            if function is not None:
                life.drive(*_speeds(function, life))
            now = min(at_once, periods - done)
            life.go_on(now * ground.wiring.steps_per_period)
            way.append(life.pose)
            if show is not None:
                show((done + now) / periods)
    typer.echo(f"{periods} cycles in {life.time_ns / 1e9:.1f} s")
    for name, value in life.numbers().items():
        if not math.isnan(value):  # homing is undefined without a home
            typer.echo(f"{name.replace('_', ' '):20}{value:.4g}")
    if target is not None:
        from khep_twin.drawing.map import DrawnPath, draw, save

        times = np.arange(len(way)) * ground.period_ns / 1e9
        save(draw(scene, [DrawnPath("khepera0", times, 1000 * np.array(way)[:, :2])]), target)
        typer.echo(f"picture  {picture}")


def _speeds(function: Callable[..., Any], life: "Episode") -> tuple[float, float]:
    """Return the left and right speed that a user's function makes of the readings [pulses/10 ms]."""
    from khep_twin.errors import ControllerError
    from khep_twin.lab.experiment.experiment import call, name_of

    speeds = call(function, *life.readings())
    try:
        left, right = speeds
        return float(left), float(right)
    except (TypeError, ValueError):
        raise ControllerError(
            f"{name_of(function)}: returned {speeds!r}; expected two speeds in pulses per 10 ms, such as "
            "(10, 10)"
        ) from None
