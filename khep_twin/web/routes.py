"""Routes of the page: its files, and its actions, each a POST with JSON and an answer in JSON.

A user's error is answered 400 with its line, a file that has changed meanwhile 409, a path outside the
folder 403.
"""

import asyncio
import math
import os
import threading
from collections import deque
from collections.abc import Awaitable, Callable, Mapping, Sequence
from dataclasses import asdict
from functools import cache
from pathlib import Path

from starlette.applications import Starlette
from starlette.concurrency import run_in_threadpool
from starlette.requests import Request
from starlette.responses import FileResponse, JSONResponse, PlainTextResponse, Response
from starlette.routing import Route, WebSocketRoute

from khep_twin import __version__
from khep_twin import playpen as playpens
from khep_twin.board.turrets import installed
from khep_twin.drawing.render import render
from khep_twin.errors import KhepTwinError, PlaypenError, PortError, choices
from khep_twin.files.toml_files import summary
from khep_twin.host.discovery import found_ports
from khep_twin.invocation import command
from khep_twin.lab.experiment.controllers import BUILT_IN
from khep_twin.lab.sensor_test import sensor_files
from khep_twin.lab.sensor_test.sensor_test import SensorRun
from khep_twin.playpen import Playpen, bitmap, bitmap_files
from khep_twin.playpen.starts import at_spots
from khep_twin.playpen_to_mjcf import to_spec
from khep_twin.ports.twin import TwinOptions
from khep_twin.sensing import colours
from khep_twin.sensing.bars import BARS
from khep_twin.web import drafts, jobs, requests, scene
from khep_twin.web.broadcaster import Broadcaster
from khep_twin.web.challenges import Challenges
from khep_twin.web.documents import ConflictError, Documents, OutsideError
from khep_twin.web.printed import taken_by
from khep_twin.web.programs import Programs
from khep_twin.web.session import RobotActor, TwinActor, WebSession, shape
from khep_twin.web.turret_outlines import at_start

_FILE = "application/octet-stream"
"""What a browser keeps, and does not show."""

ASSETS = Path(__file__).parent.parent / "assets" / "web"

_KINDS = {".html": "text/html", ".js": "text/javascript", ".css": "text/css", ".svg": "image/svg+xml"}


class Page:
    """Application behind the page, which opens a file at first, or with None a new playpen.

    Args:
        documents: Playpens of the folder.
        file: File to open.
        writes_programs: True if controllers can be edited in the page.
    """

    def __init__(self, documents: Documents, file: str | None, *, writes_programs: bool = True) -> None:
        self._programs = Programs(documents, writes_programs)
        self._documents, self._file = documents, file  # later the one that was worked on last
        self._broadcaster = Broadcaster()
        publish, watched = self._broadcaster.publish, lambda: self._broadcaster.is_watched
        self._challenges = Challenges(documents, publish, watched)
        self._actor: WebSession | None = None
        self._changing = threading.Lock()
        self._sensed: deque[SensorRun] = deque(maxlen=1)  # the latest test
        self._runs_in: str | None = None
        self._runs_version: str | None = None
        self._reading = threading.Lock()

    def app(self) -> Starlette:
        """Return the application, to be wrapped in a guard."""
        routes = [
            Route("/", _asset, methods=["GET"]),
            Route("/static/{name}", _asset, methods=["GET"]),
            Route("/import", self._import, methods=["POST"]),
            *(
                Route(f"/do/{name}", _endpoint(name, action), methods=["POST"])
                for name, (_, action) in self.actions.items()
            ),
            WebSocketRoute("/live", self._broadcaster.serve),
        ]
        return Starlette(routes=routes, exception_handlers={Exception: _failed})

    @property
    def actions(self) -> Mapping[str, "_Action"]:
        """Actions of the page by name: the request's class and the function."""
        documents = self._documents
        return {
            "hello": _on(requests.Hello, self._hello),
            "list": _on(requests.Request, self._list),
            "open": _on(requests.Named, self._open),
            "library": _on(requests.Library, lambda asked: documents.library(asked.name)),
            "thumbnail": _on(requests.Library, self._thumbnail),
            "left": _on(requests.MaybeNamed, lambda asked: {"left": documents.left(asked.file)}),
            "version": _on(requests.Named, lambda asked: {"version": documents.version(asked.file)}),
            "check": _on(requests.Drafted, lambda asked: {"problems": drafts.problems_of(asked.draft)}),
            "save": _on(requests.Saved, self._save),
            "keep": _on(requests.Kept, self._keep),
            "preview": _on(requests.Drafted, self._preview),
            "scene": _on(requests.SceneRequest, self._scene),
            "start": _on(requests.StartRequest, self._start),
            "log": _on(requests.Named, self._log),
            "report": _on(requests.Named, self._report),
            "connect": _on(requests.Connect, self._connect),
            "end": _on(requests.Request, self._end),
            "program": _on(requests.Named, lambda asked: self._programs.open(asked.file)),
            "save-program": _on(requests.SavedProgram, self._save_program),
            "pace": _on(requests.Pace, self._pace),
            "step": _on(requests.Request, lambda asked: self._twin().step()),
            "put": _on(requests.Put, self._put),
            "room": _on(requests.Room, self._room),
            "switch": _on(requests.SwitchRequest, self._switch),
            "run": _on(requests.RunRequest, self._run),
            "sense": _on(requests.SenseRequest, self._sense),
            "figure": _on(requests.Figure, self._figure),
            "save-sensed": _on(requests.Named, self._save_sensed),
            "stop": _on(requests.Request, lambda asked: self._running().stop()),
            **{name: _on(*action) for name, action in self._challenges.actions.items()},
        }

    def close(self) -> None:
        """End the session and the scoring."""
        self._end_session()
        self._challenges.close()

    # Files ---------------------------------------------------------------------------------------------

    def _hello(self, asked: requests.Hello) -> dict[str, object]:
        """Answer the first request of a page: a document and the designer's data.

        A page that is loaded again names its "file". A new page gets the running playpen, or else the last
        one in use.
        """
        runs = self._runs()
        file = self._file if runs is None else self._runs_in
        if "file" in asked.model_fields_set:
            file = asked.file
        trouble = None
        try:
            there = file is not None and self._documents.version(file) is not None
            opened = self._documents.open(file) if file and there else self._documents.new(file)
        except KhepTwinError as error:
            opened, trouble = self._documents.new(None), error.plain
        return {
            **opened,
            "trouble": trouble,
            "folder": self._documents.root.name,
            "version_of_twin": __version__,
            "surfaces": drafts.surfaces(),
            "library": {name: summary("playpens", name) for name in playpens.names()},
            "controllers": list(BUILT_IN),
            "bars": {name: asdict(bar) for name, bar in BARS.items()},
            "colours": {"sensors": colours.SENSORS, "wheels": colours.WHEELS},
            "turrets": {
                name: {"description": kind.description, "parts": at_start(name)}
                for name, kind in installed().items()
            },
            "shapes": {model: shape(model, model) for model in ("khepera1", "khepera2")},
            "runs": runs,
        }

    def _runs(self) -> dict[str, object] | None:
        """Return the playpen of the running twin, and its file; None without a twin."""
        actor = self._actor
        if not isinstance(actor, TwinActor) or not actor.alive:
            return None
        draft = drafts.draft_of(actor.playpen)
        return {"file": self._runs_in, "version": self._runs_version, "draft": draft}

    def _list(self, asked: requests.Request) -> dict[str, object]:
        ports = [{"url": port.url, "what": port.what} for port in found_ports()]
        files, programs = self._documents.names(), self._documents.names(".py")
        return {"files": files, "programs": programs, "library": playpens.names(), "ports": ports}

    def _thumbnail(self, asked: requests.Library) -> Response:
        if asked.name not in playpens.names():
            raise PlaypenError(f"{asked.name}: {choices(asked.name, playpens.names())}")
        with _DRAWING:
            return Response(_drawn(asked.name), media_type="image/png")

    def _open(self, asked: requests.Named) -> dict[str, object]:
        found = self._documents.open(asked.file)
        self._file = asked.file
        return found

    def _save(self, asked: requests.Saved) -> dict[str, object]:
        name, draft = asked.file, asked.draft
        if asked.rename:
            draft = {**draft, "name": drafts.name_of(Path(name).stem)}
        version = self._documents.save(
            name,
            draft,
            version=asked.version,
            base=asked.base.model_dump(exclude_none=True),
            overwrite=asked.overwrite,
            page=asked.tab,
        )
        self._file = name
        self._broadcaster.publish({"kind": "saved", "file": name, "version": version, "tab": asked.tab})
        return {"file": name, "version": version, "name": draft.get("name")}

    def _keep(self, asked: requests.Kept) -> None:
        kept = None
        if asked.draft is not None:
            base = {} if asked.base is None else asked.base.model_dump(exclude_none=True)
            kept = {"draft": asked.draft, "version": asked.version, "base": base}
        self._documents.keep(asked.file, kept, asked.tab if asked.page is None else asked.page)
        if kept is not None:
            self._file = asked.file

    def _save_program(self, asked: requests.SavedProgram) -> dict[str, object]:
        return {"version": self._programs.save(asked.file, asked.text, asked.version, asked.overwrite)}

    def _preview(self, asked: requests.Drafted) -> Response:
        """Return a perspective picture of the start of a run with seed 0."""
        playpen = at_spots(drafts.playpen_of(asked.draft), 0)
        return Response(render(playpen, Path("picture.png")), media_type="image/png")

    def _scene(self, asked: requests.SceneRequest) -> dict[str, object]:
        if asked.draft is None:
            return self._twin().scene().described()
        return scene.compiled(to_spec(at_spots(drafts.playpen_of(asked.draft), 0))).described()

    async def _import(self, request: Request) -> Response:
        """Return a MAT file or a PNG as a new playpen."""
        data = await request.body()
        name = request.query_params.get("name", "imported")
        try:
            scale = float(request.query_params.get("mm", "1"))
        except ValueError:
            scale = 0.0
        return await run_in_threadpool(_answered, lambda: _imported(data, name, scale))

    # Session -------------------------------------------------------------------------------------------

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
        actor = TwinActor(playpen, options, path, self._broadcaster.publish)
        actor.set_pace(_speed(asked), asked.paused)
        self._replace(actor)
        self._runs_in, self._runs_version = asked.file, asked.version
        if path is None:
            return {"log": None}
        return {"log": asked.log, "view": command("view", os.path.relpath(path))}

    def _log(self, asked: requests.Named) -> Response:
        return FileResponse(self._documents.log(asked.file), media_type=_FILE)

    def _report(self, asked: requests.Named) -> Response:
        """Return the report on a log, as a file."""
        from khep_twin.lab.report.pages import html
        from khep_twin.lab.report.report import report
        from khep_twin.log.reader import read_series

        recording = read_series(self._documents.log(asked.file))
        with _DRAWING:
            return Response(html(report(recording, asked.file)), media_type=_FILE)

    def _connect(self, asked: requests.Connect) -> None:
        url = asked.port
        known = {port.url for port in found_ports()}
        if url not in known and not url.startswith(("/dev/", "socket://", "rfc2217://")):
            wanted = "expected a path in /dev, socket://HOST:PORT or rfc2217://HOST:PORT"
            raise PortError(f"{url[:80]}: {wanted}; {choices(url, sorted(known))}")
        self._replace(RobotActor(url, self._broadcaster.publish))

    def _replace(self, actor: WebSession) -> None:
        # Two simultaneous requests would both end the last one only.
        with self._changing:
            self._end_session()
            self._actor = actor
            actor.begin()

    def _end(self, asked: requests.Request) -> None:
        with self._changing:
            self._end_session()
            self._actor = None

    def _end_session(self) -> None:
        if self._actor is not None:
            self._actor.end()

    def _pace(self, asked: requests.Pace) -> None:
        self._twin().set_pace(_speed(asked), asked.paused)

    def _run(self, asked: requests.RunRequest) -> None:
        actor = self._running()
        # A file that never ends when it is imported must not take one thread of the server after another.
        if not self._reading.acquire(blocking=False):
            wanted = "expected to wait for it, or programs that end when they are imported"
            raise PortError(f"a program is still being read; {wanted}")
        try:
            with taken_by(actor.take_printed):  # a file may print when it is imported
                job = jobs.series(asked, self._documents)
        finally:
            self._reading.release()
        actor.start(job)

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


_DRAWING = threading.Lock()
"""Held while a map is drawn: matplotlib's styles are those of the process."""


@cache
def _drawn(name: str) -> bytes:
    from khep_twin.drawing.map import thumbnail  # matplotlib takes long to load

    return thumbnail(Playpen.load(name))


_Action = tuple[type[requests.Request], Callable[[bytes, str], object]]
"""A request's class, and the function of its JSON and the action's name."""


def _on(kind: type[requests.Asked], action: Callable[[requests.Asked], object]) -> _Action:
    return kind, lambda body, name: action(requests.request_of(body, kind, name))


def _endpoint(name: str, action: Callable[[bytes, str], object]) -> Callable[[Request], Awaitable[Response]]:
    """Return an endpoint that takes and returns JSON."""

    async def endpoint(request: Request) -> Response:
        body = await request.body()
        return await run_in_threadpool(_answered, lambda: action(body, name))

    return endpoint


async def _failed(request: Request, error: Exception) -> Response:
    """Answer a request after an internal error, which is printed on standard error."""
    return _refused(f"the designer failed: {type(error).__name__}: {error}", 500)


def _answered(action: Callable[[], object]) -> Response:
    try:
        answer = action()
        return answer if isinstance(answer, Response) else JSONResponse({} if answer is None else answer)
    except OutsideError as error:
        return _refused(error.plain, 403)
    except ConflictError as error:
        return _refused(error.plain, 409, conflict=True)
    except OSError as error:  # such as a name that is too long
        return _refused(error.strerror or str(error))
    except KhepTwinError as error:
        return _refused(error.plain)


def _refused(text: str, status: int = 400, **more: bool) -> Response:
    """Return an answer with the problems, a line each."""
    lines = (line if line.isprintable() else ascii(line)[1:-1] for line in text.split("\n"))
    return JSONResponse({"error": "\n".join(lines), **more}, status)


async def _asset(request: Request) -> Response:
    """Return one of the page's own files."""
    name = request.path_params.get("name", "index.html")
    known = await asyncio.to_thread(lambda: {path.name: path for path in ASSETS.iterdir()})
    if name not in known or known[name].suffix not in _KINDS:
        return PlainTextResponse("404: no such file of the page\n", 404)
    return FileResponse(known[name], media_type=_KINDS[known[name].suffix])


def _imported(data: bytes, name: str, mm_per_pixel: float) -> dict[str, object]:
    if not 0.001 <= mm_per_pixel <= 1000:
        raise KhepTwinError(f"{mm_per_pixel:g} mm per pixel: expected 0.001 to 1000")
    found = bitmap_files.decode(data)
    solid = found.solid[::-1] if found.scanned else found.solid
    made = bitmap.to_playpen(solid, drafts.name_of(Path(name).stem), mm_per_pixel=mm_per_pixel)
    return {"file": None, "version": None, "draft": drafts.draft_of(made.playpen)}


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
