"""The source of a controller, as the log of its run keeps it: the very text that was run."""

import inspect
import io
import tokenize
from collections.abc import Mapping
from dataclasses import dataclass, field
from hashlib import sha256
from importlib.machinery import SourceFileLoader
from pathlib import Path
from types import CodeType

from khep_twin.lab.experiment.controllers import BUILT_IN, AnyController, defining, name_of

MOST_BYTES = 2**20
"""Longer sources are left out of logs; a program written by hand has no tenth of it (assumed)."""


class ReadOnceLoader(SourceFileLoader):
    """Loads a Python file from one reading of it, and still has what it read afterwards.

    Nothing is taken from `__pycache__` and nothing left there.
    """

    _data: bytes | None = None

    def get_code(self, fullname: str) -> CodeType | None:
        """Compiles what was read."""
        return self.source_to_code(self.get_data(self.path), self.path)

    def get_data(self, path: str) -> bytes:
        """The file's bytes when it was read first."""
        if self._data is None:
            self._data = super().get_data(path)
        return self._data


@dataclass(frozen=True, slots=True)
class Source:
    """What a log says of a controller.

    Attributes:
        facts: its name, as built in or FILE.py:FUNCTION without a folder, and why its source is left out.
        attachments: its source by the name controller/FILE.py, empty if it is left out.
    """

    facts: Mapping[str, str]
    attachments: Mapping[str, str] = field(default_factory=dict[str, str])

    @property
    def identity(self) -> dict[str, str]:
        """What tells a controller from another one: its name and a hash of its source."""
        text = "".join(f"{name}\0{text}" for name, text in sorted(self.attachments.items()))
        return {**self.facts, "controller_source": f"sha256 {sha256(text.encode('utf-8')).hexdigest()}"}


def source_of(controller: AnyController) -> Source:
    """What a log says of a controller: of a file, just that file and not what it imports."""
    defined = defining(controller)
    file = inspect.getsourcefile(defined) or ""
    # The folder is the machine's business and no part of the run.
    name = Path(file).name.encode("utf-8", "backslashreplace").decode("utf-8")
    built_in = next((each for each, function in BUILT_IN.items() if function is controller), None)
    facts = {"controller": built_in or f"{name}:{name_of(controller)}"}
    try:
        # A module may come out of an archive; that of an interactive Python comes out of nothing.
        get_data = getattr(getattr(inspect.getmodule(defined), "__loader__", None), "get_data", None)
        data: bytes = Path(file).read_bytes() if get_data is None else get_data(file)
        text = _text(data)
    except (OSError, SyntaxError, ValueError) as error:
        reason = getattr(error, "strerror", None) or str(error)
        return Source(facts | {"controller_source": f"left out: cannot be read: {reason}"})
    if len(data) > MOST_BYTES:
        return Source(facts | {"controller_source": f"left out: {len(data)} bytes, more than {MOST_BYTES}"})
    return Source(facts, {f"controller/{name}": text})


def _text(data: bytes) -> str:
    """A source as text; what is UTF-8 stays so to the byte, anything else is read as Python reads it."""
    try:
        return data.decode("utf-8")
    except UnicodeDecodeError:
        encoding, _ = tokenize.detect_encoding(io.BytesIO(data).readline)
        return data.decode(encoding)
