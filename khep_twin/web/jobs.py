"""Jobs of the page's robot, twin or real: series of runs of a controller, and sensor tests."""

# matplotlib's annotations leave keyword arguments open.
# pyright: reportUnknownMemberType=false

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from io import BytesIO
from pathlib import Path

from khep_twin.host.host_robot import HostRobot
from khep_twin.lab.experiment.controller_files import find_controller
from khep_twin.lab.experiment.controller_source import forget_modules_beside
from khep_twin.lab.experiment.controllers import BUILT_IN, AnyController, as_controller
from khep_twin.lab.experiment.series import OneRobot, run_series
from khep_twin.lab.experiment.series_files import SeriesFolder
from khep_twin.lab.experiment.series_run import Plan, SeriesRun
from khep_twin.lab.sensor_test.sensor_test import SensorRun, SensorTest, sense
from khep_twin.robots.model import robot_name
from khep_twin.toolbox.form import as_toolbox_form
from khep_twin.web.documents import PROGRAM_SUFFIXES, Documents
from khep_twin.web.messages import Publish
from khep_twin.web.requests import RunRequest, SenseRequest

Progress = Callable[[float], None]
"""Function that takes the completed part of a job, 0 to 1."""


Job = Callable[[HostRobot, Publish, Progress, Callable[[], bool]], None]
"""Job of the robot: does it and reports its progress, until it is done or the last function returns True."""


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

    def __call__(
        self, robot: HostRobot, publish: Publish, progress: Progress, stop: Callable[[], bool]
    ) -> None:
        """Run the series."""
        plan = self.plan
        as_controller(self.controller).require_model(robot.model)
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


def file_job(request: RunRequest, documents: Documents, number: int) -> Job:
    """Return a series whose controller is read in the job: its file may print, and may never return."""

    def do(robot: HostRobot, publish: Publish, progress: Progress, stop: Callable[[], bool]) -> None:
        series_job(request, documents, number)(robot, publish, progress, stop)

    return do


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
        folder /= robot_name(robot)
    return SeriesJob(name, controller, plan, folder, robot)


def sensor_test(request: SenseRequest) -> SensorTest:
    """Return the sensor test that the page requests.

    Raises:
        SensorTestError: The test is invalid.
    """
    motion = (request.amount, None) if request.motion == "linear" else (None, request.amount)
    return SensorTest(request.what, *motion, request.speed, request.acceleration, request.back)


def sensor_job(test: SensorTest, save: Callable[[SensorRun], None], text: str = "") -> Job:
    """Return a sensor test of a robot of any model, with a description; `save` takes its data."""

    def do(robot: HostRobot, publish: Publish, progress: Progress, stop: Callable[[], bool]) -> None:
        run = sense(robot, replace(test, model=robot.model.name), text=text, progress=progress, stop=stop)
        save(run)
        publish({"kind": "sensed", "warning": run.warning})

    return do


def figure(run: SensorRun, sensor: str | None, y_min: int, grid: bool) -> bytes:
    """Return the toolbox's picture of a sensor test, or of a single sensor, as PNG."""
    from khep_twin.lab.sensor_test.sensor_figure import draw

    picture = BytesIO()
    draw([run], sensor=sensor, y_min=y_min, grid=grid).savefig(picture, format="png", dpi=100)
    return picture.getvalue()
