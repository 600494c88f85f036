"""Playpen files below one folder.

The version of a file is a hash of its bytes. Each save names the version that it is based on, so two pages,
or a page and an editor, never overwrite each other unnoticed. Unsaved changes of a page are stored in a draft
beside the file, `.NAME.toml.PAGE.draft`, which only this page writes:

    unchanged --edit--> draft --save or discard--> unchanged (the draft is deleted)
"""

import json
import os
import re
import stat
import threading
from collections.abc import Mapping
from contextlib import suppress
from hashlib import sha256
from pathlib import Path

from khep_twin import playpen as playpens
from khep_twin.errors import KhepTwinError, PlaypenError
from khep_twin.files import toml_files
from khep_twin.files.atomic import resolve, unusable, write_atomic
from khep_twin.files.toml_files import SIZE_LIMIT
from khep_twin.playpen import Playpen
from khep_twin.web.drafts import Draft, blank, draft_of, text_of
from khep_twin.web.requests import RequestError, object_of, sendable

_UNNAMED = "unnamed"
"""Name in a draft's file name for a playpen that has no file yet."""

PROGRAM_SUFFIXES = (".py", ".npz")
"""File name extensions of controllers."""

_PAGE = re.compile("[A-Za-z0-9-]{0,40}")  # identifier of a page

_LIST_LIMIT, _SEARCH_LIMIT = 300, 20_000
"""Largest numbers of listed files, and of files searched for them."""


class OutsideError(KhepTwinError):
    """A path outside the folder."""


class ConflictError(KhepTwinError):
    """A file that has changed since the page opened it."""


class Documents:
    """Playpens below a folder; file names are relative to it."""

    def __init__(self, root: Path) -> None:
        self.root = resolve(root)
        self._save_lock = threading.Lock()

    def path(self, name: str, *suffixes: str) -> Path:
        """Return the path of a file that has one of these extensions.

        Raises:
            OutsideError: The file is not below the folder.
            PlaypenError: The name has another extension, or is not that of a regular file.
        """
        path = self.below(name)
        if path.suffix not in suffixes or Path(name).name.startswith("."):
            raise PlaypenError(f"{name}: expected a name that ends in {' or '.join(suffixes)}")
        try:
            if path.suffix and path.exists() and not path.is_file():  # opening a pipe would wait forever
                raise PlaypenError(f"{name}: this is no regular file; expected the name of a file")
        except OSError as error:  # for example a name that is too long
            raise PlaypenError(f"{name}: {error.strerror}") from error
        return path

    def below(self, name: str) -> Path:
        """Return the path of a file or folder of any kind.

        Raises:
            OutsideError: It is not below the folder.
        """
        if not name or len(name) > 512 or not name.isprintable() or "\\" in name:
            raise OutsideError("no file name; expected a file below the folder of the designer")
        relative_path = Path(name)
        if relative_path.is_absolute() or ".." in relative_path.parts:
            raise OutsideError(f"{name}: outside the folder that the designer was started in")
        path = resolve(self.root / relative_path)
        if not path.is_relative_to(self.root):
            raise OutsideError(f"{name}: leads out of the folder that the designer was started in")
        return path

    def relative(self, text: str) -> str:
        """Return a text with file names relative to the folder."""
        return text.replace(f"{self.root}{os.sep}", "")

    def new_path(self, name: str, *suffixes: str) -> Path:
        """Return the path of a new file; an empty file may be replaced.

        Raises:
            OutsideError: The file is not below the folder.
            PlaypenError: The name has another extension, or the file exists.
        """
        path = self.path(name, *suffixes)
        if path.exists() and path.stat().st_size:
            raise PlaypenError(f"{name}: is there already; expected the name of a new file")
        return path

    def log(self, name: str) -> Path:
        """Return the path of a log.

        Raises:
            OutsideError: The file is not below the folder.
            PlaypenError: The name is not that of an existing log.
        """
        path = self.path(name, ".mcap")
        if not path.is_file():
            raise PlaypenError(f"{name}: not found; expected a log below the folder of the designer")
        return path

    def names(self, *suffixes: str) -> list[str]:
        """Return the sorted names of files with one of these extensions, or .toml, outside hidden folders.

        Names that `below` refuses are left out: JSON cannot represent the bytes of some.
        """
        names: list[str] = []
        n_files = 0
        for folder, folders, files in os.walk(self.root):
            folders[:] = sorted(subfolder for subfolder in folders if not subfolder.startswith((".", "__")))
            n_files += len(files)
            names += [
                name
                for file in files
                if file.endswith(suffixes or ".toml")
                and not file.startswith(".")
                and (name := (Path(folder) / file).relative_to(self.root).as_posix()).isprintable()
            ]
            if len(names) >= _LIST_LIMIT or n_files > _SEARCH_LIMIT:
                break
        return sorted(names)[:_LIST_LIMIT]

    def check(self, name: str) -> None:
        """Check that a file can be opened or created.

        Raises:
            KhepTwinError: It cannot.
        """
        path = self.path(name, ".toml")
        if path.exists():
            playpens.parse(self._text(name), name)
        elif reason := unusable(path):
            raise PlaypenError(f"{name}: cannot be made: {reason}")

    def open(self, name: str) -> dict[str, object]:
        """Return a file for the page: its playpen, its version, and its drafts.

        Raises:
            KhepTwinError: The file cannot be used.
        """
        text = self._text(name)
        draft = draft_of(playpens.parse(text, name))
        return {"file": name, "version": version_of(text), "draft": draft, "left": self.drafts(name)}

    def new(self, name: str | None) -> dict[str, object]:
        """Return a new playpen for a file that does not exist yet, and the file's drafts."""
        draft = blank(Path(name or "playpen.toml").stem)
        return {"file": name, "version": None, "draft": draft, "left": self.drafts(name)}

    def library(self, name: str) -> dict[str, object]:
        """Return a playpen of the library as a new document.

        Raises:
            PlaypenError: There is none of this name.
        """
        if name not in playpens.names():
            raise PlaypenError(f"{name}: no such playpen in the library")
        return {"file": None, "version": None, "draft": draft_of(Playpen.load(name))}

    def save(
        self,
        name: str,
        draft: Draft,
        *,
        version: str | None,
        base: dict[str, str],
        overwrite: bool = False,
        page: str = "",
    ) -> str:
        """Write a playpen file with its comments, and delete the page's draft of it.

        Args:
            name: Name of the file.
            draft: Playpen to write.
            version: Version that the draft is based on; None for a new file.
            base: Source of the text to start from: {"file": NAME}, {"library": NAME} or {}.
            overwrite: Replace any version of the file.
            page: Identifier of the page that saves.

        Returns:
            New version of the file.

        Raises:
            ConflictError: The file has another version than the page knows.
            KhepTwinError: The draft is no valid playpen, or cannot be written.
        """
        path = self.path(name, ".toml")
        draft_path = self._draft_path(name, page)
        # Two pages that save simultaneously must not both find their version.
        with self._save_lock:
            current_text = self._current_text(name, version, overwrite)
            text = text_of(draft, _valid_base(self._base_text(base, current_text)))
            # Another program may have written the file meanwhile.
            self._current_text(name, version, overwrite)
            write_atomic(path, text.encode("utf-8"))
        draft_path.unlink(missing_ok=True)
        return version_of(text)

    def version(self, name: str) -> str | None:
        """Return a file's version; None if it does not exist."""
        path = self.path(name, ".toml")
        return version_of(self._text(name)) if path.exists() else None

    def save_draft(self, name: str | None, content: Mapping[str, object] | None, page: str = "") -> None:
        """Write a page's draft beside the file, or delete it.

        Args:
            name: File that the draft belongs to; None for a playpen without a file.
            content: The "draft", with its "version" and its "base"; None to delete it.
            page: Identifier of the page.

        Raises:
            KhepTwinError: The draft cannot be written.
        """
        path = self._draft_path(name, page)
        if content is None:
            path.unlink(missing_ok=True)
        else:
            write_atomic(path, json.dumps(content).encode("utf-8"))

    def drafts(self, name: str | None) -> list[dict[str, object]]:
        """Return the readable drafts of a file, newest first, each with its "page" and its "time" [s]."""
        drafts: list[tuple[float, dict[str, object]]] = []
        with suppress(OSError, KhepTwinError):
            path = self._document_path(name)
            pattern = re.compile(rf"\.{re.escape(path.name)}(?:\.({_PAGE.pattern}))?\.draft")
            for draft_path in path.parent.iterdir():
                match = pattern.fullmatch(draft_path.name)
                if match is not None and (saved_draft := _read_draft(draft_path)) is not None:
                    draft, time = saved_draft
                    drafts.append((time, {**draft, "time": time, "page": match[1] or ""}))
        return [draft for _, draft in sorted(drafts, key=lambda entry: -entry[0])]

    def _document_path(self, name: str | None) -> Path:
        """Return the path from which the names of a document's drafts are derived."""
        return self.root / _UNNAMED if name is None else self.path(name, ".toml")

    def _draft_path(self, name: str | None, page: str) -> Path:
        if not _PAGE.fullmatch(page):
            raise OutsideError("page: expected letters, digits and hyphens, at most 40")
        path = self._document_path(name)
        draft_path = path.with_name(f".{path.name}.{page}.draft" if page else f".{path.name}.draft")
        # Unlike `is_symlink`, it raises where the draft's name is too long.
        with suppress(FileNotFoundError):
            if stat.S_ISLNK(os.lstat(draft_path).st_mode):
                raise OutsideError(f"{draft_path.name}: a link, which may lead out of the folder")
        return draft_path

    def _base_text(self, base: dict[str, str], current_text: str | None) -> str | None:
        if "library" in base and base["library"] in playpens.names():
            return toml_files.read("playpens", base["library"], PlaypenError)[0]
        if "file" in base and self.path(base["file"], ".toml").exists():
            return self._text(base["file"])
        return current_text

    def _current_text(self, name: str, version: str | None, overwrite: bool) -> str | None:
        """Return the text of a file before it is replaced, None if it does not exist.

        Raises:
            ConflictError: It has another version.
        """
        current_text = self._text(name) if self.path(name, ".toml").exists() else None
        if current_text is not None and not overwrite and version_of(current_text) != version:
            raise ConflictError(
                f"{name}: was changed by another page or program; expected to be loaded anew, saved "
                "under another name, or replaced"
            )
        return current_text

    def _text(self, name: str) -> str:
        return toml_files.read("playpens", self.path(name, ".toml"), PlaypenError)[0]


def _read_draft(path: Path) -> tuple[dict[str, object], float] | None:
    """Return the content of a draft and its time [s]; None if it cannot be read."""
    try:
        if path.is_symlink() or not path.is_file():
            return None
        with path.open("rb") as file:
            content = sendable(object_of(file.read(2 * SIZE_LIMIT)))
            time = os.fstat(file.fileno()).st_mtime
    except (OSError, ValueError, RequestError):
        return None
    # Earlier versions wrote the playpen only.
    return (content if "draft" in content else {"draft": content}), time


def _valid_base(base: str | None) -> str | None:
    """Return a text to edit, or None if it is no valid playpen: another program may have broken it."""
    try:
        if base is not None:
            playpens.parse(base, "the file to be edited")
    except PlaypenError:
        return None
    return base


def version_of(text: str) -> str:
    """Return the version of a file with a given text."""
    return sha256(text.encode("utf-8")).hexdigest()[:16]
