"""Scenario `files`: whole files that are written again and again, on a disk with faults."""

from collections.abc import Generator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO

from checks.simulate.disk import Disk
from checks.simulate.kernel import Process
from checks.simulate.mutants import Mutant, nothing, replaced
from checks.simulate.simulation import Simulation
from checks.simulate.system import SimulatedOs
from khep_twin.errors import KhepTwinError
from khep_twin.files import atomic

LOOK = 1.0
"""Time between two looks at the files [s]."""

NAMES = "playpen.toml", "draft.json", "report.pdf"


class _Document:
    """A file whose versions state their number in every line."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.saved_version = self.started_version = 0

    def version(self) -> int | None:
        """Return the number of the version that is there, 0 if there is no file, None for a mixture."""
        if not self.path.exists():
            return 0
        lines = self.path.read_bytes().splitlines(keepends=True)
        if not lines or len({*lines[:-1]}) > 1 or lines[-1] != b"end\n":
            return None
        number, _, count = lines[0].partition(b" of ")
        return int(number) if len(lines) == int(count) + 1 else None


def files(simulation: Simulation, seconds: float) -> None:
    """Let a program write its files, end and begin again; look at them all the time."""
    disk = Disk(simulation)
    documents = [_Document(simulation.folder / name) for name in NAMES]
    writers: list[Process] = []

    def start() -> None:
        number = len(writers)
        writers.append(
            simulation.spawn(f"writer{number}", lambda: _write(simulation, documents, number), 10**9)
        )
        writers[-1].mortal = True

    start()
    for _ in range(round(seconds / LOOK)):
        simulation.run(LOOK)
        _check(simulation, documents)
        # A power cut may come when no program does anything.
        if simulation.faults.happens("power-cut", "machine", 0.05):
            disk.cut()
            _check(simulation, documents)
        if not writers[-1].alive:
            start()
    if not disk.agrees():
        raise AssertionError("the simulated disk holds other files than the machine")


def _write(simulation: Simulation, documents: list[_Document], number: int) -> None:
    """Write versions of the files, each as its users do."""
    rng, sleep = simulation.rng("writer", number), simulation.system.modules["time"].sleep  # type: ignore[attr-defined]
    while True:
        sleep(rng.uniform(0.0, 4.0))
        document = rng.choice(documents)
        document.started_version += 1
        count = round(10 ** rng.uniform(0, 4))
        line = b"%d of %d\n" % (document.started_version, count)
        try:
            if document.path.suffix == ".pdf":
                with atomic.atomic_file(document.path) as file:
                    for part in range(0, count, 1000):
                        file.write(line * min(count - part, 1000))
                        sleep(rng.uniform(0.0, 0.1))
                    file.write(b"end\n")
            else:
                atomic.write_atomic(document.path, line * count + b"end\n")
        except KhepTwinError as error:
            if "cannot be written: " not in str(error) or "\n" in str(error):
                raise
            simulation.count("refused files")
        else:
            document.saved_version = document.started_version
            simulation.count("saved files")


def _check(simulation: Simulation, documents: list[_Document]) -> None:
    """Check that each file is complete, and not older than the last saved version."""
    for document in documents:
        version = document.version()
        name = document.path.name
        if version is None:
            simulation.violate("work", f"{name} is no whole version")
        if not document.saved_version <= version <= document.started_version:
            simulation.violate("work", f"{name} is version {version}, but {document.saved_version} was saved")
        simulation.count("looks at files")


# Broken builds ------------------------------------------------------------------------------------------


@contextmanager
def _in_place(path: Path, replace: bool = True) -> Generator[BinaryIO]:
    with path.open("w+b") as file:
        yield file


@contextmanager
def _renamed_first(path: Path, replace: bool = True) -> Generator[BinaryIO]:
    part = path.with_name(f".{path.name}.part")
    with part.open("w+b") as file:
        part.replace(path)
        yield file


SCENARIOS = {"files": files}

MUTANTS = {
    "files written in place": Mutant("files", "work", replaced(atomic, part_file=_in_place)),
    "files renamed before they are whole": Mutant(
        "files", "work", replaced(atomic, part_file=_renamed_first)
    ),
    "files renamed before they are on the disk": Mutant(
        "files", "work", replaced(SimulatedOs, fsync=nothing)
    ),
    "renames that a power cut takes back": Mutant(
        "files", "work", replaced(atomic, synchronize_folder=nothing)
    ),
}
