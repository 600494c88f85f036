"""What the page asks for: files of its own, and actions, each by a POST with JSON and an answer in JSON.

What a person has done wrong is answered 400 with its line, a file that has changed meanwhile 409, a name that
leads out of the folder 403.
"""

import asyncio
import threading
from collections.abc import Callable, Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

from starlette.applications import Starlette
from starlette.concurrency import run_in_threadpool
from starlette.requests import Request
from starlette.responses import FileResponse, JSONResponse, Response
from starlette.routing import Route, WebSocketRoute

from khep_twin import __version__, bitmap, bitmap_files
from khep_twin import playpen as playpens
from khep_twin.errors import KhepTwinError, PortError, choices
from khep_twin.host.discovery import found_ports
from khep_twin.lab import sensor_files
from khep_twin.lab.controllers import BUILT_IN
from khep_twin.lab.sensor_test import SensorRun
from khep_twin.perspective import render
from khep_twin.ports.twin import TwinOptions
from khep_twin.randomness import stream
from khep_twin.sensor_bars import BARS
from khep_twin.turrets import installed
from khep_twin.web import drafts, jobs
from khep_twin.web.audience import Audience
from khep_twin.web.documents import ConflictError, Documents, OutsideError
from khep_twin.web.printed import taken_by
from khep_twin.web.stage import Actor, RobotActor, TwinActor, shape
from khep_twin.web.turret_outlines import at_start

ASSETS = Path(__file__).parent.parent / "assets" / "web"

_KINDS = {".html": "text/html", ".js": "text/javascript", ".css": "text/css", ".svg": "image/svg+xml"}


class Page:
    """Everything behind the page.

    Args:
        documents: that it works on.
        file: that is opened at first; None for a new playpen. Later it is what was worked on last.
    """

    def __init__(self, documents: Documents, file: str | None) -> None:
        self._documents, self._file = documents, file
        self._audience = Audience()
        self._actor: Actor | None = None
        self._changing = threading.Lock()
        self._sensed: SensorRun | None = None
        self._runs_in: str | None = None

    def app(self) -> Starlette:
        """The application, to be put behind a guard."""
        actions: dict[str, Callable[[Any], Any]] = {
            "hello": self._hello,
            "list": self._list,
            "open": self._open,
            "library": lambda wanted: self._documents.library(_text(wanted, "name")),
            "left": lambda wanted: {"left": self._documents.left(_file(wanted))},
            "version": lambda wanted: {"version": self._documents.version(_text(wanted, "file"))},
            "check": lambda wanted: {"problems": drafts.problems_of(_draft(wanted))},
            "save": self._save,
            "keep": self._keep,
            "preview": self._preview,
            "start": self._start,
            "connect": self._connect,
            "end": self._end,
            "pace": self._pace,
            "step": lambda wanted: self._twin().step(),
            "put": self._put,
            "room": self._room,
            "switch": self._switch,
            "run": self._run,
            "sense": lambda wanted: self._running().start(jobs.sensing(wanted, self._keep_sensed)),
            "figure": self._figure,
            "save-sensed": self._save_sensed,
            "stop": lambda wanted: self._running().stop(),
        }
        routes = [
            Route("/", _asset, methods=["GET"]),
            Route("/static/{name}", _asset, methods=["GET"]),
            Route("/import", self._import, methods=["POST"]),
            *(Route(f"/do/{name}", _action(act), methods=["POST"]) for name, act in actions.items()),
            WebSocketRoute("/live", self._audience.serve),
        ]
        return Starlette(routes=routes)

    def close(self) -> None:
        """Ends what runs."""
        if self._actor is not None:
            self._actor.end()

    # Files ---------------------------------------------------------------------------------------------

    def _hello(self, wanted: Mapping[str, Any]) -> dict[str, Any]:
        """Answer the first request of a page: a document, and what the page needs to know.

        A page that is loaded again names its "file". A new page gets the playpen that runs, or else the last
        that was worked on.
        """
        runs = self._runs()
        file = _file(wanted) if "file" in wanted else self._file if runs is None else runs["file"]
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
            "library": playpens.names(),
            "controllers": list(BUILT_IN),
            "bars": {name: asdict(bar) for name, bar in BARS.items()},
            "turrets": {
                name: {"description": kind.description, "parts": at_start(name)}
                for name, kind in installed().items()
            },
            "shapes": {model: shape(model, model) for model in ("khepera1", "khepera2")},
            "runs": runs,
        }

    def _runs(self) -> dict[str, Any] | None:
        """Return the playpen that a twin runs in, and the file that it was drawn in; None without a twin."""
        actor = self._actor
        if not isinstance(actor, TwinActor) or not actor.alive:
            return None
        return {"file": self._runs_in, "draft": drafts.draft_of(actor.playpen)}

    def _list(self, wanted: Mapping[str, Any]) -> dict[str, Any]:
        found = [{"url": port.url, "what": port.what} for port in found_ports()]
        return {
            "files": self._documents.names(),
            "programs": self._documents.names(".py"),
            "library": playpens.names(),
            "ports": found,
        }

    def _open(self, wanted: Mapping[str, Any]) -> dict[str, Any]:
        found = self._documents.open(_text(wanted, "file"))
        self._file = found["file"]
        return found

    def _save(self, wanted: Mapping[str, Any]) -> dict[str, Any]:
        name, draft = _text(wanted, "file"), _draft(wanted)
        if wanted.get("rename") is True:
            draft = {**draft, "name": drafts.name_of(Path(name).stem)}
        version = self._documents.save(
            name,
            draft,
            version=wanted.get("version"),
            base=_texts(wanted.get("base")),
            overwrite=wanted.get("overwrite") is True,
            page=_page(wanted),
        )
        self._file = name
        self._audience.tell({"kind": "saved", "file": name, "version": version, "tab": wanted.get("tab")})
        return {"file": name, "version": version, "name": draft.get("name")}

    def _keep(self, wanted: Mapping[str, Any]) -> None:
        name, kept = _file(wanted), None
        if wanted.get("draft") is not None:
            base = _texts(wanted.get("base"))
            kept = {"draft": _draft(wanted), "version": wanted.get("version"), "base": base}
        self._documents.keep(name, kept, _page(wanted))
        if kept is not None:
            self._file = name

    def _preview(self, wanted: Mapping[str, Any]) -> Response:
        """Return a picture in perspective, as a run with seed 0 begins."""
        playpen = playpens.placed(drafts.playpen_of(_draft(wanted)), stream(0, "spots"))
        return Response(render(playpen, Path("picture.png")), media_type="image/png")

    async def _import(self, request: Request) -> Response:
        """A MAT file or a PNG as a new playpen."""
        data = await request.body()
        name = request.query_params.get("name", "imported")
        try:
            scale = float(request.query_params.get("mm", "1"))
        except ValueError:
            scale = 0.0
        return await run_in_threadpool(_answered, lambda: _imported(data, name, scale))

    # What runs -----------------------------------------------------------------------------------------

    def _start(self, wanted: Mapping[str, Any]) -> None:
        playpen = drafts.playpen_of(_draft(wanted))
        if not playpen.robots:
            raise PortError("there is no robot; right is to add one")
        seed = wanted.get("seed", 0)
        if not isinstance(seed, int) or isinstance(seed, bool):
            raise PortError(f"seed = {str(seed)[:40]}: right is a whole number")
        options = TwinOptions(seed=seed, noise=wanted.get("noise") is not False)
        log = wanted.get("log")
        path = None if not log else self._documents.new_path(str(log), ".mcap")
        actor = TwinActor(playpen, options, path, self._audience.tell)
        actor.set_pace(_speed(wanted), wanted.get("paused") is True)
        self._replace(actor)
        self._runs_in = _file(wanted)

    def _connect(self, wanted: Mapping[str, Any]) -> None:
        url = _text(wanted, "port")
        known = {port.url for port in found_ports()}
        if url not in known and not url.startswith(("/dev/", "socket://", "rfc2217://")):
            wish = "right is a path in /dev, socket://HOST:PORT or rfc2217://HOST:PORT"
            raise PortError(f"{url[:80]}: {wish}; {choices(url, sorted(known))}")
        self._replace(RobotActor(url, self._audience.tell))

    def _replace(self, actor: Actor) -> None:
        # Two that come at once would both end the last one only.
        with self._changing:
            self.close()
            self._actor = actor
            actor.begin()

    def _end(self, wanted: Mapping[str, Any]) -> None:
        with self._changing:
            self.close()
            self._actor = None

    def _pace(self, wanted: Mapping[str, Any]) -> None:
        self._twin().set_pace(_speed(wanted), wanted.get("paused") is True)

    def _run(self, wanted: Mapping[str, Any]) -> None:
        actor = self._running()
        with taken_by(actor.take_printed):  # a file may print as it is read
            job = jobs.series(wanted, self._documents)
        actor.start(job)

    def _put(self, wanted: Mapping[str, Any]) -> None:
        place = [_number(wanted, key) for key in ("x_mm", "y_mm", "heading_deg")]
        self._twin().put(_index(wanted, "robot"), *place)

    def _room(self, wanted: Mapping[str, Any]) -> None:
        place = [_number(wanted, key) for key in ("x_mm", "y_mm")]
        self._twin().room(_index(wanted, "robot"), *place)

    def _switch(self, wanted: Mapping[str, Any]) -> None:
        self._twin().switch(_index(wanted, "lamp"), wanted.get("on") is True)

    def _figure(self, wanted: Mapping[str, Any]) -> Response:
        if self._sensed is None:
            raise PortError("no sensor test was driven yet")
        sensor = wanted.get("sensor")
        name = str(sensor) if sensor else None
        low = int(_number(wanted, "y_min")) if wanted.get("y_min") else 0
        picture = jobs.figure(self._sensed, name, low, wanted.get("grid") is True)
        return Response(picture, media_type="image/png")

    def _save_sensed(self, wanted: Mapping[str, Any]) -> None:
        if self._sensed is None:
            raise PortError("no sensor test was driven yet")
        path = self._documents.new_path(_text(wanted, "file"), ".mat", ".csv", ".mcap")
        sensor_files.save(path, self._sensed)

    def _keep_sensed(self, run: SensorRun) -> None:
        self._sensed = run

    def _running(self) -> Actor:
        if self._actor is None or not self._actor.alive:
            raise PortError("nothing runs; right is to start the twin, or to connect to a robot")
        return self._actor

    def _twin(self) -> TwinActor:
        actor = self._running()
        if not isinstance(actor, TwinActor):
            raise PortError("a robot at a port cannot be paused, hurried or lifted from here")
        return actor


def _action(act: Callable[[Any], Any]) -> Callable[[Request], Any]:
    """An endpoint that has JSON and gives JSON."""

    async def endpoint(request: Request) -> Response:
        wanted = drafts.object_of(await request.body())
        if wanted is None:
            return JSONResponse({"error": "no JSON object"}, 400)
        return await run_in_threadpool(_answered, lambda: act(wanted))

    return endpoint


def _answered(act: Callable[[], Any]) -> Response:
    try:
        answer = act()
        return answer if isinstance(answer, Response) else JSONResponse({} if answer is None else answer)
    except OutsideError as error:
        return JSONResponse({"error": error.plain}, 403)
    except ConflictError as error:
        return JSONResponse({"error": error.plain, "conflict": True}, 409)
    except OSError as error:  # such as a name that is too long
        return JSONResponse({"error": error.strerror or str(error)}, 400)
    except KhepTwinError as error:
        return JSONResponse({"error": error.plain}, 400)
    except (RecursionError, ValueError) as error:
        return JSONResponse({"error": str(error)}, 400)


async def _asset(request: Request) -> Response:
    """A file of the page itself."""
    name = request.path_params.get("name", "index.html")
    known = await asyncio.to_thread(lambda: {path.name: path for path in ASSETS.iterdir()})
    if name not in known or known[name].suffix not in _KINDS:
        return Response(status_code=404)
    return FileResponse(known[name], media_type=_KINDS[known[name].suffix])


def _imported(data: bytes, name: str, mm_per_pixel: float) -> dict[str, Any]:
    if not 0.001 <= mm_per_pixel <= 1000:
        raise KhepTwinError(f"{mm_per_pixel:g} mm per pixel: expected 0.001 to 1000")
    found = bitmap_files.decode(data)
    solid = found.solid[::-1] if found.scanned else found.solid
    made = bitmap.to_playpen(solid, drafts.name_of(Path(name).stem), mm_per_pixel=mm_per_pixel)
    return {"file": None, "version": None, "draft": drafts.draft_of(made.playpen)}


def _draft(wanted: Mapping[str, Any]) -> drafts.Draft:
    draft = wanted.get("draft")
    if not isinstance(draft, dict):
        raise KhepTwinError("no draft")
    return draft  # pyright: ignore[reportUnknownVariableType]


def _file(wanted: Mapping[str, Any]) -> str | None:
    """Return the name of the page's file; None for a playpen without a file."""
    return None if wanted.get("file") is None else _text(wanted, "file")


def _page(wanted: Mapping[str, Any]) -> str:
    """Return the identifier of the page whose draft is meant: by default, the one that asks."""
    return str(wanted.get("page", wanted.get("tab", "")))


def _text(wanted: Mapping[str, Any], key: str) -> str:
    value = wanted.get(key)
    if not isinstance(value, str) or not 0 < len(value) <= 1024:
        raise KhepTwinError(f"{key}: right is a text")
    return value


def _texts(value: Any) -> dict[str, str]:
    """An object of texts; empty for anything else."""
    items: Any = value.items() if isinstance(value, dict) else ()  # pyright: ignore[reportUnknownMemberType, reportUnknownVariableType]
    return {str(key): str(each) for key, each in items}


def _index(wanted: Mapping[str, Any], key: str) -> int:
    value = wanted.get(key)
    if not isinstance(value, int) or isinstance(value, bool) or not 0 <= value < 10_000:
        raise KhepTwinError(f"{key}: right is a number from 0 on")
    return value


def _number(wanted: Mapping[str, Any], key: str) -> float:
    value = wanted.get(key)
    if not isinstance(value, int | float) or isinstance(value, bool):
        raise KhepTwinError(f"{key}: right is a number")
    return float(value)


def _speed(wanted: Mapping[str, Any]) -> float:
    """Simulated per real second; 0 for as fast as it goes."""
    speed = _number(wanted, "speed") if "speed" in wanted else 1.0
    if speed == 0:
        return float("inf")
    if not 0.001 <= speed <= 1000:
        raise KhepTwinError(f"speed = {speed:g}: right is a number from 0.001 to 1000, or 0 for the most")
    return speed
