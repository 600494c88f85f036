"""Source text of a controller as it was run, for the log."""

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

from khep_twin.files.text import encodable
from khep_twin.lab.experiment.controllers import BUILT_IN, AnyController, defining, name_of
from khep_twin.lab.experiment.periodic_controllers import NetworkController

MOST_BYTES = 2**20
"""Longest source kept in a log [bytes]; programs written by hand have less than a tenth (assumed)."""


class ReadOnceLoader(SourceFileLoader):
    """Loader of a Python file that reads it once and keeps its bytes.

    It neither reads nor writes `__pycache__`.
    """

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
        facts: Name, built-in or FILE.py:FUNCTION without a folder, and why the source is left out.
        attachments: Source by the name controller/FILE.py, or a network as controller/FILE.json; empty if it
            is left out.
    """

    facts: Mapping[str, str]
    attachments: Mapping[str, str] = field(default_factory=dict[str, str])

    @property
    def identity(self) -> dict[str, str]:
        """Name and source hash that identify the controller."""
        text = "".join(f"{name}\0{text}" for name, text in sorted(self.attachments.items()))
        return {**self.facts, "controller_source": f"sha256 {sha256(text.encode('utf-8')).hexdigest()}"}


def source_of(controller: AnyController) -> Source:
    """Return name and source of a controller; of its file only, without imports."""
    if isinstance(controller, NetworkController) and controller.defined_by is None:
        return _network_source(controller)
    defined = defining(controller)
    file = inspect.getsourcefile(defined) or ""
    # The folder is specific to the machine and no part of the run.
    name = encodable(Path(file).name)
    built_in = next((each for each, function in BUILT_IN.items() if function is controller), None)
    facts = {"controller": built_in or f"{name}:{name_of(controller)}"}
    try:
        # A module may come from an archive; that of an interactive Python has no file.
        get_data = getattr(getattr(inspect.getmodule(defined), "__loader__", None), "get_data", None)
        data: bytes = Path(file).read_bytes() if get_data is None else get_data(file)
        text = _text(data)
    except (OSError, SyntaxError, ValueError) as error:
        reason = getattr(error, "strerror", None) or error
        return Source(facts | {"controller_source": f"left out: cannot be read: {reason}"})
    if len(data) > MOST_BYTES:
        return Source(facts | {"controller_source": f"left out: {len(data)} bytes, more than {MOST_BYTES}"})
    return Source(facts, {f"controller/{name}": text})


def _network_source(controller: NetworkController) -> Source:
    """Return the name of a network's file, and the network as JSON."""
    name = encodable(controller.file or "network.npz")
    text = json.dumps(asdict(controller.network))
    facts = {"controller": name, "network": f"sha256 {sha256(text.encode()).hexdigest()}"}
    if len(text) > MOST_BYTES:
        return Source(facts | {"controller_source": f"left out: {len(text)} bytes, more than {MOST_BYTES}"})
    return Source(facts, {f"controller/{Path(name).stem}.json": text})


def _text(data: bytes) -> str:
    """Return a source as text: UTF-8 to the byte, anything else decoded as Python does."""
    try:
        return data.decode("utf-8")
    except UnicodeDecodeError:
        encoding, _ = tokenize.detect_encoding(io.BytesIO(data).readline)
        return data.decode(encoding)


def forget_modules_beside(program: Path) -> None:
    """Have a program import the modules beside it as they are now, not those of an earlier program."""
    _FOLDERS.add(program.parent)
    tops = {name.partition(".")[0] for name in sys.modules} - {"khep_twin", "__main__"}
    beside = {top for top in tops if _folder(top) in _FOLDERS}
    for name in [name for name in sys.modules if name.partition(".")[0] in beside]:
        del sys.modules[name]
    sys.path[:] = [str(program.parent), *(each for each in sys.path if each != str(program.parent))]
    importlib.invalidate_caches()


def _folder(top: str) -> Path:
    """Return the folder that a module or package without a parent is in."""
    file = Path(getattr(sys.modules.get(top), "__file__", None) or "/")
    return file.parent.parent if file.name == "__init__.py" else file.parent


_FOLDERS: set[Path] = set()
"""Folders of the programs read so far."""
