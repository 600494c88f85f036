"""Sessions of the page: a twin in its playpen or a robot at a port, in a thread.

One thread owns the whole world of a twin; no other may touch it. The page's requests are passed to it, and
its pictures are passed to the page, at most 25 times a second.
"""

import io
import math
import os
import sys
import threading
from collections.abc import Callable, Generator
from contextlib import contextmanager, suppress
from contextvars import ContextVar
from ctypes import c_ulong, py_object, pythonapi
from dataclasses import asdict
from typing import Literal, TextIO

from khep_twin.errors import KhepTwinError, PortError, ProtocolError
from khep_twin.host import Khepera, Vision, commands
from khep_twin.khepera4.ultrasonic import HEADINGS_DEG, RADIUS
from khep_twin.machine import n_forks
from khep_twin.sensing import calibration
from khep_twin.sensing.bars import bars_of
from khep_twin.units import BODIES
from khep_twin.web import messages
from khep_twin.web.jobs import Job
from khep_twin.web.messages import Message, Publish, RobotShape

_ENDING_S = 5.0
"""Longest time for a session to end: its controller has a second for its cycle [s]."""

_HANGS = "the program does not end; it is left to itself, and its session is over: Run begins another"

_PRINT_LIMIT = 20_000
"""Longest text that is sent at once [characters]."""

_CAPTURE: ContextVar[Callable[[str], object] | None] = ContextVar("_CAPTURE", default=None)

_LOOK = 0.08
"""Interval at which the readings of a robot at a port are requested [s]."""


class PrintBuffer:
    """Text that a program prints, sent to the page at intervals; of long text, the end."""

    def __init__(self, publish: Publish, kind: Literal["printed", "score-printed"]) -> None:
        self._publish, self._text = publish, ""
        self._kind: Literal["printed", "score-printed"] = kind

    def add(self, text: str) -> None:
        """Add a piece of it."""
        self._text = (self._text + text)[-_PRINT_LIMIT:]

    def tell(self) -> None:
        """Send what has been added."""
        text, self._text = self._text, ""
        if text:
            self._publish({"kind": self._kind, "text": text})


class WebSession:
    """Common part of twin and robot sessions: a thread with one job at a time for each robot.

    The thread calls `publish` with messages for the page. `jobs` are the current jobs, with None for a robot
    that stands; empty without any.
    """

    def __init__(self, publish: Publish) -> None:
        self._publish = publish
        self._left, self._leaving = False, threading.Lock()
        self.jobs: tuple[Job | None, ...] = ()
        self._stopped: tuple[Job | None, ...] = ()
        self._at_work: set[int] = set()
        # The completed part of the jobs goes with the pictures, as jobs report it at each cycle.
        self._part = 0.0
        self.printed = PrintBuffer(self.publish, "printed")
        self._n_forks = n_forks()
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._run, name="stage", daemon=True)

    def begin(self) -> None:
        """Start the thread."""
        self._thread.start()

    @property
    def alive(self) -> bool:
        """True if its thread is still running, and was not abandoned."""
        return not self._left and self._thread.is_alive()

    def start(self, *jobs: Job | None) -> None:
        """Start jobs, the first one for the first robot; None lets a robot stand.

        Raises:
            PortError: The session has jobs already, or has ended.
        """
        if self.jobs or not self.alive:
            raise PortError("the robot is busy; expected a stopped robot" if self.alive else "it has ended")
        self._part = 0.0
        self.jobs = jobs

    def stop(self) -> None:
        """End the jobs and stop the motors; abandon a thread whose jobs do not end in time."""
        if (jobs := self.jobs) and jobs is not self._stopped:
            self._stopped = jobs
            timer = threading.Timer(_ENDING_S, lambda: self.jobs is jobs and self._leave())
            timer.daemon = True
            timer.start()
        self._halt_motors()

    def end(self) -> None:
        """End the session; abandon a thread that does not end in time."""
        self._ended.set()
        if not self._left:
            self._thread.join(_ENDING_S)
        if self._thread.is_alive():
            self._leave()

    def _leave(self) -> None:
        """Abandon the thread: drop its messages, and interrupt its programs if they execute Python."""
        with self._leaving:
            if self._left:
                return
            self._left = True
            self._ended.set()
            for thread in list(self._at_work):
                pythonapi.PyThreadState_SetAsyncExc(c_ulong(thread), py_object(SystemExit))
            self._publish({"kind": "error", "text": _HANGS})
            self._publish({"kind": "ended"})

    def publish(self, message: Message) -> None:
        """Send a message to the page, unless this session was abandoned."""
        if not self._left:
            self._publish(message)

    def _run(self) -> None:
        try:
            self._live()
        except KhepTwinError as error:
            self.publish({"kind": "error", "text": error.plain})
        except BaseException as error:  # reported in the page, then raised as usual
            self.publish({"kind": "error", "text": f"{type(error).__name__}: {error}"})
            raise
        finally:
            self.jobs = ()
            self.publish({"kind": "ended"})

    def _halt_motors(self) -> None:
        """Have the jobs end and the motors stop."""
        raise NotImplementedError

    def _live(self) -> None:
        raise NotImplementedError

    def _progress(self, part: float) -> None:
        self._leave_a_fork()
        self._part = round(part, 4)

    def _leave_a_fork(self) -> None:
        """End a process that a controller has forked: the session is the designer's alone."""
        if n_forks() != self._n_forks:
            os._exit(0)

    def _do(self, job: Job, robot: Khepera, stop: Callable[[], bool]) -> None:
        """Do a job; report its errors and continue."""
        self._at_work.add(threading.get_ident())
        try:
            with captured_by(self.printed.add):
                job.do(robot, self.publish, self._progress, stop)
        except KhepTwinError as error:
            if not stop():
                self.publish({"kind": "error", "text": error.plain})
        finally:
            self._at_work.discard(threading.get_ident())
            self._leave_a_fork()

    def _done(self) -> None:
        """Report the end of the jobs."""
        self.jobs = ()
        self.printed.tell()
        self.publish({"kind": "done"})


def shape(model: str, sensors: str) -> RobotShape:
    """Return a robot's shape for drawing: [mm] and [deg]."""
    body = BODIES[model]
    poses = zip(body.sensor_positions, calibration.read(sensors)[0].heading_deg, strict=True)
    heard = () if body.in_core else HEADINGS_DEG
    rim_mm = 1e3 * RADIUS
    ends = ((math.cos(math.radians(turn)), math.sin(math.radians(turn)), turn) for turn in heard)
    return {
        "radius_mm": body.radius * 1e3,
        "sensors": [[round(x * 1e3, 2), round(y * 1e3, 2), heading] for (x, y), heading in poses],
        "names": body.sensors,
        "n_ground": len(body.ground_positions),
        "wheels_mm": [
            round(1e3 * each, 3) for each in (body.wheel_base, body.wheel_radius, body.wheel_width)
        ],
        "sonar": [[round(rim_mm * x, 2), round(rim_mm * y, 2), turn] for x, y, turn in ends],
        "bars": {name: asdict(bar) for name, bar in bars_of(body).items()},
    }


class _Split(io.TextIOBase):
    """Text stream that is split by thread: to a function that takes text, or to the original stream."""

    def __init__(self, before: TextIO) -> None:
        self._before = before

    def write(self, text: str, /) -> int:
        take = _CAPTURE.get()
        if take is None:
            return self._before.write(text)
        take(text)
        return len(text)

    def flush(self) -> None:
        self._before.flush()

    def __getattr__(self, name: str) -> object:
        return getattr(self._before, name)  # such as its buffer of bytes


@contextmanager
def captured_by(take: Callable[[str], object]) -> Generator[None]:
    """Pass the output of this thread to a function; other threads print as before."""
    if not isinstance(sys.stdout, _Split):
        sys.stdout = _Split(sys.stdout)
    token = _CAPTURE.set(take)
    try:
        yield
    finally:
        _CAPTURE.reset(token)


class RobotActor(WebSession):
    """Robot, or twin that is served elsewhere, at a port; its readings are polled."""

    def __init__(self, url: str, publish: Publish) -> None:
        super().__init__(publish)
        self._url = url
        self._halt = threading.Event()
        self._robot: Khepera | None = None
        self._vision: Vision | None = None
        self._began = self._looked = 0.0

    def _halt_motors(self) -> None:
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
                for job in self.jobs[:1]:
                    try:
                        if job is not None:
                            self._do(job, robot, self._stopping)
                    finally:
                        self._done()
                self._halt.wait(_LOOK)

    def _stopping(self) -> bool:
        return self._halt.is_set() or self._ended.is_set()

    def _progress(self, part: float) -> None:
        super()._progress(part)
        if self._robot is not None and self._robot.time - self._looked > 2 * _LOOK:
            self._look(self._robot)

    def _look(self, robot: Khepera) -> None:
        self.printed.tell()
        proximity, ambient, speed = robot.burst(commands.proximity(), commands.ambient(), commands.speed())
        self._looked = robot.time
        reading: messages.RobotReadings = {
            "proximity": [*proximity],
            "ambient": [*ambient],
            "speed": [*speed],
            "leds": [0, 0],
        }
        if self._vision is not None and not self.jobs:  # a program's turns are not to wait for an image
            reading["vision"] = [*self._vision.image()]
        time_s, busy = robot.time - self._began, bool(self.jobs)
        self.publish(
            {"kind": "picture", "time": time_s, "busy": busy, "part": self._part, "robots": [reading]}
        )
