"""`khep-twin sense`: sensor tests during straight drives and turns."""

from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from enum import StrEnum
from functools import partial
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from khep_twin import drawing
from khep_twin.cli.completion import ports
from khep_twin.cli.option_groups import with_help
from khep_twin.cli.options import Force, check_new, check_picture, check_writable, notify
from khep_twin.cli.progress import part_bar
from khep_twin.cli.progress import progress as progress_bar
from khep_twin.errors import KhepTwinError, SensorTestError
from khep_twin.files.atomic import resolve
from khep_twin.process.signals import stopping
from khep_twin.robots.registry import default_model

if TYPE_CHECKING:
    from khep_twin.lab.sensor_test.sensor_test import SensorRun, SensorTest


class Sensors(StrEnum):
    """Kind of sensors to read."""

    PROXIMITY = "proximity"
    LIGHT = "light"
    VISION = "vision"


@dataclass(frozen=True, slots=True)
class DriveOptions:
    """Options of the driven tests.

    Attributes:
        linear: Drive straight, 5 to 60 cm forwards, or -5 to -60 cm backwards.
        rotate: Turn on the spot, 15 to 360 degrees, or clockwise, -15 to -360.
        speed: Highest speed, 1 to 127 pulses/10 ms of 8 mm/s each; by default 20.
        acceleration: Acceleration, 1 to 255 times 3.125 mm/s^2; by default 64.
        return_to_zero: Wait 5 s at the end and drive back; always between runs.
        runs: Number of runs, 1 to 100; files are numbered -1, -2, ...
        text: Description to store with the data.
        output: File to write, .csv, .mat or .mcap; repeatable.
    """

    linear: Annotated[float | None, typer.Option(metavar="CM")] = None
    rotate: Annotated[float | None, typer.Option(metavar="DEG")] = None
    speed: int | None = None
    acceleration: int | None = None
    return_to_zero: Annotated[bool, typer.Option("--return")] = False
    runs: int | None = None
    text: str | None = None
    output: Annotated[list[Path] | None, typer.Option("--output", "-o")] = None

    def tests(self, sensors: Sensors | None) -> "list[SensorTest]":
        """Return the tests to drive, in order."""
        from khep_twin.lab.sensor_test.sensor_test import DEFAULT_ACCELERATION, DEFAULT_SPEED, SensorTest

        count = 1 if self.runs is None else self.runs
        if not 1 <= count <= 100:
            raise SensorTestError(f"runs = {count}; expected an integer from 1 to 100")
        test = partial(
            SensorTest,
            "proximity" if sensors is None else sensors.value,
            self.linear,
            self.rotate,
            DEFAULT_SPEED if self.speed is None else self.speed,
            DEFAULT_ACCELERATION if self.acceleration is None else self.acceleration,
        )
        # Each run starts where the previous one started.
        return [test(True)] * (count - 1) + [test(self.return_to_zero)]


@dataclass(frozen=True, slots=True)
class PictureOptions:
    """Options of the picture of the sensors."""

    picture: Annotated[Path | None, typer.Option(help="Draw the sensors as PNG, SVG or PDF.")] = None
    sensor: Annotated[str | None, typer.Option(help='Draw only this sensor, such as "left 10".')] = None
    y_min: Annotated[int | None, typer.Option(help="Lower limit of the picture's axis of counts.")] = None
    grid: Annotated[bool, typer.Option("--grid", help="Draw a grid.")] = False
    overlay: Annotated[list[Path] | None, typer.Option(help="Also draw this earlier run; repeatable.")] = None

    def check(self, earlier_runs: "list[SensorRun]", tests: "list[SensorTest]") -> None:
        """Refuse a picture that could not be drawn at the end, before the robot moves."""
        if self.picture is None:
            return
        import numpy as np

        from khep_twin.lab.sensor_test import sensor_figure
        from khep_twin.lab.sensor_test.sensor_test import SensorRun

        check_picture(self.picture)
        tables = [np.zeros((2, 2 + len(test.quantity.names)), np.int64) for test in tests]
        for rows, test in zip(tables, tests, strict=True):
            rows[1, :2] = test.target
        expected = [SensorRun(test, end, np.zeros(2)) for test, end in zip(tests, tables, strict=True)]
        sensor_figure.check([*earlier_runs, *expected], sensor=self.sensor, y_min=self.y_min or 0)

    def draw(self, runs: "list[SensorRun]", force: bool) -> None:
        """Draw runs, if a picture is requested."""
        if self.picture is None or not runs:
            return
        from khep_twin.lab.sensor_test import sensor_figure

        figure = sensor_figure.draw(runs, sensor=self.sensor, y_min=self.y_min or 0, grid=self.grid)
        drawing.save(figure, self.picture, force)
        typer.echo(f"picture  {self.picture}")


@with_help
def sense(
    port: Annotated[str | None, typer.Argument(autocompletion=ports)] = None,
    sensors: Annotated[Sensors | None, typer.Option("--what")] = None,
    *,
    drive: DriveOptions,
    picture_options: PictureOptions,
    force: Force = False,
) -> None:
    """Read a robot's sensors while it drives straight or turns.

    The readings are written to files and drawn in a picture.

    Args:
        port: Port of a robot or a twin, e.g. /dev/ttyUSB0 or khep://default; without it, earlier runs are
            drawn.
        sensors: Quantity to read: proximity (default), light or vision.
    """
    from khep_twin.lab.sensor_test import sensor_files
    from khep_twin.lab.sensor_test.sensor_test import BrokenOffError

    _check_options(port, drive, picture_options)
    overlay = picture_options.overlay or []
    tests = [] if port is None else drive.tests(sensors)
    paths = [_numbered_paths(drive.output or [], number, len(tests)) for number in range(1, len(tests) + 1)]
    outputs, pictures = [*chain.from_iterable(paths)], [*filter(None, [picture_options.picture])]
    check_writable(*outputs, *pictures)
    for path in outputs:
        sensor_files.check_suffix(path)
    _check_distinct([*outputs, *pictures, *overlay])
    check_new(force, *outputs, *pictures)
    earlier_runs = [sensor_files.load(path, sensors.value if sensors else None) for path in overlay]
    for path, run in zip(overlay, earlier_runs, strict=True):
        if sensors is not None and run.test.what != sensors.value:
            raise SensorTestError(f"{path}: a run of {run.test.what}; expected {sensors.value}, as in --what")
    if port is None:
        picture_options.check(earlier_runs, [])

    runs: list[SensorRun] = []
    failure: BrokenOffError | None = None
    is_stopped = False
    if port is not None:
        try:
            mat_files = [path for path in outputs if path.suffix.lower() == ".mat"]
            is_stopped = _drive(
                port,
                tests,
                drive.text or "",
                lambda run: _save_run(runs, run, paths, force),
                lambda tests: picture_options.check(earlier_runs, tests),
                mat_files,
            )
        except BrokenOffError as error:
            _save_run(runs, error.run, paths, force)
            failure = error
    picture_options.draw([*earlier_runs, *runs], force)
    if failure is not None:
        raise failure
    if is_stopped:
        notify("stopped before its end")
        raise typer.Exit(130)


def _check_options(port: str | None, drive: DriveOptions, picture_options: PictureOptions) -> None:
    """Refuse options without effect, and a command without a task."""
    if picture_options.picture is None and (option := _first_option(picture_options)):
        raise SensorTestError(f"{option} is for the picture; expected --picture FILE.png with it")
    if port is None:
        if option := _first_option(drive):
            raise SensorTestError(f"{option} is for a robot; expected its PORT, such as khep://default")
        if not picture_options.overlay:
            expected = "expected a PORT such as khep://default, or --overlay FILE --picture FILE"
            raise SensorTestError(f"there is nothing to do; {expected}")
    elif (drive.linear is None) == (drive.rotate is None):
        count = "none" if drive.linear is None else "both"
        expected = "expected one, --linear CM or --rotate DEG"
        raise SensorTestError(f"--linear and --rotate: {count} is given; {expected}")


def _first_option(options: DriveOptions | PictureOptions) -> str:
    """Return the first option that is set; empty if none is."""
    names = (field.name for field in fields(options) if getattr(options, field.name) not in (None, False, []))
    name = next(names, "").removesuffix("_to_zero").replace("_", "-")
    return name and f"--{name}"


def _numbered_paths(paths: list[Path], number: int, count: int) -> list[Path]:
    """Return the paths of one run's files, numbered before the suffix if there are several runs."""
    return [path.with_stem(f"{path.stem}-{number}") if count > 1 and path.name else path for path in paths]


def _check_distinct(paths: list[Path]) -> None:
    real_paths = [resolve(path) for path in paths]
    for number, path in enumerate(paths):
        if real_paths[number] in real_paths[:number]:
            raise SensorTestError(f"{path}: is given twice; expected a name for each file")


def _drive(
    port: str,
    tests: "list[SensorTest]",
    text: str,
    save_run: "Callable[[SensorRun], None]",
    check: "Callable[[list[SensorTest]], None]",
    mat_files: list[Path],
) -> bool:
    """Check the tests, drive them and save each run; return whether the user stopped them."""
    from khep_twin.host.connection import connect
    from khep_twin.lab.sensor_test.sensor_test import sense as drive

    with stopping() as stop, connect(port) as robot, progress_bar() as show:
        tests = [replace(test, model=robot.model.name) for test in tests]
        if robot.model.family != default_model().family and mat_files:
            kind = robot.dialect.robot_name
            raise SensorTestError(
                f"{mat_files[0]}: has a Khepera's sensors; expected .csv or .mcap for {kind}"
            )
        check(tests)
        for number, test in enumerate(tests):
            show_part = part_bar(show, number, len(tests))
            save_run(drive(robot, test, text=text, progress=show_part, stop=stop))
            if stop():
                return True
    return False


def _save_run(runs: "list[SensorRun]", run: "SensorRun", run_paths: list[list[Path]], force: bool) -> None:
    """Write a run's files, and print a summary of its readings."""
    from khep_twin.lab.sensor_test.sensor_files import save

    if not len(run.dv):
        return
    runs.append(run)
    # Write the files before printing; a file that fails does not prevent the others.
    paths, failures = run_paths[len(runs) - 1], list[str]()
    for path in paths:
        try:
            save(path, run, force)
        except KhepTwinError as error:
            failures.append(str(error))
    distance = f"{run.travelled[-1]:.1f} {run.test.unit}"
    typer.echo(f"run {len(runs)}: {len(run.dv)} rows over {distance} in {run.times[-1]:.1f} s")
    if run.test.what == "vision":
        typer.echo(f"  line image  {run.dv[:, 2:].min():4} to {run.dv[:, 2:].max():4} greys")
    else:
        width = max(10, *map(len, names := run.test.quantity.names))
        for sensor, counts in zip(names, run.dv[:, 2:].T, strict=True):
            typer.echo(f"  {sensor:{width}}  {counts.min():4} to {counts.max():4} counts")
    if failures:
        raise KhepTwinError("\n".join(failures))
    for path in paths:
        typer.echo(f"data     {path}")
