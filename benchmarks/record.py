"""Files of benchmark results in TOML: date, machine, versions and all tables.

The machine is described by its processor, cores, memory and operating system alone.
"""

import os
import platform
import re
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

import tomlkit

from benchmarks.table import Result, Table
from khep_twin import __version__
from khep_twin.errors import KhepTwinError
from khep_twin.files.atomic import write_atomic

FOLDER = Path(__file__).parent / "results"
PACKAGES = ("mujoco", "numba", "numpy")


@dataclass(frozen=True, slots=True)
class Record:
    """One run of the benchmarks.

    Attributes:
        date: Year, month and day.
        load: Load averages at the start, over 1, 5 and 15 minutes.
        machine: Processor, cores, memory.
        versions: Versions of the software that took part.
        tables: Results.
    """

    date: str
    load: tuple[float, ...]
    machine: Mapping[str, str | int]
    versions: Mapping[str, str]
    tables: tuple[Table, ...]

    @property
    def name(self) -> str:
        """Name of the file: the date and the machine."""
        words = re.sub(r"[^a-z0-9]+", "-", str(self.machine["processor"]).lower()).strip("-")
        return f"{self.date}-{words}-{self.machine['cores']}-cores.toml"


def machine() -> dict[str, str | int]:
    """Return this machine."""
    match = re.search(r"^model name\s*:\s*(.+)$", _read("/proc/cpuinfo"), re.MULTILINE)
    memory = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    return {
        "processor": match[1] if match else platform.machine(),
        "cores": len(os.sched_getaffinity(0)),
        "memory_gib": round(memory / 2**30),
        "system": f"{platform.system()} {'.'.join(re.findall('[0-9]+', platform.release())[:2])}",
    }


def versions(peer_versions: Mapping[str, str]) -> dict[str, str]:
    """Return the versions of Python, this project, its numerical packages, and others that took part."""
    project_versions = {"python": platform.python_version(), "khep_twin": __version__}
    return {**project_versions, **{name: version(name) for name in PACKAGES}, **peer_versions}


def load() -> tuple[float, ...]:
    """Return the load averages over 1, 5 and 15 minutes."""
    return tuple(round(average, 2) for average in os.getloadavg())


def save(record: Record, folder: Path) -> Path:
    """Write a record under its name.

    Raises:
        KhepTwinError: The record cannot be written.
    """
    data = {
        "date": record.date,
        "load": list(record.load),
        "machine": dict(record.machine),
        "versions": dict(record.versions),
        "table": [_plain(table) for table in record.tables],
    }
    document = tomlkit.document()
    document.add(
        tomlkit.comment("Written by `python -m benchmarks --save`; benchmarks/table.py has its fields.")
    )
    document.update(data)
    path = folder / record.name
    write_atomic(path, tomlkit.dumps(document).encode())
    return path


def read(path: Path) -> Record:
    """Read a record from its file.

    Raises:
        KhepTwinError: The file cannot be read, or is no record.
    """
    try:
        data = tomllib.loads(path.read_text())
        tables = tuple(_table(**table) for table in data["table"])
        return Record(data["date"], tuple(data["load"]), data["machine"], data["versions"], tables)
    except OSError as error:
        raise KhepTwinError(f"{path}: cannot be read: {error.strerror}") from error
    except (UnicodeDecodeError, tomllib.TOMLDecodeError, KeyError, TypeError) as error:
        raise KhepTwinError(f"{path}: no results of benchmarks; expected a file of --save") from error


def head(record: Record) -> str:
    """Return date, machine, versions and load, in two lines."""
    computer, version_text = (
        record.machine,
        ", ".join(f"{name} {number}" for name, number in record.versions.items()),
    )
    return (
        f"{record.date}: {computer['processor']}, {computer['cores']} cores, {computer['memory_gib']} GiB, "
        f"{computer['system']}; load {record.load[0]:g}\n{version_text}"
    )


def _table(title: str, unit: str, rounds: int, remarks: list[str], row: list[dict[str, Any]]) -> Table:
    return Table(title, unit, rounds, tuple(Result(**result) for result in row), tuple(remarks))


def _plain(table: Table) -> dict[str, Any]:
    plain: dict[str, Any] = {"title": table.title, "unit": table.unit, "rounds": table.rounds}
    rows: Sequence[dict[str, Any]] = [asdict(row) for row in table.results]
    return {**plain, "remarks": list(table.remarks), "row": rows}


def _read(path: str) -> str:
    try:
        return Path(path).read_text()
    except OSError:
        return ""
