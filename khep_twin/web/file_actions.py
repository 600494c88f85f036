"""Actions about files: playpens, drafts, programs and logs.

A program runs with this user's permissions, so a page for other machines cannot write programs.
"""

import threading
from contextlib import suppress
from functools import cache
from pathlib import Path

from starlette.requests import Request as HttpRequest
from starlette.responses import FileResponse, Response

from khep_twin import playpen as playpens
from khep_twin.drawing.render import render
from khep_twin.errors import ControllerError, KhepTwinError, PlaypenError, PortError, choices
from khep_twin.files.atomic import read_regular, unusable, write_atomic
from khep_twin.files.text import decode
from khep_twin.host.discovery import found_ports
from khep_twin.lab.experiment.controllers import template_of
from khep_twin.playpen import Playpen, bitmap, bitmap_files
from khep_twin.playpen.starts import at_spots
from khep_twin.robots.registry import find_model
from khep_twin.web import drafts, requests
from khep_twin.web.answers import Actions, action
from khep_twin.web.documents import PROGRAM_SUFFIXES, ConflictError, Documents, OutsideError, version_of
from khep_twin.web.messages import Publish
from khep_twin.web.requests import PROGRAM_LIMIT
from khep_twin.web.run_page import RunPage

_DOWNLOAD = "application/octet-stream"
"""Type of a file that a browser saves instead of showing it."""

_DRAWING_LOCK = threading.Lock()
"""Lock of matplotlib, whose styles are global."""


class Programs:
    """Programs of a folder; pages can write them if `writable`."""

    def __init__(self, documents: Documents, writable: bool) -> None:
        self._documents = documents
        self._writable = writable
        self._save_lock = threading.Lock()

    def open(self, name: str, model: str) -> dict[str, object]:
        """Return a program's text and version; the template of a model if the file does not exist.

        Raises:
            KhepTwinError: The file cannot be used.
        """
        text = self._text(name)
        content = template_of(find_model(model)) if text is None else text
        return {"text": content, "version": None if text is None else version_of(text)}

    def save(self, name: str, text: str, version: str | None, overwrite: bool) -> str:
        """Write a program that is based on a version of its file, None for a new one; return its new version.

        Raises:
            ConflictError: The file has another version.
            KhepTwinError: It cannot be written.
        """
        if not self._writable:
            raise OutsideError(f"{name}: a page that other machines can open writes no programs")
        path = self._documents.path(name, ".py")
        with self._save_lock:
            current_text = self._text(name)
            if current_text is not None and not overwrite and version_of(current_text) != version:
                raise ConflictError(f"{name}: was changed by another page or program")
            if reason := unusable(path):
                raise ControllerError(f"{name}: cannot be written: {reason}")
            write_atomic(path, text.encode("utf-8"))
        return version_of(text)

    def _text(self, name: str) -> str | None:
        """Return the text of a file; None if it does not exist."""
        path = self._documents.path(name, ".py")
        if not path.exists():
            return None
        if path.stat().st_size > PROGRAM_LIMIT:
            raise ControllerError(f"{name}: {path.stat().st_size} bytes; expected at most {PROGRAM_LIMIT}")
        try:
            return decode(read_regular(path))
        except ValueError as error:
            raise ControllerError(f"{name}: {error}") from None


class FileActions:
    """Actions about the files of a folder; `file` is the one edited last, None for a new playpen."""

    def __init__(self, documents: Documents, programs: Programs, publish: Publish, file: str | None) -> None:
        self._documents = documents
        self._programs = programs
        self._publish = publish
        self.file = file

    @property
    def actions(self) -> Actions:
        """Actions by name."""
        documents, programs = self._documents, self._programs
        return {
            "list": action(requests.Request, self._list),
            "open": action(requests.FileRequest, self._open),
            "library": action(requests.LibraryRequest, lambda request: documents.library(request.name)),
            "thumbnail": action(requests.LibraryRequest, self._thumbnail),
            "left": action(requests.PlaypenRequest, lambda request: {"left": documents.drafts(request.file)}),
            "check": action(
                requests.DraftRequest, lambda request: {"problems": drafts.problems_of(request.draft)}
            ),
            "save": action(requests.SaveRequest, self._save),
            "keep": action(requests.SaveDraftRequest, self._save_draft),
            "preview": action(requests.DraftRequest, self._preview),
            "log": action(requests.FileRequest, self._log),
            "report": action(requests.FileRequest, self._report),
            "page": action(requests.FileRequest, self._page),
            "program": action(
                requests.ProgramRequest, lambda request: programs.open(request.file, request.model)
            ),
            "save-program": action(requests.SaveProgramRequest, self._save_program),
        }

    def _list(self, request: requests.Request) -> dict[str, object]:
        ports: list[dict[str, str]] = []
        with suppress(PortError):  # without a folder of this user's servers
            ports = [{"url": port.url, "what": port.description} for port in found_ports()]
        files, programs = self._documents.names(), self._documents.names(*PROGRAM_SUFFIXES)
        return {"files": files, "programs": programs, "library": playpens.names(), "ports": ports}

    def _thumbnail(self, request: requests.LibraryRequest) -> Response:
        if request.name not in playpens.names():
            raise PlaypenError(f"{request.name}: {choices(request.name, playpens.names())}")
        with _DRAWING_LOCK:
            return Response(_draw_thumbnail(request.name), media_type="image/png")

    def _open(self, request: requests.FileRequest) -> dict[str, object]:
        document = self._documents.open(request.file)
        self.file = request.file
        return document

    def _save(self, request: requests.SaveRequest) -> dict[str, object]:
        name, draft = request.file, request.draft
        if request.rename:
            draft = {**draft, "name": drafts.name_of(Path(name).stem)}
        base = request.base.model_dump(exclude_none=True)
        version = self._documents.save(
            name, draft, version=request.version, base=base, overwrite=request.overwrite, page=request.tab
        )
        self.file = name
        self._publish({"kind": "saved", "file": name, "version": version, "by": request.tab})
        return {"file": name, "version": version, "name": draft.get("name")}

    def _save_draft(self, request: requests.SaveDraftRequest) -> None:
        content = None
        if request.draft is not None:
            base = {} if request.base is None else request.base.model_dump(exclude_none=True)
            content = {"draft": request.draft, "version": request.version, "base": base}
        page = request.tab if request.page is None else request.page
        self._documents.save_draft(request.file, content, page)
        if content is not None:
            self.file = request.file

    def _save_program(self, request: requests.SaveProgramRequest) -> dict[str, object]:
        save = self._programs.save
        return {"version": save(request.file, request.text, request.version, request.overwrite)}

    def _preview(self, request: requests.DraftRequest) -> Response:
        """Return a perspective picture of the start of a run with seed 0."""
        playpen = at_spots(drafts.playpen_of(request.draft), 0)
        return Response(render(playpen, Path("picture.png")), media_type="image/png")

    def _log(self, request: requests.FileRequest) -> Response:
        return FileResponse(self._documents.log(request.file), media_type=_DOWNLOAD)

    def _page(self, request: requests.FileRequest) -> Response:
        """Return the page that plays a log, as a file."""
        return Response(RunPage([self._documents.log(request.file)]).html, media_type=_DOWNLOAD)

    def _report(self, request: requests.FileRequest) -> Response:
        """Return the report on a log, as a file."""
        from khep_twin.lab.report.pages import html
        from khep_twin.lab.report.report import make_report
        from khep_twin.log.reader import read_series

        recording = read_series(self._documents.log(request.file))
        with _DRAWING_LOCK:
            return Response(html(make_report(recording, request.file)), media_type=_DOWNLOAD)


def import_file(data: bytes, request: HttpRequest) -> dict[str, object]:
    """Return a MAT file or a picture as a new playpen.

    Raises:
        KhepTwinError: The file cannot be decoded, or its scale is out of range.
    """
    name = request.query_params.get("name", "imported")
    try:
        mm_per_pixel = float(request.query_params.get("mm", "1"))
    except ValueError:
        mm_per_pixel = 0.0
    if not 0.001 <= mm_per_pixel <= 1000:
        raise KhepTwinError(f"{mm_per_pixel:g} mm per pixel: expected 0.001 to 1000")
    picture = bitmap_files.decode(data)
    solid = picture.solid[::-1] if picture.is_scan else picture.solid
    converted = bitmap.to_playpen(solid, drafts.name_of(Path(name).stem), mm_per_pixel=mm_per_pixel)
    return {"file": None, "version": None, "draft": drafts.draft_of(converted.playpen)}


@cache
def _draw_thumbnail(name: str) -> bytes:
    from khep_twin.drawing.map import thumbnail  # matplotlib takes long to load

    return thumbnail(Playpen.load(name))
