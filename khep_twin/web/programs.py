"""Controllers that are edited in the page: Python files below the folder, never overwritten unnoticed.

Who writes a program and runs it has this user's permissions, so a page for other machines cannot write any.
"""

import threading
from pathlib import Path

from khep_twin.errors import ControllerError
from khep_twin.files.atomic import read_regular, unusable, write_whole
from khep_twin.web.documents import ConflictError, Documents, OutsideError, version_of
from khep_twin.web.requests import PROGRAM_LIMIT

TEMPLATE = Path(__file__).parent.parent / "assets" / "controller_template.py"
"""Program that a new file begins with."""


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
            return read_regular(path).decode("utf-8")
        except UnicodeDecodeError as error:
            raise ControllerError(f"{name}: no UTF-8: {error.reason}; expected a Python file") from None
