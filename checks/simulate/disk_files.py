"""Files of a simulated disk: their content, its durable part, and Python's objects to write them."""

import io
import os
import random
from collections.abc import Mapping
from itertools import count
from pathlib import Path
from typing import Any

from checks.simulate.system import SimulatedOs

_BLOCK = 4096
"""Size of a block [bytes], that of ext4 and XFS by default."""


class DiskFile:
    """A file, or a folder, under any number of names.

    Attributes:
        number: Number of it.
        is_folder: True if it is a folder.
        content: Content as processes see it.
    """

    def __init__(self, number: int, is_folder: bool = False, content: bytes = b"") -> None:
        self.number, self.is_folder = number, is_folder
        self.content = bytearray(content)
        self._durable = content
        self._sizes: list[int] = []

    def write(self, place: int, data: bytes) -> None:
        """Write at a place."""
        if place > len(self.content):
            self.content += bytes(place - len(self.content))
        self.content[place : place + len(data)] = data
        self._sizes.append(len(self.content))

    def truncate(self, size: int) -> None:
        """Cut it off, or lengthen it."""
        del self.content[size:]
        self.content += bytes(size - len(self.content))
        self._sizes.append(size)

    def synchronize(self) -> None:
        """Bring it to the disk."""
        self._durable = bytes(self.content)
        self._sizes.clear()

    def cut(self, rng: random.Random) -> None:
        """Lose some of the unsynchronized content."""
        if self._sizes:
            self.content = bytearray(self._survivor(rng))
        self.synchronize()

    def _survivor(self, rng: random.Random) -> bytes:
        fate = rng.random()
        if fate < 0.3:
            return bytes(self.content)
        if fate < 0.5:
            return self._durable
        shortest, longest = sorted((len(self._durable), max(self._sizes)))
        size = rng.choice([*self._sizes[-20:], rng.randint(shortest, longest)])
        if rng.random() < 0.3:
            size -= size % _BLOCK
        size = max(size, min(shortest, len(self.content)))
        lost = rng.choice((0.0, 0.0, 0.1, 0.5))
        survivor = bytearray()
        for place in range(0, size, _BLOCK):
            source = self._durable if rng.random() < lost else self.content
            survivor += source[place : min(place + _BLOCK, size)].ljust(min(_BLOCK, size - place), b"\0")
        return bytes(survivor)


_Change = Mapping[str, DiskFile | None]


class Journal:
    """Names of files, now and on the disk.

    Args:
        root: Folder of them all.
    """

    def __init__(self, root: str) -> None:
        self._numbers = count()
        self._durable: dict[str, DiskFile] = {root: DiskFile(next(self._numbers), is_folder=True)}
        self._root = root
        self._now = dict(self._durable)
        self._changes: list[_Change] = []

    def file(self, name: str) -> DiskFile:
        """Return the file of a name; one that was made before there was a disk is on it."""
        if name not in self._now:
            is_folder = os.path.isdir(name)
            content = b""
            if not is_folder:
                with open(name, "rb") as file:
                    content = file.read()
            self._now[name] = self._durable[name] = DiskFile(next(self._numbers), is_folder, content)
        return self._now[name]

    def created(self, name: str, folder: bool = False) -> None:
        """Note a new file, or folder."""
        self._change({name: DiskFile(next(self._numbers), folder)})

    def removed(self, name: str) -> None:
        """Note a name that is removed."""
        self._change({name: None})

    def renamed(self, before: str, after: str) -> None:
        """Note a new name in the place of another."""
        file = self.file(after) if before not in self._now else self._now[before]
        self._change({before: None, after: file})

    def linked(self, first: str, second: str) -> None:
        """Note another name of a file."""
        self._change({second: self.file(first)})

    def synchronize(self, file: DiskFile) -> None:
        """Bring the changes of a file's names, or of the names in a folder, to the disk, with all before."""
        folder = (
            next((name for name, other in self._now.items() if other is file), "") if file.is_folder else ""
        )
        last = 0
        for number, change in enumerate(self._changes, 1):
            if any(
                other is file or (folder and os.path.dirname(name) == folder)
                for name, other in change.items()
            ):
                last = number
        for change in self._changes[:last]:
            _apply(self._durable, change)
        del self._changes[:last]

    def cut(self, rng: random.Random) -> dict[str, DiskFile]:
        """Lose some of the changes; return the remaining files by name, folders before their content."""
        n_survived = rng.choice((0, len(self._changes), rng.randint(0, len(self._changes))))
        for change in self._changes[:n_survived]:
            _apply(self._durable, change)
        self._changes.clear()
        self._now = dict(self._durable)
        for number in sorted({disk_file.number: disk_file for disk_file in self._now.values()}):
            next(disk_file for disk_file in self._now.values() if disk_file.number == number).cut(rng)
        return {name: self._now[name] for name in sorted(self._now) if name != self._root}

    def agrees(self) -> bool:
        """Return whether the real files equal the present ones."""
        paths = [os.path.join(folder, name) for folder, _, names in os.walk(self._root) for name in names]
        contents = {
            name: disk_file.content for name, disk_file in self._now.items() if not disk_file.is_folder
        }
        return all(name in contents for name in paths if name in self._now) and all(
            os.path.exists(name) and Path(name).read_bytes() == content for name, content in contents.items()
        )

    def _change(self, change: _Change) -> None:
        self._changes.append(change)
        _apply(self._now, change)


def _apply(names: dict[str, DiskFile], change: _Change) -> None:
    for name, file in change.items():
        if file is None:
            names.pop(name, None)
        else:
            names[name] = file


def opened_buffered(
    system: SimulatedOs,
    path: Any,
    mode: str,
    buffering: int = -1,
    encoding: str | None = None,
    errors: str | None = None,
    newline: str | None = None,
) -> Any:
    """Open a file as `io.open` does, over the simulated system's calls."""
    raw = _RawFile(system, path, mode)
    if buffering == 0:
        return raw
    buffered = io.BufferedRandom(raw) if "+" in mode else io.BufferedWriter(raw)
    return buffered if "b" in mode else io.TextIOWrapper(buffered, encoding, errors, newline)


_FLAGS = {"r": 0, "w": os.O_CREAT | os.O_TRUNC, "x": os.O_CREAT | os.O_EXCL, "a": os.O_CREAT | os.O_APPEND}
"""Flags of `os.open` for the modes of `io.open`."""


class _RawFile(io.RawIOBase):
    """A file that calls the simulated system; of a dead process it does nothing more."""

    def __init__(self, system: SimulatedOs, path: Any, mode: str) -> None:
        self._system, self._process = system, system.kernel.current
        self._reads = "+" in mode
        flags = os.O_RDWR if self._reads else os.O_WRONLY
        flags |= _FLAGS[mode.strip("bt+")] | os.O_CLOEXEC
        self._descriptor = system.open(path, flags, 0o666)

    def _is_over(self) -> bool:
        return self._process is not self._system.kernel.current

    def fileno(self) -> int:
        return self._descriptor

    def readable(self) -> bool:
        return self._reads

    def writable(self) -> bool:
        return True

    def seekable(self) -> bool:
        return True

    def write(self, data: Any) -> int:
        return len(data) if self._is_over() else self._system.write(self._descriptor, data)

    def readinto(self, buffer: Any) -> int:
        data = os.read(self._descriptor, len(buffer))
        buffer[: len(data)] = data
        return len(data)

    def seek(self, offset: int, whence: int = os.SEEK_SET) -> int:
        return os.lseek(self._descriptor, offset, whence)

    def truncate(self, size: int | None = None) -> int:
        size = self.tell() if size is None else size
        self._system.ftruncate(self._descriptor, size)
        return size

    def close(self) -> None:
        if not self.closed:
            super().close()
            if not self._is_over():
                self._system.close(self._descriptor)
