"""Broken builds of the page."""

from collections.abc import Mapping
from contextlib import nullcontext
from pathlib import Path
from typing import Any

from checks.simulate.mutants import Broken, Mutant, replaced
from khep_twin.errors import KhepTwinError
from khep_twin.web import answers, documents
from khep_twin.web.documents import Documents
from khep_twin.web.session_actions import SessionActions

_begin, _save, _keep, _left = Documents.__init__, Documents.save, Documents.save_draft, Documents.drafts


def _overwrite(self: Documents, *args: Any, **options: Any) -> str:
    return _save(self, *args, **{**options, "overwrite": True})


def _begin_unlocked(self: Documents, root: Path) -> None:
    _begin(self, root)
    self._save_lock = nullcontext()  # type: ignore[assignment]


def _save_draft_first(self: Documents, name: str, *args: Any, page: str = "", **options: Any) -> str:
    self.save_draft(name, None, page)
    return _save(self, name, *args, page=page, **options)


def _keep_later(self: Documents, *args: Any) -> None:
    documents.threading.Thread(target=lambda: _keep(self, *args), name="keep").start()


def _write(path: Path, part: Path, data: bytes) -> None:
    try:
        with part.open("wb") as file:
            file.write(data)
        if part != path:
            documents.os.replace(part, path)
    except OSError as error:
        raise KhepTwinError(f"{path}: cannot be written: {error.strerror}") from error


_write_whole = documents.write_atomic


def _write_in_place(path: Path, data: bytes) -> None:
    if path.suffix != ".draft":
        _write_whole(path, data)
    else:
        _write(path, path, data)


def _write_leaving_part(path: Path, data: bytes) -> None:
    _write(path, path.with_name(f".{path.name}.part"), data)


def _forget_actor(self: SessionActions, _: object) -> None:
    self._actor = None


def _answer_unguarded(action: Any, _: answers.FormatText) -> Any:
    content = action()
    return content if isinstance(content, answers.Response) else answers.JSONResponse(content or {})


def _oldest_first(self: Documents, name: str | None) -> list[dict[str, object]]:
    return _left(self, name)[::-1]


def _refuse_mutely(_: str, status: int = 400, **fields: bool) -> Any:
    content: Mapping[str, object] = {"error": "", **fields}
    return answers.JSONResponse(content, status)


_broken: dict[str, tuple[str, Broken]] = {
    "page-overwrites-a-changed-file": ("work", replaced(Documents, save=_overwrite)),
    "page-two-saves-at-once": ("work", replaced(Documents, __init__=_begin_unlocked)),
    "page-draft-deleted-before-the-file-is-written": ("work", replaced(Documents, save=_save_draft_first)),
    "page-edit-acknowledged-before-it-is-kept": ("work", replaced(Documents, save_draft=_keep_later)),
    "page-draft-written-in-place": ("work", replaced(documents, write_atomic=_write_in_place)),
    "page-oldest-draft-offered-first": ("work", replaced(Documents, drafts=_oldest_first)),
    "page-part-left-on-a-full-disk": ("leftovers", replaced(documents, write_atomic=_write_leaving_part)),
    "page-twin-left-running": ("leftovers", replaced(SessionActions, _end=_forget_actor)),
    "page-refusal-that-is-a-failure": ("errors", replaced(answers, respond=_answer_unguarded)),
    "page-refusal-without-a-line": ("errors", replaced(answers, refusal=_refuse_mutely)),
}

MUTANTS = {name: Mutant("page", *broken) for name, broken in _broken.items()}
"""Broken builds, by name."""
