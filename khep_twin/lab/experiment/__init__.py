"""Controllers, series of runs, their metrics, and runs repeated from logs."""

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from khep_twin.lab.experiment.controller_files import find_controller as find_controller
    from khep_twin.lab.experiment.controllers import Controller as Controller
    from khep_twin.lab.experiment.controllers import braitenberg as braitenberg
    from khep_twin.lab.experiment.experiment import Outcome as Outcome
    from khep_twin.lab.experiment.experiment import run as run
    from khep_twin.lab.experiment.multi_robot import run_together as run_together
    from khep_twin.lab.experiment.periodic_controllers import NetworkController as NetworkController
    from khep_twin.lab.experiment.series import FreshTwins as FreshTwins
    from khep_twin.lab.experiment.series import OneRobot as OneRobot
    from khep_twin.lab.experiment.series import run_series as run_series
    from khep_twin.lab.experiment.series_files import SeriesFolder as SeriesFolder
    from khep_twin.lab.experiment.series_files import read_series as read_series
    from khep_twin.lab.experiment.series_run import Plan as Plan
    from khep_twin.lab.experiment.series_run import SeriesRun as SeriesRun
    from khep_twin.lab.experiment.start_poses import StartPose as StartPose
    from khep_twin.lab.experiment.start_poses import starts as starts
    from khep_twin.lab.experiment.task_controller import TaskController as TaskController
else:
    from khep_twin import lazy

    __getattr__, __dir__, __all__ = lazy.names(__name__)
