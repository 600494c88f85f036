"""The command line's part for sensor tests: `khep-twin sense`."""

from collections.abc import Callable
from dataclasses import dataclass, fields
from enum import StrEnum
from functools import partial
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from khep_twin.cli.completion import ports
from khep_twin.cli.option_groups import grouped
from khep_twin.cli.options import Force, check_new, check_picture, check_writable, complain
from khep_twin.cli.progress import of_part
from khep_twin.cli.progress import progress as progress_bar
from khep_twin.errors import KhepTwinError, SensorTestError
from khep_twin.files.atomic import resolved
from khep_twin.signals import stopping

if TYPE_CHECKING:
    from khep_twin.lab.sensor_test.sensor_test import SensorRun, SensorTest


class Sensors(StrEnum):
    """Kind of sensors that are read."""

    PROXIMITY = "proximity"
    LIGHT = "light"
    VISION = "vision"


@dataclass(frozen=True, slots=True)
class DriveOptions:
    """Options of the tests that are driven."""

    linear: Annotated[
        float | None,
        typer.Option(metavar="CM", help="Drive straight on, 5 to 60 cm, or backwards, -5 to -60."),
    ] = None
    rotate: Annotated[
        float | None,
        typer.Option(metavar="DEG", help="Turn on the spot, 15 to 360 degrees; below 0 clockwise."),
    ] = None
    speed: Annotated[
        int | None, typer.Option(help="Highest speed, 1 to 127 pulses/10 ms of 8 mm/s each; 20 by default.")
    ] = None
    acceleration: Annotated[
        int | None, typer.Option(help="Acceleration, 1 to 255 times 3.125 mm/s^2; 64 by default.")
    ] = None
    return_to_zero: Annotated[
        bool, typer.Option("--return", help="Wait 5 s at the end and drive back. Between runs always.")
    ] = False
    runs: Annotated[
        int | None, typer.Option(help="Number of runs, 1 to 100; files are numbered -1, -2, ...")
    ] = None
    text: Annotated[str | None, typer.Option(help="Description to keep with the data.")] = None
    output: Annotated[
        list[Path] | None,
        typer.Option("--output", "-o", help="File to write, .csv, .mat or .mcap; as many as wanted."),
    ] = None

    def tests(self, what: Sensors | None) -> "list[SensorTest]":
        """Return the tests to drive, in order."""
        from khep_twin.lab.sensor_test.sensor_test import DEFAULT_ACCELERATION, DEFAULT_SPEED, SensorTest

        count = 1 if self.runs is None else self.runs
        if not 1 <= count <= 100:
            raise SensorTestError(f"runs = {count}; expected an integer from 1 to 100")
        test = partial(
            SensorTest,
            "proximity" if what is None else what.value,
            self.linear,
            self.rotate,
            DEFAULT_SPEED if self.speed is None else self.speed,
            DEFAULT_ACCELERATION if self.acceleration is None else self.acceleration,
        )
        # Each run begins where the one before began.
        return [test(True)] * (count - 1) + [test(self.return_to_zero)]


@dataclass(frozen=True, slots=True)
class PictureOptions:
    """Options of the picture of the sensors."""

    picture: Annotated[Path | None, typer.Option(help="Draw the sensors as PNG, SVG or PDF.")] = None
    sensor: Annotated[str | None, typer.Option(help='Draw only this sensor, such as "left 10".')] = None
    y_min: Annotated[int | None, typer.Option(help="Lower end of the picture's axis of counts.")] = None
    grid: Annotated[bool, typer.Option("--grid", help="Draw a grid.")] = False
    overlay: Annotated[list[Path] | None, typer.Option(help="Earlier run to draw, too; repeatable.")] = None

    def check(self, earlier: "list[SensorRun]", tests: "list[SensorTest]") -> None:
        """Refuse a picture that could not be drawn in the end, before the robot moves."""
        if self.picture is None:
            return
        import numpy as np

        from khep_twin.lab.sensor_test import sensor_figure
        from khep_twin.lab.sensor_test.sensor_test import SensorRun

        check_picture(self.picture)
        ends = [np.zeros((2, 2 + len(test.quantity.names)), np.int64) for test in tests]
        for end, test in zip(ends, tests, strict=True):
            end[1, :2] = test.target
        expected = [SensorRun(test, end, np.zeros(2)) for test, end in zip(tests, ends, strict=True)]
        sensor_figure.check([*earlier, *expected], sensor=self.sensor, y_min=self.y_min or 0)

    def draw(self, runs: "list[SensorRun]", force: bool) -> None:
        """Draw runs, where a picture is wanted."""
        if self.picture is None or not runs:
            return
        from khep_twin.drawing import map as drawing
        from khep_twin.lab.sensor_test import sensor_figure

        figure = sensor_figure.draw(runs, sensor=self.sensor, y_min=self.y_min or 0, grid=self.grid)
        drawing.save(figure, self.picture, force)
        typer.echo(f"picture  {self.picture}")


@grouped
def sense(
    port: Annotated[
        str | None,
        typer.Argument(
            help="Port of a robot or a twin, such as /dev/ttyUSB0 or khep://default; without, earlier runs "
            "are drawn.",
            autocompletion=ports,
        ),
    ] = None,
    what: Annotated[
        Sensors | None, typer.Option(help="Quantity to read: proximity (default), light or vision.")
    ] = None,
    *,
    drive: DriveOptions,
    drawn: PictureOptions,
    force: Force = False,
) -> None:
    """Read a robot's sensors while it drives straight or turns.

    The readings become files and a picture.
    """
    from khep_twin.lab.sensor_test import sensor_files
    from khep_twin.lab.sensor_test.sensor_test import BrokenOffError

    _check_options(port, drive, drawn)
    tests = [] if port is None else drive.tests(what)
    names = [_numbered(drive.output or [], number, len(tests)) for number in range(1, len(tests) + 1)]
    outputs, pictures = [*chain.from_iterable(names)], [*filter(None, [drawn.picture])]
    check_writable(*outputs, *pictures)
    for path in outputs:
        sensor_files.checked_suffix(path)
    _check_distinct([*outputs, *pictures, *(drawn.overlay or [])])
    check_new(force, *outputs, *pictures)
    earlier = [sensor_files.load(path, what.value if what else None) for path in drawn.overlay or []]
    for path, run in zip(drawn.overlay or [], earlier, strict=True):
        if what is not None and run.test.what != what.value:
            raise SensorTestError(f"{path}: a run of {run.test.what}; expected {what.value}, as of --what")
    drawn.check(earlier, tests)

    done: list[SensorRun] = []
    broken: BrokenOffError | None = None
    stopped = False
    if port is not None:
        try:
            stopped = _drive(port, tests, drive.text or "", lambda run: _keep(done, run, names, force))
        except BrokenOffError as error:
            _keep(done, error.run, names, force)
            broken = error
    drawn.draw([*earlier, *done], force)
    if broken is not None:
        raise broken
    if stopped:
        complain("stopped before its end")
        raise typer.Exit(130)


def _check_options(port: str | None, drive: DriveOptions, drawn: PictureOptions) -> None:
    """Refuse options without effect, and a command without a task."""
    if drawn.picture is None and (option := _first(drawn)):
        raise SensorTestError(f"{option} is for the picture; expected --picture FILE.png, too")
    if port is None:
        if option := _first(drive):
            raise SensorTestError(f"{option} is for a robot; expected its PORT, such as khep://default")
        if not drawn.overlay:
            wanted = "expected a PORT such as khep://default, or --overlay FILE --picture FILE"
            raise SensorTestError(f"there is nothing to do; {wanted}")
    elif (drive.linear is None) == (drive.rotate is None):
        count = "none" if drive.linear is None else "both"
        wanted = "expected one, --linear CM or --rotate DEG"
        raise SensorTestError(f"--linear and --rotate: {count} is given; {wanted}")


def _first(options: DriveOptions | PictureOptions) -> str:
    """Return the first option that is given; empty without."""
    given = (field.name for field in fields(options) if getattr(options, field.name) not in (None, False, []))
    name = next(given, "").removesuffix("_to_zero").replace("_", "-")
    return name and f"--{name}"


def _numbered(paths: list[Path], number: int, count: int) -> list[Path]:
    """Return the names of one run's files: with its number before the suffix, if there are several."""
    return [path.with_stem(f"{path.stem}-{number}") if count > 1 and path.name else path for path in paths]


def _check_distinct(paths: list[Path]) -> None:
    places = [resolved(path) for path in paths]
    for number, path in enumerate(paths):
        if places[number] in places[:number]:
            raise SensorTestError(f"{path}: is given twice; expected a name for each file")


def _drive(port: str, tests: "list[SensorTest]", text: str, keep: "Callable[[SensorRun], None]") -> bool:
    """Drive the tests and pass on the data of each; return whether it was asked to end early."""
    from khep_twin.host import Khepera
    from khep_twin.lab.sensor_test.sensor_test import sense as drive

    with stopping() as stop, Khepera(port) as robot, progress_bar() as show:
        for number, test in enumerate(tests):
            shown = of_part(show, number, len(tests))
            keep(drive(robot, test, text=text, progress=shown, stop=stop))
            if stop():
                return True
    return False


def _keep(done: "list[SensorRun]", run: "SensorRun", names: list[list[Path]], force: bool) -> None:
    """Write a run's files, and print a summary of its readings."""
    from khep_twin.lab.sensor_test.sensor_files import save

    if not len(run.dv):
        return
    done.append(run)
    # First the files, then the text about them; a file that fails does not prevent the others.
    paths, failures = names[len(done) - 1], list[str]()
    for path in paths:
        try:
            save(path, run, force)
        except KhepTwinError as error:
            failures.append(str(error))
    way = f"{run.travelled[-1]:.1f} {run.test.unit}"
    typer.echo(f"run {len(done)}: {len(run.dv)} rows over {way} in {run.times[-1]:.1f} s")
    if run.test.what == "vision":
        typer.echo(f"  line image  {run.dv[:, 2:].min():4} to {run.dv[:, 2:].max():4} greys")
    else:
        for sensor, counts in zip(run.test.quantity.names, run.dv[:, 2:].T, strict=True):
            typer.echo(f"  {sensor:10}  {counts.min():4} to {counts.max():4} counts")
    if failures:
        raise KhepTwinError("\n".join(failures))
    for path in paths:
        typer.echo(f"data     {path}")
