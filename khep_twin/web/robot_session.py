"""Session of a robot at a port, whose readings are polled.

The thread alternates between a poll and the current job, whose progress callback polls as well.
"""

import threading
from contextlib import suppress

from khep_twin.errors import ProtocolError
from khep_twin.host import Khepera, Vision
from khep_twin.host.connection import connect
from khep_twin.host.host_robot import HostRobot
from khep_twin.web import messages
from khep_twin.web.messages import Publish
from khep_twin.web.robot_shape import robot_shape
from khep_twin.web.session import SessionActor

_POLL_INTERVAL = 0.08
"""Interval of the polls [s]."""


class RobotActor(SessionActor):
    """Robot, or twin that another process serves, at a port."""

    def __init__(self, url: str, publish: Publish) -> None:
        super().__init__(publish)
        self._url = url
        self._halt = threading.Event()
        self._vision: Vision | None = None
        self._start_time = 0.0
        self._poll_time = 0.0

    def _halt_motors(self) -> None:
        self._halt.set()

    def _serve(self) -> None:
        robot = connect(self._url)
        model = robot.model
        with robot:
            self._start_time = robot.time
            if isinstance(robot, Khepera):
                with suppress(ProtocolError):  # a robot without this turret
                    self._vision = Vision(robot)
            shape = robot_shape(model, model.calibration)
            self.publish({"kind": "robot", "robots": [{**shape, "name": robot.name, "port": self._url}]})
            while not self._is_ending():
                if self._halt.is_set():
                    robot.stop()
                    self._halt.clear()
                self._poll(robot)
                for job in self.jobs[:1]:
                    try:
                        if job is not None:
                            self._do_job(job, robot, self._is_stopping)
                    finally:
                        self._finish_jobs()
                self._halt.wait(_POLL_INTERVAL)

    def _is_stopping(self) -> bool:
        return self._halt.is_set() or self._is_ending()

    def _set_progress(self, progress: float, robot: HostRobot) -> None:
        super()._set_progress(progress, robot)
        if robot.time - self._poll_time > 2 * _POLL_INTERVAL:
            self._poll(robot)

    def _poll(self, robot: HostRobot) -> None:
        """Read the sensors and publish the robot's state to the page."""
        self.output.flush()
        values = robot.read_panel()
        readings: messages.RobotReadings = {
            "proximity": values["proximity"],
            "ambient": values["ambient"],
            "speed": values["speed"],
            "leds": [0, 0],
        }
        self._poll_time = robot.time
        if self._vision is not None and not self.jobs:  # a program must not wait for an image
            readings["vision"] = [*self._vision.image()]
        time, busy = robot.time - self._start_time, bool(self.jobs)
        self.publish(
            {"kind": "picture", "time": time, "busy": busy, "part": self._progress, "robots": [readings]}
        )
