"""Playpen files below one folder.

A file is identified by its version, a hash of its bytes: each save names the version that it is based on, so
two pages, or a page and an editor, never overwrite each other unnoticed. Unsaved changes of a page are a
draft beside the file, `.NAME.toml.PAGE.draft`, until they are saved or discarded. Each page writes and
deletes its own drafts only.
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
from khep_twin.files.atomic import resolved, unusable, write_whole
from khep_twin.files.toml_files import SIZE_LIMIT
from khep_twin.playpen import Playpen
from khep_twin.web.drafts import Draft, blank, draft_of, text_of
from khep_twin.web.requests import RequestError, object_of, sendable

_UNNAMED = "unnamed"
"""Name in a draft's file name for a playpen that has no file yet."""

PROGRAMS = (".py", ".npz")
"""Endings of controllers' files."""

_PAGE = re.compile("[A-Za-z0-9-]{0,40}")
"""Identifiers of pages."""

_LISTED, _LOOKED_AT = 300, 20_000
"""Largest numbers of files that are listed, and that are searched for them."""


class OutsideError(KhepTwinError):
    """A path outside the folder."""


class ConflictError(KhepTwinError):
    """A file that has changed since the page opened it."""


class Documents:
    """Playpens below a folder; names of files are from there on."""

    def __init__(self, root: Path) -> None:
        self.root = resolved(root)
        self._saving = threading.Lock()

    def path(self, name: str, *endings: str) -> Path:
        """Return the path of a file that has one of these endings.

        Raises:
            OutsideError: The file is not below the folder.
            PlaypenError: The name is no such file's.
        """
        found = self.below(name)
        if found.suffix not in endings or Path(name).name.startswith("."):
            raise PlaypenError(f"{name}: expected a name that ends in {' or '.join(endings)}")
        try:
            # Opening a pipe would wait for ever.
            odd = found.suffix and found.exists() and not found.is_file()
        except OSError as error:  # such as a name that is too long
            raise PlaypenError(f"{name}: {error.strerror}") from error
        if odd:
            raise PlaypenError(f"{name}: this is no regular file; expected the name of a file")
        return found

    def below(self, name: str) -> Path:
        """Return the path of a file or folder of any kind.

        Raises:
            OutsideError: It is not below this one.
        """
        if not name or len(name) > 512 or not name.isprintable() or "\\" in name:
            raise OutsideError("no file name; expected a file below the folder of the designer")
        wanted = Path(name)
        if wanted.is_absolute() or ".." in wanted.parts:
            raise OutsideError(f"{name}: outside the folder that the designer was started in")
        found = resolved(self.root / wanted)
        if not found.is_relative_to(self.root):
            raise OutsideError(f"{name}: leads out of the folder that the designer was started in")
        return found

    def relative(self, text: str) -> str:
        """Return a text in which files are named from the folder on."""
        return text.replace(f"{self.root}/", "")

    def new_path(self, name: str, *endings: str) -> Path:
        """Return the path of a new file; an empty file may be replaced.

        Raises:
            OutsideError: The file is not below the folder.
            PlaypenError: The name is no such file's, or the file exists.
        """
        found = self.path(name, *endings)
        if found.exists() and found.stat().st_size:
            raise PlaypenError(f"{name}: is there already; expected the name of a new file")
        return found

    def log(self, name: str) -> Path:
        """Return the path of a log.

        Raises:
            OutsideError: The file is not below the folder.
            PlaypenError: The name is no log's, or there is none.
        """
        found = self.path(name, ".mcap")
        if not found.is_file():
            raise PlaypenError(f"{name}: not found; expected a log below the folder of the designer")
        return found

    def names(self, *endings: str) -> list[str]:
        """Return the files with one of these endings, or .toml, by name, without those in hidden folders.

        Names that `below` refuses are left out: some have bytes that no JSON can represent.
        """
        found: list[str] = []
        looked = 0
        for folder, folders, files in os.walk(self.root):
            folders[:] = sorted(each for each in folders if not each.startswith((".", "__")))
            looked += len(files)
            found += [
                name
                for file in files
                if file.endswith(endings or ".toml")
                and not file.startswith(".")
                and (name := str((Path(folder) / file).relative_to(self.root))).isprintable()
            ]
            if len(found) >= _LISTED or looked > _LOOKED_AT:
                break
        return sorted(found)[:_LISTED]

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
        return {"file": name, "version": version_of(text), "draft": draft, "left": self.left(name)}

    def new(self, name: str | None) -> dict[str, object]:
        """Return a new playpen for a file that does not exist yet, and the file's drafts."""
        draft = blank(Path(name or "playpen.toml").stem)
        return {"file": name, "version": None, "draft": draft, "left": self.left(name)}

    def library(self, name: str) -> dict[str, object]:
        """Return a shipped playpen as a new document.

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
        """Write a playpen file, keep its comments, and delete the page's draft of it.

        Args:
            name: Name of the file.
            draft: Playpen to write.
            version: Version of the file as the page knows it; None for a new one.
            base: Source of the text to start from: {"file": NAME}, {"library": NAME} or {}.
            overwrite: Replace the file whatever its version.
            page: Identifier of the page that saves.

        Returns:
            New version of the file.

        Raises:
            ConflictError: The file has another version than the page knows.
            KhepTwinError: The draft is no valid playpen, or cannot be written.
        """
        path, draft_place = self.path(name, ".toml"), self._draft_place(name, page)
        # Two pages that save at once must not both find the version that they know.
        with self._saving:
            text = text_of(draft, _usable(self._base(base, self._replaced(name, version, overwrite))))
            # Another program may have written the file meanwhile.
            self._replaced(name, version, overwrite)
            write_whole(path, text.encode("utf-8"))
        draft_place.unlink(missing_ok=True)
        return version_of(text)

    def version(self, name: str) -> str | None:
        """Return a file's version; None if it is gone."""
        path = self.path(name, ".toml")
        return version_of(self._text(name)) if path.exists() else None

    def keep(self, name: str | None, kept: Mapping[str, object] | None, page: str = "") -> None:
        """Write a page's draft beside the file, or delete it.

        Args:
            name: File that the draft belongs to; None for a playpen without a file.
            kept: The "draft", with the "version" and the "base" that it was made from; None to delete it.
            page: Identifier of the page.

        Raises:
            KhepTwinError: The draft cannot be written.
        """
        place = self._draft_place(name, page)
        if kept is None:
            place.unlink(missing_ok=True)
        else:
            write_whole(place, json.dumps(kept).encode("utf-8"))

    def left(self, name: str | None) -> list[dict[str, object]]:
        """Return the readable drafts of a file, the newest first, each with its "page" and its "time" [s]."""
        found: list[tuple[float, dict[str, object]]] = []
        with suppress(OSError, KhepTwinError):
            path = self._draft_path(name)
            named = re.compile(rf"\.{re.escape(path.name)}(?:\.({_PAGE.pattern}))?\.draft")
            for place in path.parent.iterdir():
                match = named.fullmatch(place.name)
                if match is not None and (kept := _kept(place)) is not None:
                    draft, time = kept
                    found.append((time, {**draft, "time": time, "page": match[1] or ""}))
        return [draft for _, draft in sorted(found, key=lambda each: -each[0])]

    def _draft_path(self, name: str | None) -> Path:
        """Return the file that the names of its drafts are made from."""
        return self.root / _UNNAMED if name is None else self.path(name, ".toml")

    def _draft_place(self, name: str | None, page: str) -> Path:
        if not _PAGE.fullmatch(page):
            raise OutsideError("page: expected letters, digits and hyphens, at most 40")
        path = self._draft_path(name)
        place = path.with_name(f".{path.name}.{page}.draft" if page else f".{path.name}.draft")
        # Unlike `is_symlink`, it raises where the draft's name is too long.
        with suppress(FileNotFoundError):
            if stat.S_ISLNK(os.lstat(place).st_mode):
                raise OutsideError(f"{place.name}: a link, which may lead out of the folder")
        return place

    def _base(self, base: dict[str, str], there: str | None) -> str | None:
        if "library" in base and base["library"] in playpens.names():
            return toml_files.read("playpens", base["library"], PlaypenError)[0]
        if "file" in base and self.path(base["file"], ".toml").exists():
            return self._text(base["file"])
        return there

    def _replaced(self, name: str, version: str | None, overwrite: bool) -> str | None:
        """Return the text of the file that a save replaces, None if there is none.

        Raises:
            ConflictError: It has another version.
        """
        there = self._text(name) if self.path(name, ".toml").exists() else None
        if there is not None and not overwrite and version_of(there) != version:
            raise ConflictError(
                f"{name}: was changed by another page or program; expected to be loaded anew, saved "
                "under another name, or replaced"
            )
        return there

    def _text(self, name: str) -> str:
        return toml_files.read("playpens", self.path(name, ".toml"), PlaypenError)[0]


def _kept(place: Path) -> tuple[dict[str, object], float] | None:
    """Return the content of a draft's file, and its time [s]; None if it cannot be read."""
    try:
        if place.is_symlink() or not place.is_file():
            return None
        with place.open("rb") as file:
            kept = sendable(object_of(file.read(2 * SIZE_LIMIT)))
            time = os.fstat(file.fileno()).st_mtime
    except (OSError, ValueError, RequestError):
        return None
    # A draft of an earlier version is the playpen alone.
    return (kept if "draft" in kept else {"draft": kept}), time


def _usable(base: str | None) -> str | None:
    """Return a text to start from; None if it is no playpen any more, as another program has broken it."""
    try:
        if base is not None:
            playpens.parse(base, "the file to be edited")
    except PlaypenError:
        return None
    return base


def version_of(text: str) -> str:
    """Return the version of a file with this text."""
    return sha256(text.encode("utf-8")).hexdigest()[:16]
