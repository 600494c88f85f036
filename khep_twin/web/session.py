"""Session of the page: an actor, which is an object with its own thread.

The thread alone may touch the twin's world or the robot's port. Other threads only put requests into the
actor's mailbox: jobs here, moves and switches in `paced_twin`, an event in `robot_session`. The thread
answers with messages to the page. Two states describe an actor, its activity
(idle: `jobs` is empty; stopping: `_stopping_jobs` is `jobs`) and its phase:

    activity:  idle --start_jobs--> running --stop_jobs--> stopping
                 ^---------- done ------+------ done ---------+

    phase:     open --end--> ending
                 +-------------+----- jobs or thread not over in time --> abandoned
"""

import os
import threading
from collections.abc import Callable
from ctypes import c_ulong, py_object, pythonapi
from enum import IntEnum

from khep_twin.errors import KhepTwinError, PortError, user_error_text
from khep_twin.host.host_robot import HostRobot
from khep_twin.process.machine import n_forks
from khep_twin.web.jobs import Job
from khep_twin.web.messages import Message, Publish
from khep_twin.web.print_capture import PrintBuffer, captured_by

_ENDING_S = 5.0
"""Longest time for jobs or a session to end: a controller has a second for its cycle [s]."""

_ABANDONED_TEXT = (
    "the program does not end; it is left to itself, and its session is over: Run begins another"
)


class Phase(IntEnum):
    """Phase of a session; it never decreases."""

    OPEN = 0
    ENDING = 1
    ABANDONED = 2


class SessionActor:
    """Common part of twin and robot sessions: a thread with one job at a time for each robot.

    The thread calls `publish` with messages for the page. `jobs` are the current jobs, with None for a robot
    that stands; empty while idle.
    """

    def __init__(self, publish: Publish) -> None:
        self._publish = publish
        self._phase = Phase.OPEN
        self._phase_lock = threading.Lock()
        self.jobs: tuple[Job | None, ...] = ()
        self._stopping_jobs: tuple[Job | None, ...] = ()
        self._job_threads: set[int] = set()
        # Jobs report their completed part at each cycle; it is sent with the pictures.
        self._progress = 0.0
        self.output = PrintBuffer(self.publish, "printed")
        self._n_forks = n_forks()
        self._thread = threading.Thread(target=self._run, name="stage", daemon=True)

    def begin(self) -> None:
        """Start the thread."""
        self._thread.start()

    @property
    def is_alive(self) -> bool:
        """True if the thread is still running and was not abandoned."""
        return self._phase != Phase.ABANDONED and self._thread.is_alive()

    def start_jobs(self, *jobs: Job | None) -> None:
        """Start jobs, the first one for the first robot; None lets a robot stand.

        Raises:
            PortError: The session has jobs already or has ended.
        """
        if self.jobs or not self.is_alive:
            text = "the robot is busy; expected a stopped robot" if self.is_alive else "it has ended"
            raise PortError(text)
        self._progress = 0.0
        self.jobs = jobs

    def stop_jobs(self) -> None:
        """End the jobs and stop the motors; abandon a thread whose jobs do not end in time."""
        if (jobs := self.jobs) and jobs is not self._stopping_jobs:
            self._stopping_jobs = jobs
            timer = threading.Timer(_ENDING_S, lambda: self.jobs is jobs and self._abandon())
            timer.daemon = True
            timer.start()
        self._halt_motors()

    def end(self) -> None:
        """End the session; abandon a thread that does not end in time."""
        with self._phase_lock:
            self._phase = max(self._phase, Phase.ENDING)
        if self._phase != Phase.ABANDONED:
            self._thread.join(_ENDING_S)
        if self._thread.is_alive():
            self._abandon()

    def _abandon(self) -> None:
        """Abandon the thread: drop its messages, and interrupt its programs if they execute Python."""
        with self._phase_lock:
            if self._phase == Phase.ABANDONED:
                return
            self._phase = Phase.ABANDONED
            for thread in list(self._job_threads):
                pythonapi.PyThreadState_SetAsyncExc(c_ulong(thread), py_object(SystemExit))
            self._publish({"kind": "error", "text": _ABANDONED_TEXT})
            self._publish({"kind": "ended"})

    def publish(self, message: Message) -> None:
        """Send a message to the page, unless this session was abandoned."""
        if self._phase != Phase.ABANDONED:
            self._publish(message)

    def _is_ending(self) -> bool:
        return self._phase != Phase.OPEN

    def _run(self) -> None:
        """Run the session in its thread; report errors, and the end, to the page."""
        try:
            self._serve()
        except BaseException as error:  # reported in the page; a fault is then raised as usual
            text = user_error_text(error)
            self.publish({"kind": "error", "text": text or f"{type(error).__name__}: {error}"})
            if text is None:
                raise
        finally:
            self.jobs = ()
            self.publish({"kind": "ended"})

    def _halt_motors(self) -> None:
        """Request the end of the jobs and a stop of the motors."""
        raise NotImplementedError

    def _serve(self) -> None:
        """Run the session until it is ending."""
        raise NotImplementedError

    def _set_progress(self, progress: float, robot: HostRobot) -> None:
        self._exit_if_forked()
        self._progress = round(progress, 4)

    def _do_job(self, job: Job, robot: HostRobot, stop: Callable[[], bool]) -> None:
        """Do a job; report its errors and continue."""
        self._job_threads.add(threading.get_ident())
        try:
            with captured_by(self.output.add):
                job(robot, self.publish, lambda part: self._set_progress(part, robot), stop)
        except KhepTwinError as error:
            if not stop():
                self.publish({"kind": "error", "text": error.plain})
        finally:
            self._job_threads.discard(threading.get_ident())
            self._exit_if_forked()

    def _exit_if_forked(self) -> None:
        """End this process immediately if it is a fork by a controller, with a copy of the session."""
        if n_forks() != self._n_forks:
            os._exit(0)

    def _finish_jobs(self) -> None:
        """Report the end of the jobs."""
        self.jobs = ()
        self.output.flush()
        self.publish({"kind": "done"})
