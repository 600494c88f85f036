"""Jobs of the page's robot, twin or real: controllers in series, and sensor tests."""

# matplotlib's own annotations leave keyword arguments open.
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
from khep_twin.lab.experiment.series_run import Plan
from khep_twin.lab.experiment.series_run import SeriesRun as DoneRun
from khep_twin.lab.sensor_test.sensor_test import SensorRun, SensorTest, sense
from khep_twin.toolbox.form import as_toolbox_form
from khep_twin.web.documents import PROGRAMS, Documents
from khep_twin.web.messages import Publish
from khep_twin.web.requests import RunRequest, SenseRequest

Progress = Callable[[float], None]
"""Function that takes the completed part of a job, 0 to 1."""


class Job(Protocol):
    """Job of the robot."""

    def do(self, robot: Khepera, publish: Publish, progress: Progress, stop: Callable[[], bool]) -> None:
        """Do the job and report its progress, until it is done or `stop` returns True."""
        ...


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
        plan, kept = self.plan, None
        if self.folder is not None:
            length = {"cycles": plan.cycles, "seconds": plan.seconds, "pause": plan.pause}
            kept = SeriesFolder(self.folder, {"controller": self.name, "port": robot.name, **length})

        def row(run: DoneRun, stopped: bool = False) -> None:
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

        broken_off = partial(row, stopped=True)
        source = OneRobot(robot)
        for run in run_series(
            self.controller, source, plan, progress=progress, stop=stop, broken_off=broken_off
        ):
            if kept is not None:
                kept.keep(run)
            row(run)


@dataclass(frozen=True, slots=True)
class Sensing:
    """A sensor test and its picture.

    Attributes:
        test: Test to run.
        keep: Function that takes the data.
        text: Description to keep with them.
    """

    test: SensorTest
    keep: Callable[[SensorRun], None]
    text: str = ""

    def do(self, robot: Khepera, publish: Publish, progress: Progress, stop: Callable[[], bool]) -> None:
        """Run the test."""
        run = sense(robot, self.test, text=self.text, progress=progress, stop=stop)
        self.keep(run)
        publish({"kind": "sensed", "warning": run.warning})


@dataclass(frozen=True, slots=True)
class FileJob:
    """A series whose controller is read when it begins: a file may print, and need not end.

    Attributes:
        asked: Request of the page.
        documents: Files of the folder.
        robot: Number of the robot that it drives.
    """

    asked: RunRequest
    documents: Documents
    robot: int

    def do(self, robot: Khepera, publish: Publish, progress: Progress, stop: Callable[[], bool]) -> None:
        """Read the controller and run the series."""
        series(self.asked, self.documents, self.robot).do(robot, publish, progress, stop)


def series(asked: RunRequest, documents: Documents, robot: int = 0) -> SeriesJob:
    """Return the series that the page requests for a robot.

    Raises:
        KhepTwinError: There is no such controller or plan, or a file is not below the folder.
    """
    name = asked.controllers[robot]
    if name in BUILT_IN:
        found = find_controller(name, as_toolbox_form)
    else:
        file, _, function = name.partition(":")
        path = documents.path(file, *PROGRAMS)
        forget_modules_beside(path)
        found = find_controller(f"{path}:{function}" if function else str(path), as_toolbox_form)
    plan = Plan(asked.runs, asked.cycles, asked.seconds, asked.pause)
    folder = documents.path(asked.folder, "") if asked.folder else None
    if folder is not None and len(asked.controllers) > 1:
        folder /= f"khepera{robot}"
    return SeriesJob(name, found, plan, folder, robot)


def sensing(asked: SenseRequest, keep: Callable[[SensorRun], None]) -> Sensing:
    """Return the sensor test that the page requests.

    Raises:
        SensorTestError: The test is invalid.
    """
    motion = (asked.amount, None) if asked.motion == "linear" else (None, asked.amount)
    test = SensorTest(asked.what, *motion, asked.speed, asked.acceleration, asked.back)
    return Sensing(test, keep, asked.text)


def figure(run: SensorRun, sensor: str | None, y_min: int, grid: bool) -> bytes:
    """Return the toolbox's picture of a sensor test, as PNG, or of a single sensor."""
    from khep_twin.lab.sensor_test.sensor_figure import draw

    picture = BytesIO()
    draw([run], sensor=sensor, y_min=y_min, grid=grid).savefig(picture, format="png", dpi=100)
    return picture.getvalue()
