"""Actions about files: playpens, drafts, programs and logs.

Who writes a program and runs it has this user's permissions, so a page for other machines cannot write any.
"""

import threading
from functools import cache
from pathlib import Path

from starlette.requests import Request as HttpRequest
from starlette.responses import FileResponse, Response

from khep_twin import playpen as playpens
from khep_twin.drawing.render import render
from khep_twin.errors import ControllerError, KhepTwinError, PlaypenError, choices
from khep_twin.files.atomic import read_regular, unusable, write_whole
from khep_twin.files.text import decode
from khep_twin.host.discovery import found_ports
from khep_twin.playpen import Playpen, bitmap, bitmap_files
from khep_twin.playpen.starts import at_spots
from khep_twin.web import drafts, requests
from khep_twin.web.answers import Actions, on
from khep_twin.web.documents import PROGRAMS, ConflictError, Documents, OutsideError, version_of
from khep_twin.web.messages import Publish
from khep_twin.web.requests import PROGRAM_LIMIT

TEMPLATE = Path(__file__).parent.parent / "assets" / "controller_template.py"
"""Program that a new file begins with."""

_FILE = "application/octet-stream"
"""What a browser keeps, and does not show."""

_DRAWING = threading.Lock()
"""Held while a map is drawn: matplotlib's styles are those of the process."""


class Programs:
    """Programs of a folder, which pages read and, if `writable`, write."""

    def __init__(self, documents: Documents, writable: bool) -> None:
        self._documents, self._writable = documents, writable
        self._saving = threading.Lock()

    def open(self, name: str) -> dict[str, object]:
        """Return a program's text and version; of a file that does not exist, the template.

        Raises:
            KhepTwinError: The file cannot be used.
        """
        text = self._text(name)
        known = TEMPLATE.read_text(encoding="utf-8") if text is None else text
        return {"text": known, "version": None if text is None else version_of(text)}

    def save(self, name: str, text: str, version: str | None, overwrite: bool) -> str:
        """Write a program that is based on a version of its file, None for a new one; return its new version.

        Raises:
            ConflictError: The file has another version.
            KhepTwinError: It cannot be written, or not from this page.
        """
        if not self._writable:
            raise OutsideError(f"{name}: a page that other machines can open writes no programs")
        path = self._documents.path(name, ".py")
        with self._saving:
            there = self._text(name)
            if there is not None and not overwrite and version_of(there) != version:
                raise ConflictError(f"{name}: was changed by another page or program")
            if reason := unusable(path):
                raise ControllerError(f"{name}: cannot be written: {reason}")
            write_whole(path, text.encode("utf-8"))
        return version_of(text)

    def _text(self, name: str) -> str | None:
        """Return the text of a file; None if there is none."""
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
    """Actions about the files of a folder.

    Args:
        documents: Playpens of the folder.
        programs: Programs of the folder.
        publish: Function that takes messages for the page.
        file: File to open at first.

    Attributes:
        file: File that was worked on last; None for a new playpen.
    """

    def __init__(self, documents: Documents, programs: Programs, publish: Publish, file: str | None) -> None:
        self._documents, self._programs, self._publish, self.file = documents, programs, publish, file

    @property
    def actions(self) -> Actions:
        """Actions by name."""
        documents, programs = self._documents, self._programs
        return {
            "list": on(requests.Request, self._list),
            "open": on(requests.Named, self._open),
            "library": on(requests.Library, lambda asked: documents.library(asked.name)),
            "thumbnail": on(requests.Library, self._thumbnail),
            "left": on(requests.MaybeNamed, lambda asked: {"left": documents.left(asked.file)}),
            "check": on(requests.Drafted, lambda asked: {"problems": drafts.problems_of(asked.draft)}),
            "save": on(requests.Saved, self._save),
            "keep": on(requests.Kept, self._keep),
            "preview": on(requests.Drafted, self._preview),
            "log": on(requests.Named, self._log),
            "report": on(requests.Named, self._report),
            "program": on(requests.Named, lambda asked: programs.open(asked.file)),
            "save-program": on(requests.SavedProgram, self._save_program),
        }

    def _list(self, asked: requests.Request) -> dict[str, object]:
        ports = [{"url": port.url, "what": port.what} for port in found_ports()]
        files, programs = self._documents.names(), self._documents.names(*PROGRAMS)
        return {"files": files, "programs": programs, "library": playpens.names(), "ports": ports}

    def _thumbnail(self, asked: requests.Library) -> Response:
        if asked.name not in playpens.names():
            raise PlaypenError(f"{asked.name}: {choices(asked.name, playpens.names())}")
        with _DRAWING:
            return Response(_drawn(asked.name), media_type="image/png")

    def _open(self, asked: requests.Named) -> dict[str, object]:
        found = self._documents.open(asked.file)
        self.file = asked.file
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
        self.file = name
        self._publish({"kind": "saved", "file": name, "version": version, "by": asked.tab})
        return {"file": name, "version": version, "name": draft.get("name")}

    def _keep(self, asked: requests.Kept) -> None:
        kept = None
        if asked.draft is not None:
            base = {} if asked.base is None else asked.base.model_dump(exclude_none=True)
            kept = {"draft": asked.draft, "version": asked.version, "base": base}
        self._documents.keep(asked.file, kept, asked.tab if asked.page is None else asked.page)
        if kept is not None:
            self.file = asked.file

    def _save_program(self, asked: requests.SavedProgram) -> dict[str, object]:
        return {"version": self._programs.save(asked.file, asked.text, asked.version, asked.overwrite)}

    def _preview(self, asked: requests.Drafted) -> Response:
        """Return a perspective picture of the start of a run with seed 0."""
        playpen = at_spots(drafts.playpen_of(asked.draft), 0)
        return Response(render(playpen, Path("picture.png")), media_type="image/png")

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


def imported(data: bytes, request: HttpRequest) -> dict[str, object]:
    """Return a MAT file or a picture as a new playpen.

    Raises:
        KhepTwinError: It is none, or its scale is not possible.
    """
    name = request.query_params.get("name", "imported")
    try:
        mm_per_pixel = float(request.query_params.get("mm", "1"))
    except ValueError:
        mm_per_pixel = 0.0
    if not 0.001 <= mm_per_pixel <= 1000:
        raise KhepTwinError(f"{mm_per_pixel:g} mm per pixel: expected 0.001 to 1000")
    found = bitmap_files.decode(data)
    solid = found.solid[::-1] if found.scanned else found.solid
    made = bitmap.to_playpen(solid, drafts.name_of(Path(name).stem), mm_per_pixel=mm_per_pixel)
    return {"file": None, "version": None, "draft": drafts.draft_of(made.playpen)}


@cache
def _drawn(name: str) -> bytes:
    from khep_twin.drawing.map import thumbnail  # matplotlib takes long to load

    return thumbnail(Playpen.load(name))
