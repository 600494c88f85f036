"""The Khepera Toolbox's RoboRunner for programs: series of runs, their statistics, and the web page.

    runs = roborun2(brait, port_id=2, cycles_per_run=500, runs=3, save="out/brait")
    getstat()["fitness"].mean
    plotrun()
    user1(save="out/brait.csv")

`khep-twin run` and `khep-twin series` do the same from the command line, with more options.
"""

import subprocess
import sys
from collections.abc import Callable, Sequence
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING

from khep_twin import drawing
from khep_twin.errors import ControllerError, KhepTwinError
from khep_twin.files.atomic import write_atomic
from khep_twin.files.paths import StrPath
from khep_twin.host import Khepera
from khep_twin.lab.experiment import series_files, series_statistics
from khep_twin.lab.experiment.controller_files import call_on_run_end, find_controller, find_on_run_end
from khep_twin.lab.experiment.controller_source import source_of
from khep_twin.lab.experiment.controllers import AnyController, write_template
from khep_twin.lab.experiment.series import OneRobot, run_series
from khep_twin.lab.experiment.series_run import Plan, SeriesRun
from khep_twin.toolbox.controller import ToolboxController
from khep_twin.toolbox.form import as_toolbox_form
from khep_twin.toolbox.serial_commands import Port, robot_at
from khep_twin.toolbox.simulator import get_open_playpen
from khep_twin.toolbox.windows import show

if TYPE_CHECKING:
    from matplotlib.figure import Figure

UserFunction = str | Callable[..., object]
"""Function that is called after each run, or its location, FILE.py:NAME."""

_runs: list[SeriesRun] = []
"""Latest runs."""


def roborun2(
    ctrl_name: str | AnyController | Callable[..., object] | None = None,
    *,
    port_id: Port | None = None,
    cycles_per_run: int = 500,
    runs: int = 1,
    pause: float = 0.0,
    save: StrPath | None = None,
    user: UserFunction | Sequence[UserFunction] = (),
) -> list[SeriesRun]:
    """Run a controller several times; without one, open the web page with RoboRunner's controls.

    Args:
        ctrl_name: Function of `port_id, cycles_per_run, runs, pause_stat`, a controller, or the location of
            either, FILE.py:NAME.
        port_id: Port of the robot; without it, the robot of the playpen that is open.
        cycles_per_run: Cycles of each run; the toolbox has 500 to 10000.
        runs: Number of runs; the toolbox has 1 to 20.
        pause: Time between two runs, by the port's clock [s].
        save: Folder for each run's metrics and variables, written at its end, Save@Run End.
        user: Function called after each run, with the run or with those of its variables that it names.

    Returns:
        The runs, with their metrics and the controller's final variables.

    Raises:
        ControllerError: The controller does not exist, or it failed.
        KhepTwinError: The port failed, no playpen is open, or the folder cannot be used.
    """
    if ctrl_name is None:
        play_pen()
        return []
    is_location = isinstance(ctrl_name, str)
    controller = find_controller(ctrl_name, as_toolbox_form) if is_location else as_toolbox_form(ctrl_name)
    functions = [user] if isinstance(user, str) or callable(user) else user
    callbacks = [find_on_run_end(item, controller) if isinstance(item, str) else item for item in functions]
    robot = _find_robot(controller, port_id)
    plan = Plan(runs, cycles_per_run, pause=float(pause))
    folder = None
    if save is not None:
        settings = {"port": robot.name, "cycles": cycles_per_run, "pause": plan.pause}
        folder = series_files.SeriesFolder(Path(save), settings | source_of(controller).identity)
    _runs.clear()
    for run in run_series(controller, OneRobot(robot), plan):
        _runs.append(run)
        if folder is not None:
            folder.save(run)
        print(run.text(runs))
        for callback in callbacks:
            call_on_run_end(callback, run)
    return list(_runs)


def getstat(*, runs: Sequence[SeriesRun] | StrPath | None = None) -> dict[str, series_statistics.Summary]:
    """Return the statistics of runs: mean, standard deviation and confidence of each metric, by its name.

    The runs are those that `roborun2` returned, or its folder; without, those of the latest `roborun2`.

    Raises:
        ControllerError: There are no runs.
    """
    rows = _table_rows(runs)
    columns = series_statistics.measured_columns([rows])
    values = {name: series_statistics.finite_values(rows, name) for name in columns}
    return {name: series_statistics.summarize(values[name]) for name in columns}


def plotrun(
    *names: str, runs: Sequence[SeriesRun] | StrPath | None = None, picture: StrPath | None = None
) -> "Figure":
    """Draw the metrics over the runs, in a window where there is a screen.

    Args:
        names: Names of the metrics, e.g. "fitness"; without, the default ones.
        runs: Runs as for `getstat`.
        picture: PNG, SVG or PDF file to write.

    Raises:
        ControllerError: There are no runs, or a metric does not exist.
        KhepTwinError: The picture cannot be written.
    """
    from khep_twin.lab.experiment.figures import default_columns, draw

    rows = _table_rows(runs)
    columns = series_statistics.measured_columns([rows], names or None)
    figure = draw(["runs"], [rows], columns if names else default_columns(columns))
    if picture is not None:
        drawing.save(figure, Path(picture))
    show(figure, "plotrun")
    return figure


def user1(*, runs: Sequence[SeriesRun] | StrPath | None = None, save: StrPath | None = None) -> None:
    """Print the statistics of `getstat`, and save the table of runs as CSV, Parquet or MAT.

    Raises:
        ControllerError: There are no runs.
        KhepTwinError: The file cannot be written, or has another suffix.
    """
    rows = _table_rows(runs)
    tables = series_files.tables(rows)
    if save is not None and Path(save).suffix.lower() not in tables:
        raise KhepTwinError(f"user1: save = {str(save)!r}: expected a name that ends in {', '.join(tables)}")
    columns = series_statistics.measured_columns([rows])
    print(series_statistics.table(["runs"], [rows], columns))
    if save is not None:
        write_atomic(Path(save), tables[Path(save).suffix.lower()])


def template(file: StrPath) -> Path:
    """Write the toolbox's template, a function to complete and to pass to `roborun2` or `khep-twin run`.

    Raises:
        ControllerError: The file exists, or is no FILE.py.
        KhepTwinError: It cannot be written.
    """
    if Path(file).suffix != ".py":
        raise ControllerError(f"template: {file}: expected a name that ends in .py")
    if Path(file).exists():
        raise ControllerError(f"template: {file}: is there already; expected another name")
    write_template(None, Path(file))
    return Path(file)


def play_pen(file: StrPath | None = None) -> None:
    """Open the web page for playpens and runs until Ctrl-C, like `khep-twin design`.

    It opens a playpen file in the current folder or below, which need not exist.

    Raises:
        KhepTwinError: The page could not be opened; its process prints the reason.
    """
    command = [sys.executable, "-m", "khep_twin", "design", *([] if file is None else [str(file)])]
    with subprocess.Popen(command) as page:
        try:
            status = page.wait()
        except KeyboardInterrupt:
            page.terminate()
            page.wait()
            return
    if status not in (0, 130):
        raise KhepTwinError(f"play_pen: the page ended with status {status}")


def _find_robot(controller: AnyController, port_id: Port | None) -> Khepera:
    """Return the robot of a series."""
    simulated = isinstance(controller, ToolboxController) and controller.unpaced
    if port_id is None and not simulated:
        raise ControllerError(
            "roborun2: no port_id is given; expected 1 to 4, or a port such as '/dev/ttyUSB0'"
        )
    if simulated:
        simulator = get_open_playpen()
        return simulator.robots[simulator.index(port_id if isinstance(port_id, int) else 1)]
    assert port_id is not None
    if isinstance(controller, ToolboxController) and isinstance(port_id, int):
        controller.port_id = port_id
    return robot_at(port_id)


def _table_rows(runs: Sequence[SeriesRun] | StrPath | None) -> list[series_files.Row]:
    """Return runs as rows of a table."""
    if isinstance(runs, str | PathLike):
        rows = series_files.read_series(Path(runs))[1]
    else:
        rows = [series_files.row_of(run) for run in (_runs if runs is None else runs)]
    if not rows:
        raise ControllerError("there are no runs yet; expected roborun2 before, or the folder of a series")
    return rows
