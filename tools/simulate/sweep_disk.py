"""Disk of a simulated sweep: its writes are calls of the kernel, which may be the last, or find no room."""

import errno
import io
import os
import pathlib
import shutil
from collections.abc import Generator, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any
from unittest.mock import patch

import pyarrow.parquet as pq

from khep_twin.sweep import results
from tools.simulate.kernel import Killed
from tools.simulate.simulation import Simulation
from tools.simulate.system import Shim

MOST_FULL, MOST_TORN = 0.02, 0.5
"""Highest probabilities that a write finds no room, and that a power failure tears a file."""


class KernelFile(io.FileIO):
    """File of which each write is a call of the kernel; what a killed process has not written is lost."""

    def __init__(self, path: Any, mode: str, simulation: Simulation) -> None:
        super().__init__(path, mode.replace("b", ""))
        self._simulation = simulation

    def write(self, data: Any) -> int:
        """Write some bytes: not always all."""
        self._simulation.kernel.called()
        room(self._simulation)
        view = memoryview(data).cast("B")
        return super().write(view[: max(len(view) // 2, 512)]) or 0


class WritesThroughKernel(Shim):
    """Module `io`, of which files for writing are the kernel's."""

    def __init__(self, simulation: Simulation) -> None:
        super().__init__(io, simulation.kernel)
        self._simulation = simulation

    def open(self, path: Any, mode: str = "r", buffering: int = -1, *options: Any) -> Any:
        """Open a file."""
        if "w" not in mode or self.kernel.current is None:
            return open(path, mode, buffering, *options)
        assert "b" in mode, "files of results are bytes"
        file = KernelFile(path, mode, self._simulation)
        return io.BufferedRandom(file) if "+" in mode else io.BufferedWriter(file)


class _TableWriter:
    """Writer of a table that may be killed, or find no room, at each task; then the file is torn."""

    def __init__(self, simulation: Simulation, path: Path, *options: Any) -> None:
        simulation.kernel.called()
        self._simulation, self._path = simulation, path
        self._writer = pq.ParquetWriter(path, *options)

    def __enter__(self) -> "_TableWriter":
        return self

    def write_table(self, table: Any) -> None:
        self._simulation.kernel.called()
        room(self._simulation)
        self._writer.write_table(table)

    def __exit__(self, kind: Any, error: BaseException | None, _: Any) -> None:
        self._writer.close()
        if isinstance(error, Killed):
            os.truncate(self._path, self._path.stat().st_size // 2)


class _Parquet:
    def __init__(self, simulation: Simulation) -> None:
        self._simulation = simulation

    def __getattr__(self, name: str) -> Any:
        return getattr(pq, name)

    def ParquetWriter(self, *options: Any) -> _TableWriter:
        return _TableWriter(self._simulation, *options)


def room(simulation: Simulation) -> None:
    """Check that there is room for a write.

    Raises:
        OSError: The disk is full.
    """
    if simulation.faults.happens("full", "disk", MOST_FULL):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


@contextmanager
def installed(simulation: Simulation) -> Generator[None]:
    """Put this disk below pathlib, shutil and the results."""
    with ExitStack() as stack:
        stack.enter_context(patch.object(pathlib, "io", WritesThroughKernel(simulation)))
        stack.enter_context(patch.object(shutil, "os", simulation.system.modules["os"]))
        stack.enter_context(patch.object(results, "pq", _Parquet(simulation)))
        yield


def tear(simulation: Simulation, folder: Path) -> Iterator[str]:
    """Tear files, as a power failure does to what was not on disk yet; yield their names."""
    faults = simulation.faults
    for part in sorted(folder.glob("parts/task-*.parquet")):
        if not faults.happens("torn", "results", MOST_TORN):
            continue
        rng = faults.drawn("torn", "results")
        size = part.stat().st_size
        offset = rng.randrange(size)
        if rng.random() < 0.5:
            os.truncate(part, offset)
        else:
            with part.open("r+b") as file:
                file.seek(offset)
                file.write(bytes(min(rng.randrange(1, 4096), size - offset)))
        yield part.name
