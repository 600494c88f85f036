"""Routes of the page: its files, its actions and its messages."""

import asyncio
from collections import ChainMap
from pathlib import Path
from typing import cast

from starlette.applications import Starlette
from starlette.requests import Request
from starlette.responses import FileResponse, PlainTextResponse, Response
from starlette.routing import Route, WebSocketRoute

from khep_twin import playpen as playpens
from khep_twin.board.turrets import installed_turrets
from khep_twin.errors import KhepTwinError
from khep_twin.files.toml_files import summary
from khep_twin.robots.registry import installed_models
from khep_twin.sensing import colours
from khep_twin.web import drafts, requests
from khep_twin.web.answers import Actions, action, body_endpoint, endpoint, internal_error
from khep_twin.web.broadcaster import Broadcaster
from khep_twin.web.challenges import Challenges
from khep_twin.web.documents import Documents
from khep_twin.web.file_actions import FileActions, Programs, import_file
from khep_twin.web.messages import REPORTS, Message
from khep_twin.web.robot_shape import robot_shape
from khep_twin.web.scene import start_parts
from khep_twin.web.session_actions import SessionActions

ASSETS = Path(__file__).parent.parent / "assets" / "web"

_KINDS = {".html": "text/html", ".js": "text/javascript", ".css": "text/css", ".svg": "image/svg+xml"}


class Page:
    """Application behind the page.

    Args:
        documents: Playpens of the folder.
        file: File to open first; None for a new playpen.
        writes_programs: True if controllers can be edited in the page.
    """

    def __init__(self, documents: Documents, file: str | None, *, writes_programs: bool = True) -> None:
        self._documents = documents
        self._broadcaster = Broadcaster()

        def publish(message: Message) -> None:
            """Send a message; file names in reports become relative to the folder."""
            if message["kind"] in REPORTS:
                message = cast(Message, {**message, "text": documents.relative(str(message.get("text")))})
            self._broadcaster.publish(message)

        self._files = FileActions(documents, Programs(documents, writes_programs), publish, file)
        self._session = SessionActions(documents, publish)
        self._challenges = Challenges(documents, publish, lambda: self._broadcaster.has_pages)

    def app(self) -> Starlette:
        """Return the application, which a guard must wrap."""
        format_text = self._documents.relative
        routes = [
            Route("/", _asset, methods=["GET"]),
            Route("/static/{name}", _asset, methods=["GET"]),
            Route("/import", body_endpoint(import_file, format_text), methods=["POST"]),
            *(
                Route(f"/do/{name}", endpoint(name, action, format_text), methods=["POST"])
                for name, action in self.actions.items()
            ),
            WebSocketRoute("/live", self._broadcaster.serve),
        ]
        return Starlette(routes=routes, exception_handlers={Exception: internal_error})

    @property
    def actions(self) -> Actions:
        """Actions of the page by name."""
        hello = {"hello": action(requests.HelloRequest, self._hello)}
        return {**hello, **self._files.actions, **self._session.actions, **self._challenges.actions}

    def close(self) -> None:
        """End the session and the scoring."""
        self._session.close()
        self._challenges.close()

    def _hello(self, request: requests.HelloRequest) -> dict[str, object]:
        """Answer the first request of a page: a document and the designer's data.

        A reloaded page names its "file". A new page gets the running playpen, or if none runs the last one in
        use.
        """
        running_twin = self._session.running_twin()
        file = self._files.file if running_twin is None else self._session.twin_file
        if "file" in request.model_fields_set:
            file = request.file
        error_text = None
        try:
            exists = file is not None and self._documents.version(file) is not None
            document = self._documents.open(file) if file and exists else self._documents.new(file)
        except KhepTwinError as error:
            document = self._documents.new(None)
            error_text = error.plain
        models = installed_models()
        sensors = ChainMap(*(colours.sensor_colours(model.body) for model in models.values()))
        return {
            **document,
            "trouble": error_text,
            "surfaces": drafts.surfaces(),
            "library": {name: summary("playpens", name) for name in playpens.names()},
            "colours": {"sensors": dict(sensors), "wheels": colours.WHEELS},
            "turrets": {
                name: {"description": kind.description, "parts": start_parts(name)}
                for name, kind in installed_turrets().items()
            },
            "models": drafts.models(),
            "choices": drafts.key_choices(),
            "shapes": {name: robot_shape(model, model.calibration) for name, model in models.items()},
            "runs": running_twin,
        }


async def _asset(request: Request) -> Response:
    """Return a file of the page itself."""
    name = request.path_params.get("name", "index.html")
    assets = await asyncio.to_thread(lambda: {path.name: path for path in ASSETS.iterdir()})
    if name not in assets or assets[name].suffix not in _KINDS:
        return PlainTextResponse("404: no such file of the page\n", 404)
    return FileResponse(assets[name], media_type=_KINDS[assets[name].suffix])
