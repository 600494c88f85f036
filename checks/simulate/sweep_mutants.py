"""Broken builds of sweeps."""

from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager, ExitStack
from pathlib import Path
from typing import Any
from unittest.mock import patch

import pyarrow as pa
import pyarrow.parquet as pq

from checks.simulate.mutants import Mutant
from khep_twin.errors import KhepTwinError
from khep_twin.files.atomic import write_whole
from khep_twin.sweep import ray_workers, results
from khep_twin.sweep.results import SweepFolder
from khep_twin.sweep.shards import Shard, Work


def _patched(*changes: tuple[object, str, object]) -> AbstractContextManager[object]:
    stack = ExitStack()
    for place, name, changed in changes:
        stack.enter_context(patch.object(place, name, changed))
    return stack


def _joined_as_found(self: Any) -> None:
    """Join what there is, unchecked."""
    tables = [pq.ParquetFile(each).read() for each in sorted(self._parts.glob("*.parquet"))]
    scratch = self.table.with_name(f".{self.table.name}.part")
    schema = tables[0].schema.with_metadata({results._STUDY: self._work.digest})
    with pq.ParquetWriter(scratch, schema) as writer:
        for table in tables:
            writer.write_table(table.replace_schema_metadata(schema.metadata))
    scratch.replace(self.table)


def _twice() -> AbstractContextManager[object]:
    def keep(self: Any, task: Shard, data: bytes) -> None:
        path = self._part(task)
        write_whole(path.with_suffix(".late.parquet") if path.exists() else path, data)

    return _patched((SweepFolder, "keep", keep), (SweepFolder, "_join", _joined_as_found))


def _dropped() -> AbstractContextManager[object]:
    def coming(ray: Any, work: Work, tasks: Sequence[Shard]) -> Iterator[tuple[Shard, bytes]]:
        remote = ray.remote(num_cpus=1, max_retries=0)(ray_workers._do)
        for task in tasks:
            each = remote.remote(work, task)
            while not ray.wait([each], num_returns=1, timeout=10)[0]:
                pass
            try:
                yield task, ray.get(each)[0]
            except ray.exceptions.WorkerCrashedError:
                continue

    return _patched((ray_workers, "_coming", coming), (SweepFolder, "_join", _joined_as_found))


def _torn() -> AbstractContextManager[object]:
    read = SweepFolder._read

    def holds(self: Any, file: Path, *_: object) -> bool:
        return file.exists()

    def taken(self: Any, task: Shard) -> Any:
        try:
            return read(self, task)
        except KhepTwinError:
            schema = pa.schema([])
            for each in self._work.tasks:
                try:
                    schema = read(self, each).schema
                except KhepTwinError:
                    continue
            return schema.empty_table()

    return _patched((SweepFolder, "_holds", holds), (SweepFolder, "_read", taken))


def _left() -> AbstractContextManager[object]:
    def write(path: Path, data: bytes) -> None:
        scratch = path.with_name(f".{path.name}.part")
        try:
            with scratch.open("wb") as file:
                file.write(data)
        except OSError as error:
            raise KhepTwinError(f"{path}: cannot be written: {error.strerror}") from error
        scratch.replace(path)

    return _patched((results, "write_whole", write))


def _in_place() -> AbstractContextManager[object]:
    def join(self: Any) -> None:
        schema = self._read(self._work.tasks[0]).schema
        with results.pq.ParquetWriter(self.table, schema) as writer:
            for task in self._work.tasks:
                writer.write_table(self._read(task))

    return _patched((SweepFolder, "_join", join))


MUTANTS: dict[str, Mutant] = {
    "sweep-late-result-added": Mutant("sweep", "results", _twice),
    "sweep-task-of-a-dead-worker-dropped": Mutant("sweep", "results", _dropped),
    "sweep-torn-part-taken-as-whole": Mutant("sweep", "results", _torn),
    "sweep-resumed-from-nothing": Mutant(
        "sweep", "results", lambda: _patched((SweepFolder, "missing", lambda self: [*self._work.tasks]))
    ),
    "sweep-without-a-lock": Mutant(
        "sweep", "errors", lambda: _patched((SweepFolder, "_lock", lambda self, descriptor: None))
    ),
    "sweep-leaves-a-part-on-a-full-disk": Mutant("sweep", "leftovers", _left),
    "sweep-table-written-in-place": Mutant("sweep", "errors", _in_place),
}
"""Broken builds, by name."""
