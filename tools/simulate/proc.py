"""The part of /proc that shows the descriptors of simulated processes, for `khep_twin.ports.holders`."""

# ruff: noqa: D102

import os
from collections.abc import Callable, Iterator
from typing import Any

from tools.simulate.kernel import Kernel, OpenFile, Process

LinkOf = Callable[[OpenFile], tuple[str, str] | None]
"""Function that returns what /proc shows of an open file, and the path of its device; None for others."""


class SimulatedProcesses:
    """Path /proc."""

    def __init__(self, kernel: Kernel, link_of: LinkOf) -> None:
        self.kernel, self.link_of = kernel, link_of

    def glob(self, _: str) -> Iterator["_Directory"]:
        self.kernel.called()
        for process in [*self.kernel.processes]:
            if process.alive:
                yield _Directory(self, process)

    def readlink(self, path: Any, **options: Any) -> str:
        if isinstance(path, _Descriptor):
            self.kernel.called()
            return path.link()[0]
        return os.readlink(path, **options)


class _Directory:
    """Directory of one process, and of its descriptors."""

    def __init__(self, processes: SimulatedProcesses, process: Process) -> None:
        self._processes, self._process = processes, process
        self.name = str(process.pid)

    def __truediv__(self, name: str) -> "_Directory":
        assert name == "fd", "only descriptors are simulated"
        return self

    def iterdir(self) -> Iterator["_Descriptor"]:
        self._processes.kernel.called()
        for number, file in [*self._process.files.items()]:
            if self._processes.link_of(file) is not None:
                yield _Descriptor(self._processes, self._process, number)


class _Descriptor:
    """Link of one descriptor."""

    def __init__(self, processes: SimulatedProcesses, process: Process, number: int) -> None:
        self._processes, self._process, self._number = processes, process, number

    def link(self) -> tuple[str, str]:
        """Return what it shows, and the path of the device.

        Raises:
            FileNotFoundError: It was closed.
        """
        file = self._process.files.get(self._number)
        found = None if file is None else self._processes.link_of(file)
        if found is None:
            raise FileNotFoundError(2, "No such file or directory")
        return found

    def stat(self) -> os.stat_result:
        self._processes.kernel.called()
        return os.stat(self.link()[1])
