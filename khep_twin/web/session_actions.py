"""Actions about the twin that runs, or the robot at a port."""

import math
import os
import threading
from collections import deque
from collections.abc import Sequence

from starlette.responses import Response

from khep_twin.errors import PortError, choices
from khep_twin.host.discovery import found_ports
from khep_twin.invocation import command
from khep_twin.lab.experiment.controllers import BUILT_IN
from khep_twin.lab.sensor_test import sensor_files
from khep_twin.lab.sensor_test.sensor_test import SensorRun
from khep_twin.playpen.starts import at_spots
from khep_twin.playpen_to_mjcf import to_spec
from khep_twin.ports.twin import TwinOptions
from khep_twin.web import drafts, jobs, requests, scene
from khep_twin.web.answers import Actions, on
from khep_twin.web.documents import PROGRAMS, Documents
from khep_twin.web.messages import Publish
from khep_twin.web.session import RobotActor, WebSession
from khep_twin.web.twin_session import TwinActor


class SessionActions:
    """Actions about the session of a page, which has one at a time.

    Args:
        documents: Files of the folder.
        publish: Function that takes messages for the page.

    Attributes:
        runs_in: File of the playpen that the last twin was started in; None without a file.
    """

    def __init__(self, documents: Documents, publish: Publish) -> None:
        self._documents, self._publish = documents, publish
        self._actor: WebSession | None = None
        self._changing = threading.Lock()
        self._sensed: deque[SensorRun] = deque(maxlen=1)  # the latest test
        self.runs_in: str | None = None
        self._runs_version: str | None = None

    @property
    def actions(self) -> Actions:
        """Actions by name."""
        return {
            "scene": on(requests.SceneRequest, self._scene),
            "start": on(requests.StartRequest, self._start),
            "connect": on(requests.Connect, self._connect),
            "end": on(requests.Request, self._end),
            "pace": on(requests.Pace, self._pace),
            "step": on(requests.Request, lambda asked: self._twin().step()),
            "put": on(requests.Put, self._put),
            "room": on(requests.Room, self._room),
            "switch": on(requests.SwitchRequest, self._switch),
            "run": on(requests.RunRequest, self._run),
            "sense": on(requests.SenseRequest, self._sense),
            "figure": on(requests.Figure, self._figure),
            "save-sensed": on(requests.Named, self._save_sensed),
            "stop": on(requests.Request, lambda asked: self._running().stop()),
        }

    def close(self) -> None:
        """End the session."""
        if self._actor is not None:
            self._actor.end()

    def runs(self) -> dict[str, object] | None:
        """Return the playpen of the running twin, and its file; None without a twin."""
        actor = self._actor
        if not isinstance(actor, TwinActor) or not actor.alive:
            return None
        draft = drafts.draft_of(actor.playpen)
        return {"file": self.runs_in, "version": self._runs_version, "draft": draft}

    def _scene(self, asked: requests.SceneRequest) -> dict[str, object]:
        if asked.draft is None:
            return self._twin().scene().described()
        return scene.compiled(to_spec(at_spots(drafts.playpen_of(asked.draft), 0))).described()

    def _start(self, asked: requests.StartRequest) -> dict[str, object]:
        """Start a twin; return its log, and the command that views it."""
        playpen = drafts.playpen_of(asked.draft)
        if not playpen.robots:
            raise PortError("there is no robot; expected one in the playpen")
        options = TwinOptions(seed=asked.seed, noise=asked.noise)
        path = self._documents.new_path(asked.log, ".mcap") if asked.log else None
        before = self._actor
        if path is not None and isinstance(before, TwinActor) and before.alive and before.log == path:
            raise PortError(f"{asked.log}: the running twin writes it; expected the name of a new file")
        actor = TwinActor(playpen, options, path, self._publish)
        actor.set_pace(_speed(asked), asked.paused)
        self._replace(actor)
        self.runs_in, self._runs_version = asked.file, asked.version
        if path is None:
            return {"log": None}
        return {"log": asked.log, "view": command("view", os.path.relpath(path))}

    def _connect(self, asked: requests.Connect) -> None:
        url = asked.port
        known = {port.url for port in found_ports()}
        if url not in known and not url.startswith(("/dev/", "socket://", "rfc2217://")):
            wanted = "expected a path in /dev, socket://HOST:PORT or rfc2217://HOST:PORT"
            raise PortError(f"{url[:80]}: {wanted}; {choices(url, sorted(known))}")
        self._replace(RobotActor(url, self._publish))

    def _replace(self, actor: WebSession) -> None:
        # Two simultaneous requests would both end the last one only.
        with self._changing:
            self.close()
            self._actor = actor
            actor.begin()

    def _end(self, asked: requests.Request) -> None:
        with self._changing:
            self.close()
            self._actor = None

    def _pace(self, asked: requests.Pace) -> None:
        self._twin().set_pace(_speed(asked), asked.paused)

    def _run(self, asked: requests.RunRequest) -> None:
        actor, names = self._running(), asked.controllers
        count = len(actor.playpen.robots) if isinstance(actor, TwinActor) else 1
        if len(names) > count or not any(names):
            wanted = f"expected 1 to {count}, one for each robot"
            raise requests.RequestError(f"{len(names)} controllers; {wanted}")
        for name in names:
            if name and name not in BUILT_IN:
                self._documents.path(name.partition(":")[0], *PROGRAMS)
        numbered = enumerate(names)
        actor.start(*(jobs.FileJob(asked, self._documents, n) if name else None for n, name in numbered))

    def _put(self, asked: requests.Put) -> None:
        twin = self._twin()
        robot = _among("robot", asked.robot, twin.playpen.robots)
        twin.put(robot, asked.x_mm, asked.y_mm, asked.heading_deg, asked.tab)

    def _room(self, asked: requests.Room) -> None:
        twin = self._twin()
        robot = _among("robot", asked.robot, twin.playpen.robots)
        twin.room(robot, asked.x_mm, asked.y_mm, asked.tab)

    def _switch(self, asked: requests.SwitchRequest) -> None:
        twin = self._twin()
        twin.switch(_among("lamp", asked.lamp, twin.playpen.lamps), asked.on, asked.tab)

    def _sense(self, asked: requests.SenseRequest) -> None:
        self._running().start(jobs.sensing(asked, self._sensed.append))

    def _figure(self, asked: requests.Figure) -> Response:
        picture = jobs.figure(self._latest(), asked.sensor or None, asked.y_min, asked.grid)
        return Response(picture, media_type="image/png")

    def _save_sensed(self, asked: requests.Named) -> None:
        run = self._latest()
        sensor_files.save(self._documents.new_path(asked.file, ".mat", ".csv", ".mcap"), run)

    def _latest(self) -> SensorRun:
        if not self._sensed:
            raise PortError("no sensor test was driven yet")
        return self._sensed[-1]

    def _running(self) -> WebSession:
        if self._actor is None or not self._actor.alive:
            raise PortError("nothing runs; expected a started twin, or a connection to a robot")
        return self._actor

    def _twin(self) -> TwinActor:
        actor = self._running()
        if not isinstance(actor, TwinActor):
            raise PortError("a robot at a port cannot be paused, hurried or lifted from here")
        return actor


def _among(key: str, index: int, items: Sequence[object]) -> int:
    """Return the index of one of the playpen's items."""
    if index >= len(items):
        raise requests.RequestError(f"{key} = {index}: the twin has {len(items)} of them, counted from 0")
    return index


def _speed(asked: requests.Pace) -> float:
    """Return a twin's speed in simulated seconds per second; a request's 0 is as fast as possible."""
    if asked.speed == 0:
        return math.inf
    if asked.speed < 0.001:
        wanted = "expected a number from 0.001 to 1000, or 0 for the most"
        raise requests.RequestError(f"speed = {asked.speed:g}: {wanted}")
    return asked.speed
