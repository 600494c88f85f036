"""Files of Python's whose writes are calls of the kernel, which may be the last, or find no room."""

import errno
import io
import os
from typing import Any

from checks.simulate.simulation import Simulation
from checks.simulate.system import Shim

MOST_FULL = 0.02
"""Highest probability that a write finds no room."""


class KernelFile(io.FileIO):
    """File whose writes are calls of the kernel; unwritten data of a killed process is lost."""

    def __init__(self, path: Any, mode: str, simulation: Simulation, max_full_rate: float) -> None:
        super().__init__(path, mode.replace("b", ""))
        self._simulation, self._most_full = simulation, max_full_rate

    def write(self, data: Any) -> int:
        """Write some bytes: not always all."""
        self._simulation.kernel.called()
        room(self._simulation, self._most_full)
        view = memoryview(data).cast("B")
        return super().write(view[: max(len(view) // 2, 512)]) or 0


class WritesThroughKernel(Shim):
    """Module `io`, of which files for writing are the kernel's."""

    def __init__(self, simulation: Simulation, most_full: float = MOST_FULL) -> None:
        super().__init__(io, simulation.kernel)
        self._simulation, self._most_full = simulation, most_full

    def open(self, path: Any, mode: str = "r", buffering: int = -1, *options: Any) -> Any:
        """Open a file."""
        if "w" not in mode or self.kernel.current is None:
            return open(path, mode, buffering, *options)
        self.kernel.called()
        file = KernelFile(path, mode.replace("t", ""), self._simulation, self._most_full)
        if buffering == 0:
            return file
        buffered = io.BufferedRandom(file) if "+" in mode else io.BufferedWriter(file)
        return buffered if "b" in mode else io.TextIOWrapper(buffered, *options)


def room(simulation: Simulation, most_full: float = MOST_FULL) -> None:
    """Check that there is room for a write.

    Raises:
        OSError: The disk is full.
    """
    if simulation.faults.happens("full", "disk", most_full):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
