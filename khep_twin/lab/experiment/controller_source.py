"""Source text of a controller for the log, as it was at the start of the run."""

import importlib
import inspect
import io
import json
import sys
import tokenize
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from hashlib import sha256
from importlib.machinery import SourceFileLoader
from pathlib import Path
from types import CodeType

from khep_twin.files.text import escape_surrogates
from khep_twin.lab.experiment.controllers import BUILT_IN, AnyController, definition_of, name_of
from khep_twin.lab.experiment.periodic_controllers import NetworkController

MAX_BYTES = 2**20
"""Longest source stored in a log [bytes]; programs written by hand have less than a tenth (assumed)."""

_PROGRAM_FOLDERS: set[Path] = set()
"""Folders of the programs loaded so far."""


class ReadOnceLoader(SourceFileLoader):
    """Loader of a Python file that reads it once; it neither reads nor writes `__pycache__`."""

    _data: bytes | None = None

    def get_code(self, fullname: str) -> CodeType | None:
        """Compile the bytes that were read."""
        return self.source_to_code(self.get_data(self.path), self.path)

    def get_data(self, path: str) -> bytes:
        """Return the file's bytes as they were first read."""
        if self._data is None:
            self._data = super().get_data(path)
        return self._data


@dataclass(frozen=True, slots=True)
class Source:
    """Name and source of a controller, for a log.

    Attributes:
        facts: Name, built-in or FILE.py:FUNCTION without the folder, and the reason if the source is omitted.
        attachments: Source as controller/FILE.py, or network as controller/FILE.json; empty if omitted.
    """

    facts: Mapping[str, str]
    attachments: Mapping[str, str] = field(default_factory=dict[str, str])

    @property
    def identity(self) -> dict[str, str]:
        """Name and source hash that identify the controller."""
        text = "".join(f"{name}\0{text}" for name, text in sorted(self.attachments.items()))
        return {**self.facts, "controller_source": f"sha256 {sha256(text.encode('utf-8')).hexdigest()}"}


def source_of(controller: AnyController) -> Source:
    """Return name and source of a controller: of its file alone, without imported modules."""
    if isinstance(controller, NetworkController) and controller.defined_by is None:
        return _network_source(controller)
    definition = definition_of(controller)
    file = inspect.getsourcefile(definition) or ""
    # The folder depends on the machine and does not affect the run.
    name = escape_surrogates(Path(file).name)
    built_in = next((key for key, function in BUILT_IN.items() if function is controller), None)
    facts = {"controller": built_in or f"{name}:{name_of(controller)}"}
    try:
        # A module may come from an archive; an interactive session has no file.
        get_data = getattr(getattr(inspect.getmodule(definition), "__loader__", None), "get_data", None)
        data: bytes = Path(file).read_bytes() if get_data is None else get_data(file)
        text = _decode(data)
    except (OSError, SyntaxError, ValueError) as error:
        reason = getattr(error, "strerror", None) or error
        return Source(facts | {"controller_source": f"left out: cannot be read: {reason}"})
    if len(data) > MAX_BYTES:
        return Source(facts | {"controller_source": f"left out: {len(data)} bytes, more than {MAX_BYTES}"})
    return Source(facts, {f"controller/{name}": text})


def _network_source(controller: NetworkController) -> Source:
    """Return the name of a network's file, and the network as JSON."""
    name = escape_surrogates(controller.file or "network.npz")
    text = json.dumps(asdict(controller.network))
    facts = {"controller": name, "network": f"sha256 {sha256(text.encode()).hexdigest()}"}
    if len(text) > MAX_BYTES:
        return Source(facts | {"controller_source": f"left out: {len(text)} bytes, more than {MAX_BYTES}"})
    return Source(facts, {f"controller/{Path(name).stem}.json": text})


def _decode(data: bytes) -> str:
    """Return a source as text: UTF-8, or else the encoding that Python detects."""
    try:
        return data.decode("utf-8")
    except UnicodeDecodeError:
        encoding, _ = tokenize.detect_encoding(io.BytesIO(data).readline)
        return data.decode(encoding)


def forget_modules_beside(program: Path) -> None:
    """Unload the modules of earlier programs, so that a program imports those in its folder afresh."""
    _PROGRAM_FOLDERS.add(program.parent)
    top_levels = {name.partition(".")[0] for name in sys.modules} - {"khep_twin", "__main__"}
    outdated = {top_level for top_level in top_levels if _module_folder(top_level) in _PROGRAM_FOLDERS}
    for name in [name for name in sys.modules if name.partition(".")[0] in outdated]:
        del sys.modules[name]
    sys.path[:] = [str(program.parent), *(entry for entry in sys.path if entry != str(program.parent))]
    importlib.invalidate_caches()


def _module_folder(top_level: str) -> Path:
    """Return the folder that contains a top-level module or package."""
    file = Path(getattr(sys.modules.get(top_level), "__file__", None) or "/")
    return file.parent.parent if file.name == "__init__.py" else file.parent
