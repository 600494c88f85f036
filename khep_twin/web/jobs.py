"""Jobs of the page's robot, twin or real: series of runs of a controller, and sensor tests."""

# matplotlib's annotations leave keyword arguments open.
# pyright: reportUnknownMemberType=false

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from io import BytesIO
from pathlib import Path
from typing import Protocol

from khep_twin.host import Khepera
from khep_twin.lab.experiment.controller_files import find_controller
from khep_twin.lab.experiment.controller_source import forget_modules_beside
from khep_twin.lab.experiment.controllers import BUILT_IN, AnyController
from khep_twin.lab.experiment.series import OneRobot, run_series
from khep_twin.lab.experiment.series_files import SeriesFolder
from khep_twin.lab.experiment.series_run import Plan, SeriesRun
from khep_twin.lab.sensor_test.sensor_test import SensorRun, SensorTest, sense
from khep_twin.toolbox.form import as_toolbox_form
from khep_twin.web.documents import PROGRAM_SUFFIXES, Documents
from khep_twin.web.messages import Publish
from khep_twin.web.requests import RunRequest, SenseRequest

Progress = Callable[[float], None]
"""Function that takes the completed part of a job, 0 to 1."""


class Job(Protocol):
    """Job of the robot."""

    def do(self, robot: Khepera, publish: Publish, progress: Progress, stop: Callable[[], bool]) -> None:
        """Do the job and report its progress, until it is done or `stop` returns True."""


@dataclass(frozen=True, slots=True)
class SeriesJob:
    """A series of runs of a controller.

    Attributes:
        name: Name of the controller.
        controller: Controller to run.
        plan: Plan of the series.
        folder: Folder for each run's metrics and variables; None to save nothing.
        robot: Number of the robot that it drives.
    """

    name: str
    controller: AnyController
    plan: Plan
    folder: Path | None
    robot: int = 0

    def do(self, robot: Khepera, publish: Publish, progress: Progress, stop: Callable[[], bool]) -> None:
        """Run the series."""
        plan = self.plan
        series_folder = None
        if self.folder is not None:
            limits = {"cycles": plan.cycles, "seconds": plan.seconds, "pause": plan.pause}
            settings = {"controller": self.name, "port": robot.name, **limits}
            series_folder = SeriesFolder(self.folder, settings)

        def publish_run(run: SeriesRun, stopped: bool = False) -> None:
            metrics = {name: value for name, value in run.metrics.items() if math.isfinite(value)}
            publish(
                {
                    "kind": "run",
                    "robot": self.robot,
                    "number": run.number,
                    "stopped": stopped,
                    "cycles": run.cycles,
                    "seconds": run.duration,
                    "metrics": metrics,
                }
            )

        on_abort = partial(publish_run, stopped=True)
        source = OneRobot(robot)
        for run in run_series(self.controller, source, plan, progress=progress, stop=stop, on_abort=on_abort):
            if series_folder is not None:
                series_folder.save(run)
            publish_run(run)


@dataclass(frozen=True, slots=True)
class SensorJob:
    """A sensor test and its picture.

    Attributes:
        test: Test to run.
        save: Function that takes the data.
        text: Description to save with them.
    """

    test: SensorTest
    save: Callable[[SensorRun], None]
    text: str = ""

    def do(self, robot: Khepera, publish: Publish, progress: Progress, stop: Callable[[], bool]) -> None:
        """Run the test."""
        run = sense(robot, self.test, text=self.text, progress=progress, stop=stop)
        self.save(run)
        publish({"kind": "sensed", "warning": run.warning})


@dataclass(frozen=True, slots=True)
class FileJob:
    """A series whose controller is read in the job: its file may print, and may never return.

    Attributes:
        request: Request of the page.
        documents: Files of the folder.
        robot: Number of the robot that it drives.
    """

    request: RunRequest
    documents: Documents
    robot: int

    def do(self, robot: Khepera, publish: Publish, progress: Progress, stop: Callable[[], bool]) -> None:
        """Read the controller and run the series."""
        series_job(self.request, self.documents, self.robot).do(robot, publish, progress, stop)


def series_job(request: RunRequest, documents: Documents, robot: int = 0) -> SeriesJob:
    """Return the series that the page requests for a robot.

    Raises:
        KhepTwinError: The controller or the plan is invalid, or a file is not below the folder.
    """
    name = request.controllers[robot]
    if name in BUILT_IN:
        controller = find_controller(name, as_toolbox_form)
    else:
        file, _, function = name.partition(":")
        path = documents.path(file, *PROGRAM_SUFFIXES)
        forget_modules_beside(path)
        controller = find_controller(f"{path}:{function}" if function else str(path), as_toolbox_form)
    plan = Plan(request.runs, request.cycles, request.seconds, request.pause)
    folder = documents.path(request.folder, "") if request.folder else None
    if folder is not None and len(request.controllers) > 1:
        folder /= f"khepera{robot}"
    return SeriesJob(name, controller, plan, folder, robot)


def sensor_job(request: SenseRequest, save: Callable[[SensorRun], None]) -> SensorJob:
    """Return the sensor test that the page requests.

    Raises:
        SensorTestError: The test is invalid.
    """
    motion = (request.amount, None) if request.motion == "linear" else (None, request.amount)
    test = SensorTest(request.what, *motion, request.speed, request.acceleration, request.back)
    return SensorJob(test, save, request.text)


def figure(run: SensorRun, sensor: str | None, y_min: int, grid: bool) -> bytes:
    """Return the toolbox's picture of a sensor test, or of a single sensor, as PNG."""
    from khep_twin.lab.sensor_test.sensor_figure import draw

    picture = BytesIO()
    draw([run], sensor=sensor, y_min=y_min, grid=grid).savefig(picture, format="png", dpi=100)
    return picture.getvalue()
