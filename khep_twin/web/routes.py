"""Routes of the page: its files, its actions and its messages."""

import asyncio
from dataclasses import asdict
from pathlib import Path
from typing import cast

from starlette.applications import Starlette
from starlette.requests import Request
from starlette.responses import FileResponse, PlainTextResponse, Response
from starlette.routing import Route, WebSocketRoute

from khep_twin import __version__
from khep_twin import playpen as playpens
from khep_twin.board.turrets import installed
from khep_twin.errors import KhepTwinError
from khep_twin.files.toml_files import summary
from khep_twin.lab.experiment.controllers import BUILT_IN
from khep_twin.sensing import colours
from khep_twin.sensing.bars import BARS
from khep_twin.units import BODIES
from khep_twin.web import drafts, requests
from khep_twin.web.answers import Actions, endpoint, failed, on, with_body
from khep_twin.web.broadcaster import Broadcaster
from khep_twin.web.challenges import Challenges
from khep_twin.web.documents import Documents
from khep_twin.web.file_actions import FileActions, Programs, imported
from khep_twin.web.messages import REPORTS, Message
from khep_twin.web.scene import at_start
from khep_twin.web.session import shape
from khep_twin.web.session_actions import SessionActions

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
        self._documents = documents
        self._broadcaster = Broadcaster()

        def publish(message: Message) -> None:
            """Send a message, with files in what it reports named from the folder on."""
            if message["kind"] in REPORTS:
                message = cast(Message, {**message, "text": documents.relative(str(message.get("text")))})
            self._broadcaster.publish(message)

        self._files = FileActions(documents, Programs(documents, writes_programs), publish, file)
        self._session = SessionActions(documents, publish)
        self._challenges = Challenges(documents, publish, lambda: self._broadcaster.is_watched)

    def app(self) -> Starlette:
        """Return the application, to be wrapped in a guard."""
        shown = self._documents.relative
        routes = [
            Route("/", _asset, methods=["GET"]),
            Route("/static/{name}", _asset, methods=["GET"]),
            Route("/import", with_body(imported, shown), methods=["POST"]),
            *(
                Route(f"/do/{name}", endpoint(name, action, shown), methods=["POST"])
                for name, action in self.actions.items()
            ),
            WebSocketRoute("/live", self._broadcaster.serve),
        ]
        return Starlette(routes=routes, exception_handlers={Exception: failed})

    @property
    def actions(self) -> Actions:
        """Actions of the page by name."""
        hello = {"hello": on(requests.Hello, self._hello)}
        return {**hello, **self._files.actions, **self._session.actions, **self._challenges.actions}

    def close(self) -> None:
        """End the session and the scoring."""
        self._session.close()
        self._challenges.close()

    def _hello(self, asked: requests.Hello) -> dict[str, object]:
        """Answer the first request of a page: a document and the designer's data.

        A page that is loaded again names its "file". A new page gets the running playpen, or else the last
        one in use.
        """
        runs = self._session.runs()
        file = self._files.file if runs is None else self._session.runs_in
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
            "colours": {"sensors": colours.OF_SENSORS, "wheels": colours.WHEELS},
            "turrets": {
                name: {"description": kind.description, "parts": at_start(name)}
                for name, kind in installed().items()
            },
            "shapes": {model: shape(model, model) for model in BODIES},
            "runs": runs,
        }


async def _asset(request: Request) -> Response:
    """Return one of the page's own files."""
    name = request.path_params.get("name", "index.html")
    known = await asyncio.to_thread(lambda: {path.name: path for path in ASSETS.iterdir()})
    if name not in known or known[name].suffix not in _KINDS:
        return PlainTextResponse("404: no such file of the page\n", 404)
    return FileResponse(known[name], media_type=_KINDS[known[name].suffix])
