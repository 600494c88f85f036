"""Logs: one self-contained MCAP file per run, which rerun and Foxglove open directly.

channels      topics and message types of a log, as ROS 2 messages
description   the scene as URDF; `foxglove_scene` is the same for Foxglove
recorder      writes a log while a world runs; `log_file` is the file
reader        reads a log as arrays
viewer        shows a log in rerun
"""

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from khep_twin.log.channels import TextLine as TextLine
    from khep_twin.log.reader import LoggedRun as LoggedRun
    from khep_twin.log.reader import Recording as Recording
    from khep_twin.log.reader import RobotTrack as RobotTrack
    from khep_twin.log.reader import read_arrays as read_arrays
    from khep_twin.log.reader import read_label as read_label
    from khep_twin.log.reader import read_log as read_log
    from khep_twin.log.reader import read_series as read_series
    from khep_twin.log.recorder import Recorder as Recorder
else:
    from khep_twin import lazy

    __getattr__, __dir__, __all__ = lazy.names(__name__)
