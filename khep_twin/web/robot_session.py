"""Session of a robot, or of a twin that is served elsewhere, at a port."""

import threading
from contextlib import suppress

from khep_twin.errors import ProtocolError
from khep_twin.host import Khepera, Vision, commands
from khep_twin.web import messages
from khep_twin.web.messages import Publish
from khep_twin.web.session import WebSession, shape

_LOOK = 0.08
"""Interval at which the readings of a robot at a port are requested [s]."""


class RobotActor(WebSession):
    """Robot, or twin that is served elsewhere, at a port; its readings are polled."""

    def __init__(self, url: str, publish: Publish) -> None:
        super().__init__(publish)
        self._url = url
        self._halt = threading.Event()
        self._robot: Khepera | None = None
        self._vision: Vision | None = None
        self._began = self._looked = 0.0

    def stop(self) -> None:
        """End the job and stop the motors."""
        self._halt.set()

    def _live(self) -> None:
        with Khepera(self._url) as robot:
            self._robot, self._began = robot, robot.time
            with suppress(ProtocolError):  # a robot without this turret
                self._vision = Vision(robot)
            told: messages.PresentRobot = {
                **shape("khepera1", "khepera1"),
                "name": robot.name,
                "port": self._url,
            }
            self.publish({"kind": "robot", "robots": [told]})
            while not self._ended.is_set():
                if self._halt.is_set():
                    robot.set_speed(0, 0)
                    self._halt.clear()
                self._look(robot)
                if self.job is not None:
                    self._do(robot, self._stopping)
                self._halt.wait(_LOOK)

    def _stopping(self) -> bool:
        return self._halt.is_set() or self._ended.is_set()

    def _progress(self, part: float) -> None:
        super()._progress(part)
        if self._robot is not None and self._robot.time - self._looked > 2 * _LOOK:
            self._look(self._robot)

    def _look(self, robot: Khepera) -> None:
        self._tell_printed()
        proximity, ambient, speed = robot.burst(commands.proximity(), commands.ambient(), commands.speed())
        self._looked = robot.time
        reading: messages.RobotReadings = {
            "proximity": [*proximity],
            "ambient": [*ambient],
            "speed": [*speed],
            "leds": [0, 0],
        }
        if self._vision is not None and self.job is None:  # a program's turns are not to wait for an image
            reading["vision"] = [*self._vision.image()]
        time_s, busy = robot.time - self._began, self.job is not None
        self.publish(
            {"kind": "picture", "time": time_s, "busy": busy, "part": self._part, "robots": [reading]}
        )
