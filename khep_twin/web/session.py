"""Sessions of the page: a twin in its playpen or a robot at a port, in a thread.

One thread owns the whole world of a twin; no other may touch it. The page's requests are passed to it, and
its pictures are passed to the page, at most 25 times a second.
"""

import os
import threading
from collections.abc import Callable

from khep_twin.errors import KhepTwinError, PortError
from khep_twin.host import Khepera
from khep_twin.machine import n_forks
from khep_twin.sensing import calibration
from khep_twin.units import BODIES
from khep_twin.web.captured_output import captured_by
from khep_twin.web.jobs import Job
from khep_twin.web.messages import Message, Publish, RobotShape

_ENDING_S = 5.0
"""Longest time for a session to end: its controller has a second for its cycle [s]."""

_PRINT_LIMIT = 20_000
"""Longest output of a controller that is sent at once [characters]."""


class WebSession:
    """Common part of twin and robot sessions: a thread with one job at a time.

    The thread calls `publish` with messages for the page. `job` is the current job, None without.
    """

    def __init__(self, publish: Publish) -> None:
        self._publish = publish
        self._left = False
        self.job: Job | None = None
        # The completed part of the job goes with the pictures, as jobs report it at each cycle.
        self._part = 0.0
        self._printed = ""
        self._n_forks = n_forks()
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._run, name="stage", daemon=True)

    def begin(self) -> None:
        """Start the thread."""
        self._thread.start()

    @property
    def alive(self) -> bool:
        """True if its thread is still running."""
        return self._thread.is_alive()

    def start(self, job: Job) -> None:
        """Start a job.

        Raises:
            PortError: The session has a job already, or has ended.
        """
        if self.job is not None or not self.alive:
            raise PortError("the robot is busy; expected a stopped robot" if self.alive else "it has ended")
        self._part = 0.0
        self.job = job

    def stop(self) -> None:
        """End the job and stop the motors."""
        raise NotImplementedError

    def end(self) -> None:
        """End the session; abandon a thread that does not end in time, and drop its messages."""
        self._ended.set()
        self._thread.join(_ENDING_S)
        if self.alive:
            self.publish({"kind": "error", "text": "the program does not end; it is left to itself"})
            self.publish({"kind": "ended"})
            self._left = True

    def publish(self, message: Message) -> None:
        """Send a message to the page, unless this session was abandoned."""
        if not self._left:
            self._publish(message)

    def take_printed(self, text: str) -> None:
        """Keep a controller's output for `_tell_printed`; of long output, keep the end."""
        self._printed += text
        if len(self._printed) > 2 * _PRINT_LIMIT:
            self._printed = self._printed[-_PRINT_LIMIT:]

    def _tell_printed(self) -> None:
        text, self._printed = self._printed, ""
        if text:
            self.publish({"kind": "printed", "text": text})

    def _run(self) -> None:
        try:
            self._live()
        except KhepTwinError as error:
            self.publish({"kind": "error", "text": error.plain})
        except BaseException as error:  # reported in the page, then raised as usual
            self.publish({"kind": "error", "text": f"{type(error).__name__}: {error}"})
            raise
        finally:
            self.job = None
            self.publish({"kind": "ended"})

    def _live(self) -> None:
        raise NotImplementedError

    def _progress(self, part: float) -> None:
        self._leave_a_fork()
        self._part = round(part, 4)

    def _leave_a_fork(self) -> None:
        """End a process that a controller has forked: the session is the designer's alone."""
        if n_forks() != self._n_forks:
            os._exit(0)

    def _do(self, robot: Khepera, stop: Callable[[], bool]) -> None:
        """Do the job; report its errors and continue."""
        if (job := self.job) is None:
            return
        try:
            with captured_by(self.take_printed):
                job.do(robot, self.publish, self._progress, stop)
        except KhepTwinError as error:
            if not stop():
                self.publish({"kind": "error", "text": error.plain})
        finally:
            self._leave_a_fork()
            self.job = None
            self._tell_printed()
            self.publish({"kind": "done"})


def shape(model: str, sensors: str) -> RobotShape:
    """Return a robot's radius and sensors, for drawing: [mm] and [deg]."""
    body = BODIES[model]
    poses = zip(body.sensor_positions, calibration.read(sensors)[0].heading_deg, strict=True)
    placed = [[round(x * 1e3, 2), round(y * 1e3, 2), heading] for (x, y), heading in poses]
    return {"radius_mm": body.radius * 1e3, "sensors": placed}
