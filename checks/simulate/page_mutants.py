"""Broken builds of the page."""

from collections.abc import Mapping
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path
from typing import Any
from unittest.mock import patch

from checks.simulate.mutants import Mutant
from khep_twin.errors import KhepTwinError
from khep_twin.web import answers, documents, session
from khep_twin.web.documents import Documents
from khep_twin.web.session_actions import SessionActions

_save, _keep, _left = Documents.save, Documents.keep, Documents.left


def _overwrites() -> AbstractContextManager[object]:
    def save(self: Documents, *args: Any, **options: Any) -> str:
        return _save(self, *args, **{**options, "overwrite": True})

    return patch.object(Documents, "save", save)


def _unlocked() -> AbstractContextManager[object]:
    begun = Documents.__init__

    def begin(self: Documents, root: Path) -> None:
        begun(self, root)
        self._saving = nullcontext()  # type: ignore[assignment]

    return patch.object(Documents, "__init__", begin)


def _draft_first() -> AbstractContextManager[object]:
    def save(self: Documents, name: str, *args: Any, page: str = "", **options: Any) -> str:
        self.keep(name, None, page)
        return _save(self, name, *args, page=page, **options)

    return patch.object(Documents, "save", save)


def _kept_later() -> AbstractContextManager[object]:
    def keep(self: Documents, *args: Any) -> None:
        session.threading.Thread(target=lambda: _keep(self, *args), name="keep").start()

    return patch.object(Documents, "keep", keep)


def _in_place() -> AbstractContextManager[object]:
    whole = documents.write_whole

    def write(path: Path, data: bytes) -> None:
        if path.suffix != ".draft":
            whole(path, data)
            return
        try:
            with path.open("wb") as file:
                file.write(data)
        except OSError as error:
            raise KhepTwinError(f"{path}: cannot be written: {error.strerror}") from error

    return patch.object(documents, "write_whole", write)


def _left_part() -> AbstractContextManager[object]:
    def write(path: Path, data: bytes) -> None:
        part = path.with_name(f".{path.name}.part")
        try:
            with part.open("wb") as file:
                file.write(data)
            documents.os.replace(part, path)
        except OSError as error:
            raise KhepTwinError(f"{path}: cannot be written: {error.strerror}") from error

    return patch.object(documents, "write_whole", write)


def _unended() -> AbstractContextManager[object]:
    def end(self: SessionActions, asked: object) -> None:
        self._actor = None

    return patch.object(SessionActions, "_end", end)


def _failing() -> AbstractContextManager[object]:
    def answered(action: Any) -> Any:
        found = action()
        return found if isinstance(found, answers.Response) else answers.JSONResponse(found or {})

    return patch.object(answers, "answered", answered)


def _oldest_first() -> AbstractContextManager[object]:
    def left(self: Documents, name: str | None) -> list[dict[str, object]]:
        return _left(self, name)[::-1]

    return patch.object(Documents, "left", left)


def _mute() -> AbstractContextManager[object]:
    def refused(text: str, status: int = 400, **more: bool) -> Any:
        content: Mapping[str, object] = {"error": "", **more}
        return answers.JSONResponse(content, status)

    return patch.object(answers, "refused", refused)


MUTANTS: dict[str, Mutant] = {
    "page-overwrites-a-changed-file": Mutant("page", "work", _overwrites),
    "page-two-saves-at-once": Mutant("page", "work", _unlocked),
    "page-draft-deleted-before-the-file-is-written": Mutant("page", "work", _draft_first),
    "page-edit-acknowledged-before-it-is-kept": Mutant("page", "work", _kept_later),
    "page-draft-written-in-place": Mutant("page", "work", _in_place),
    "page-oldest-draft-offered-first": Mutant("page", "work", _oldest_first),
    "page-part-left-on-a-full-disk": Mutant("page", "leftovers", _left_part),
    "page-twin-left-running": Mutant("page", "leftovers", _unended),
    "page-refusal-that-is-a-failure": Mutant("page", "errors", _failing),
    "page-refusal-without-a-line": Mutant("page", "errors", _mute),
}
"""Broken builds, by name."""
