"""`khep-twin shadow`: the twin beside a robot, live or from a log."""

import math
import re
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from khep_twin.cli.completion import logs
from khep_twin.cli.followed import ALARM_CODE, Followed
from khep_twin.cli.option_groups import grouped
from khep_twin.cli.options import Force, check_apart, check_new, check_writable, usage
from khep_twin.cli.playpen import PlaypenName
from khep_twin.cli.progress import progress as progress_bar
from khep_twin.clock import NS_PER_S
from khep_twin.errors import PlaypenError
from khep_twin.signals import stopping

if TYPE_CHECKING:
    from khep_twin.playpen import Playpen
    from khep_twin.shadow.recording import Heard
    from khep_twin.shadow.shadow import ShadowSettings

_NUMBER = r"-?\d{1,6}(?:\.\d{1,6})?"
_POSE = re.compile(rf"({_NUMBER}),({_NUMBER}),({_NUMBER})")
_WITHIN = re.compile(r"(\d{1,4}(?:\.\d{1,6})?),(\d{1,3}(?:\.\d{1,6})?)")


class ExitOn(StrEnum):
    """Event that ends a shadow."""

    ALARM = "alarm"


@dataclass(frozen=True, slots=True)
class ShadowOptions:
    """What a shadow is told of its robot."""

    start: Annotated[
        str,
        typer.Option(help="Start: known, as the playpen has it; X,Y,HEADING in mm and degrees; or unknown."),
    ] = "known"
    within: Annotated[str, typer.Option(metavar="MM,DEG", help="Standard deviations of a known start.")] = (
        "10,5"
    )
    seed: Annotated[int, typer.Option(help="Seed of the particles.")] = 0
    particles: Annotated[
        int, typer.Option(min=10, max=100_000, help="Number of particles, once the pose is known.")
    ] = 1000

    def load(self, name: str, robot: int = 0) -> "Playpen":
        """Return the playpen with the robot alone, at its start."""
        from khep_twin import playpen as playpens
        from khep_twin.playpen.starts import at_start

        found = playpens.load(name)
        if not 0 <= robot < len(found.robots):
            wanted = f"0 to {len(found.robots) - 1}" if len(found.robots) > 1 else "0"
            raise PlaypenError(f"{name}: robot {robot}; expected {wanted}, as it has {len(found.robots)}")
        found = found.model_copy(update={"robots": (found.robots[robot],)})
        if pose := _POSE.fullmatch(self.start):
            x_mm, y_mm, heading_deg = map(float, pose.groups())
            found = at_start(found, 0, (x_mm, y_mm, heading_deg))
        return found

    def settings(self, baud: int) -> "ShadowSettings":
        """Return the settings of a shadow."""
        from khep_twin.shadow.particle_filter import PUBLISHED
        from khep_twin.shadow.shadow import ShadowSettings

        if self.start not in ("known", "unknown") and not _POSE.fullmatch(self.start):
            raise usage(f"--start {self.start}: expected known, unknown or X,Y,HEADING, such as 100,250,90")
        if (within := _WITHIN.fullmatch(self.within)) is None:
            raise usage(f"--within {self.within}: expected MM,DEG, such as 10,5")
        place, heading = float(within[1]) / 1e3, math.radians(float(within[2]))
        spread = PUBLISHED._replace(place=place, heading=heading)
        return ShadowSettings(self.seed, self.particles, self.start != "unknown", spread, baud)


@grouped
def shadow(
    *,
    playpen: PlaypenName,
    log: Annotated[
        Path,
        typer.Argument(metavar="LOG", help="Log of a relay, or of a twin, FILE.mcap.", autocompletion=logs),
    ],
    robot: Annotated[int, typer.Option(min=0, help="Number of the robot in the log, from 0.")] = 0,
    options: ShadowOptions,
    until: Annotated[float | None, typer.Option(min=0, help="End at this time of the log [s].")] = None,
    exit_on: Annotated[
        ExitOn | None, typer.Option(help=f"End at the first alarm, with exit code {ALARM_CODE}.")
    ] = None,
    output: Annotated[
        Path | None,
        typer.Option("--output", "-o", help="Log of poses, residuals and alarms to write, FILE.mcap."),
    ] = None,
    force: Force = False,
) -> None:
    """Follow a robot by its line: where it is, and what is wrong with it.

    Standard output has a line for each alarm that begins or ends.
    """
    from khep_twin.shadow.recording import recorded

    settings = options.settings(9600)
    _check_output(playpen, log, output, force)
    line = recorded(log, robot)
    found = options.load(playpen)
    if line.baud is not None:
        settings = replace(settings, baud=line.baud)
    end_ns = line.heard[-1].time_ns if until is None else min(int(until * NS_PER_S), line.heard[-1].time_ns)
    with stopping() as stop:
        followed = Followed(found, settings, exit_on is not None, output)
        begun = time.monotonic()
        with progress_bar() as show:
            code = followed.follow(_until(line.heard, end_ns, show), stop)
        followed.close(time.monotonic() - begun)
    if code:
        raise typer.Exit(code)


def _until(
    heard: "Sequence[Heard]", end_ns: int, progress: Callable[[float], None] | None
) -> "Iterator[Heard]":
    """Yield what was heard up to a time, and that nothing came after it until then."""
    from khep_twin.shadow.recording import Heard

    for each in heard:
        if each.time_ns > end_ns:
            break
        yield each
        if progress is not None:
            progress(each.time_ns / end_ns)
    yield Heard(end_ns, True, b"")


def _check_output(playpen: str, log: Path, output: Path | None, force: bool) -> None:
    """Refuse a log that could not be written, or would replace what is read."""
    check_writable(output)
    check_apart([playpen, log], output)
    check_new(force, output)
