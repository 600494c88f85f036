"""Disk of a simulated sweep: its writes are calls of the kernel, which may be the last, or find no room."""

import os
import pathlib
import shutil
from collections.abc import Generator, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any
from unittest.mock import patch

import pyarrow.parquet as pq

from checks.simulate.kernel import Killed
from checks.simulate.kernel_files import WritesThroughKernel, room
from checks.simulate.simulation import Simulation
from khep_twin.sweep import results

MOST_TORN = 0.5
"""Highest probability that a power failure tears a file."""


class _TableWriter:
    """Writer of a table that may be killed at each column, or find no room at a task; the file is torn then.

    pyarrow writes each column of a task separately, without a buffer.
    """

    def __init__(self, simulation: Simulation, path: Path, *options: Any) -> None:
        simulation.kernel.called()
        self._simulation, self._path = simulation, path
        self._writer = pq.ParquetWriter(path, *options)

    def __enter__(self) -> "_TableWriter":
        return self

    def write_table(self, table: Any) -> None:
        for _ in range(table.num_columns):
            self._simulation.kernel.called()
        room(self._simulation)
        self._writer.write_table(table)

    def __exit__(self, kind: Any, error: BaseException | None, _: Any) -> None:
        try:
            if error is None:
                self._simulation.kernel.called()
        except Killed as killed:
            error = killed
            raise
        finally:
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


@contextmanager
def installed(simulation: Simulation) -> Generator[None]:
    """Put this disk below pathlib, shutil and the results."""
    with ExitStack() as stack:
        stack.enter_context(patch.object(pathlib, "io", WritesThroughKernel(simulation)))
        stack.enter_context(patch.object(shutil, "os", simulation.system.modules["os"]))
        stack.enter_context(patch.object(results, "pq", _Parquet(simulation)))
        yield


def tear(simulation: Simulation, folder: Path) -> Iterator[str]:
    """Tear files, as a power failure does before they are on the disk; yield their names."""
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
