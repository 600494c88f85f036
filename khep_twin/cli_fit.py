"""The command line's part for fits: `khep-twin fit`."""

import math
import re
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from khep_twin.errors import FitError
from khep_twin.files import unusable, write_whole

if TYPE_CHECKING:
    from khep_twin.lab.wheel_fit import Drive

_MEASURED = re.compile(r"(?P<log>.+)=(?P<value>-?\d+(\.\d+)?)(?P<unit>mm|turns)")


def fit(
    measured: Annotated[
        list[str],
        typer.Argument(
            help="Logs of drives, each with what a person has measured of it: straight.mcap=998mm for a "
            "straight drive, spin.mcap=5turns for turns on the spot, counter-clockwise."
        ),
    ],
    check: Annotated[
        list[str] | None,
        typer.Option(help="A drive like these that is not used, but told how well it is met."),
    ] = None,
    start: Annotated[str, typer.Option(help="Calibration that the rest is taken from.")] = "khepera1",
    output: Annotated[Path | None, typer.Option("--output", "-o", help="Calibration file to write.")] = None,
) -> None:
    """Finds a robot's wheel radius and base from recorded drives and a ruler."""
    from khep_twin import calibration
    from khep_twin.lab.wheel_fit import fit_wheels, left_over
    from khep_twin.toml_files import dump

    if output is not None and (reason := unusable(output)):
        raise FitError(f"{output}: cannot be written: {reason}")
    drives = [_drive(text) for text in measured]
    unused = [_drive(text) for text in check or ()]
    before = calibration.read(start)[0]
    found = fit_wheels(drives)
    typer.echo(f"wheel radius  {found.radius * 1e3:.3f} mm +- {found.radius_interval * 1e3:.3f} (95 %)")
    typer.echo(f"wheel base    {found.base * 1e3:.2f} mm +- {found.base_interval * 1e3:.2f} (95 %)")
    for drive in drives:
        typer.echo(f"{drive.name}: {_shown(drive.distance, left_over(drive, found.radius, found.base))} left")
    for drive in unused:
        left = left_over(drive, found.radius, found.base)
        typer.echo(f"{drive.name}: {_shown(drive.distance, left)} off, not used for the fit")
    if output is not None:
        after = before.model_copy(
            update={
                "name": re.sub("[^A-Za-z0-9_-]", "-", output.stem)[:64],
                "source": f"{before.source}; wheels fitted to {len(drives)} drives",
                "wheels": found.calibration(),
            }
        )
        write_whole(output, dump(after).encode("utf-8"))
        typer.echo(f"calibration   {output}")


def _shown(distance: float | None, left: float) -> str:
    return f"{math.degrees(left):+.2f} degrees" if distance is None else f"{left * 1e3:+.2f} mm"


def _drive(text: str) -> "Drive":
    """A drive in words."""
    from khep_twin.lab.wheel_fit import Drive, pulses

    parts = _MEASURED.fullmatch(text)
    if parts is None:
        raise FitError(f"{text}: right is LOG=MILLIMETRESmm or LOG=TURNSturns, such as spin.mcap=5turns")
    left, right = pulses(Path(parts["log"]))
    value = float(parts["value"])
    if parts["unit"] == "mm":
        return Drive(parts["log"], left, right, distance=value / 1e3)
    return Drive(parts["log"], left, right, turned=value * 2 * math.pi)
