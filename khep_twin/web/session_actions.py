"""Actions about the running twin, or the robot at a port."""

import math
import os
import threading
from collections import deque
from collections.abc import Sequence
from functools import partial

from starlette.responses import Response

from khep_twin.errors import PortError, choices
from khep_twin.host.discovery import found_ports
from khep_twin.lab.experiment.controllers import BUILT_IN
from khep_twin.lab.sensor_test import sensor_files
from khep_twin.lab.sensor_test.sensor_test import SensorRun
from khep_twin.playpen.starts import at_spots
from khep_twin.playpen_to_mjcf import to_spec
from khep_twin.ports.twin import TwinOptions
from khep_twin.process.invocation import command
from khep_twin.web import drafts, jobs, requests, scene
from khep_twin.web.answers import Actions, action
from khep_twin.web.documents import PROGRAM_SUFFIXES, Documents
from khep_twin.web.messages import Publish
from khep_twin.web.robot_session import RobotActor
from khep_twin.web.session import SessionActor
from khep_twin.web.twin_session import TwinActor


class SessionActions:
    """Actions about the session, one at a time; `twin_file` is the playpen file of the last twin."""

    def __init__(self, documents: Documents, publish: Publish) -> None:
        self._documents = documents
        self._publish = publish
        self._actor: SessionActor | None = None
        self._actor_lock = threading.Lock()
        self._sensor_runs: deque[SensorRun] = deque(maxlen=1)  # the latest test
        self.twin_file: str | None = None
        self._twin_version: str | None = None

    @property
    def actions(self) -> Actions:
        """Actions by name."""
        return {
            "scene": action(requests.SceneRequest, self._scene),
            "start": action(requests.StartRequest, self._start),
            "connect": action(requests.ConnectRequest, self._connect),
            "end": action(requests.Request, self._end),
            "pace": action(requests.PaceRequest, self._pace),
            "step": action(requests.Request, lambda request: self._running_twin().step()),
            "put": action(requests.PutRequest, self._put_robot),
            "room": action(requests.RoomRequest, self._check_room),
            "switch": action(requests.SwitchRequest, self._switch_lamp),
            "run": action(requests.RunRequest, self._run),
            "sense": action(requests.SenseRequest, self._sense),
            "figure": action(requests.FigureRequest, self._figure),
            "save-sensed": action(requests.FileRequest, self._save_sensor_run),
            "stop": action(requests.Request, lambda request: self._running_actor().stop_jobs()),
        }

    def close(self) -> None:
        """End the session."""
        if self._actor is not None:
            self._actor.end()

    def running_twin(self) -> dict[str, object] | None:
        """Return the playpen of the running twin, and its file; None without a twin."""
        actor = self._actor
        if not isinstance(actor, TwinActor) or not actor.is_alive:
            return None
        draft = drafts.draft_of(actor.playpen)
        return {"file": self.twin_file, "version": self._twin_version, "draft": draft}

    def _scene(self, request: requests.SceneRequest) -> dict[str, object]:
        if request.draft is None:
            return self._running_twin().scene().describe()
        return scene.compile_scene(to_spec(at_spots(drafts.playpen_of(request.draft), 0))).describe()

    def _start(self, request: requests.StartRequest) -> dict[str, object]:
        """Start a twin; return its log, and the command that views it."""
        playpen = drafts.playpen_of(request.draft)
        if not playpen.robots:
            raise PortError("there is no robot; expected one in the playpen")
        options = TwinOptions(seed=request.seed, noise=request.noise)
        path = self._documents.new_path(request.log, ".mcap") if request.log else None
        previous = self._actor
        is_written = isinstance(previous, TwinActor) and previous.is_alive and previous.log == path
        if path is not None and is_written:
            raise PortError(f"{request.log}: the running twin writes it; expected the name of a new file")
        actor = TwinActor(playpen, options, path, self._publish)
        actor.set_pace(_read_speed(request), request.paused)
        self._replace_actor(actor)
        self.twin_file = request.file
        self._twin_version = request.version
        if path is None:
            return {"log": None}
        return {"log": request.log, "view": command("view", os.path.relpath(path))}

    def _connect(self, request: requests.ConnectRequest) -> None:
        url = request.port
        urls = {port.url for port in found_ports()}
        if url not in urls and not url.startswith(("/dev/", "socket://", "rfc2217://")):
            expected = "expected a path in /dev, socket://HOST:PORT or rfc2217://HOST:PORT"
            raise PortError(f"{url[:80]}: {expected}; {choices(url, sorted(urls))}")
        self._replace_actor(RobotActor(url, self._publish))

    def _replace_actor(self, actor: SessionActor | None) -> None:
        # Without the lock, two simultaneous requests would both end only the last actor.
        with self._actor_lock:
            self.close()
            self._actor = actor
            if actor is not None:
                actor.begin()

    def _end(self, request: requests.Request) -> None:
        self._replace_actor(None)

    def _pace(self, request: requests.PaceRequest) -> None:
        self._running_twin().set_pace(_read_speed(request), request.paused)

    def _run(self, request: requests.RunRequest) -> None:
        actor, names = self._running_actor(), request.controllers
        count = len(actor.playpen.robots) if isinstance(actor, TwinActor) else 1
        if len(names) > count or not any(names):
            expected = f"expected 1 to {count}, one for each robot"
            raise requests.RequestError(f"{len(names)} controllers; {expected}")
        for name in names:
            if name and name not in BUILT_IN:
                self._documents.path(name.partition(":")[0], *PROGRAM_SUFFIXES)
        file_job = partial(jobs.file_job, request, self._documents)
        actor.start_jobs(*(file_job(index) if name else None for index, name in enumerate(names)))

    def _put_robot(self, request: requests.PutRequest) -> None:
        twin = self._running_twin()
        robot = _check_index("robot", request.robot, twin.playpen.robots)
        twin.put_robot(robot, request.x_mm, request.y_mm, request.heading_deg, request.tab)

    def _check_room(self, request: requests.RoomRequest) -> None:
        twin = self._running_twin()
        robot = _check_index("robot", request.robot, twin.playpen.robots)
        twin.report_room(robot, request.x_mm, request.y_mm, request.tab)

    def _switch_lamp(self, request: requests.SwitchRequest) -> None:
        twin = self._running_twin()
        twin.switch_lamp(_check_index("lamp", request.lamp, twin.playpen.lamps), request.on, request.tab)

    def _sense(self, request: requests.SenseRequest) -> None:
        job = jobs.sensor_job(jobs.sensor_test(request), self._sensor_runs.append, request.text)
        self._running_actor().start_jobs(job)

    def _figure(self, request: requests.FigureRequest) -> Response:
        picture = jobs.figure(self._latest_sensor_run(), request.sensor or None, request.y_min, request.grid)
        return Response(picture, media_type="image/png")

    def _save_sensor_run(self, request: requests.FileRequest) -> None:
        run = self._latest_sensor_run()
        sensor_files.save(self._documents.new_path(request.file, ".mat", ".csv", ".mcap"), run)

    def _latest_sensor_run(self) -> SensorRun:
        if not self._sensor_runs:
            raise PortError("no sensor test was driven yet")
        return self._sensor_runs[-1]

    def _running_actor(self) -> SessionActor:
        if self._actor is None or not self._actor.is_alive:
            raise PortError("nothing runs; expected a started twin, or a connection to a robot")
        return self._actor

    def _running_twin(self) -> TwinActor:
        actor = self._running_actor()
        if not isinstance(actor, TwinActor):
            raise PortError("a robot at a port cannot be paused, hurried or lifted from here")
        return actor


def _check_index(key: str, index: int, items: Sequence[object]) -> int:
    """Return an index of the playpen's items if it is in range."""
    if index >= len(items):
        raise requests.RequestError(f"{key} = {index}: the twin has {len(items)} of them, counted from 0")
    return index


def _read_speed(request: requests.PaceRequest) -> float:
    """Return a twin's speed in simulated seconds per second; a request's 0 is as fast as possible."""
    if request.speed == 0:
        return math.inf
    if request.speed < 0.001:
        expected = "expected a number from 0.001 to 1000, or 0 for the most"
        raise requests.RequestError(f"speed = {request.speed:g}: {expected}")
    return request.speed
