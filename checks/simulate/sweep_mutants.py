"""Broken builds of sweeps."""

from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager, ExitStack
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

from checks.simulate.mutants import Broken, Mutant, nothing, replaced
from khep_twin.errors import KhepTwinError
from khep_twin.files.atomic import write_atomic
from khep_twin.sweep import ray_workers, results
from khep_twin.sweep.results import SweepFolder
from khep_twin.sweep.shards import Shard, Work

_read = SweepFolder._read_part


def _joined_as_found(self: Any) -> None:
    """Join all present parts, unchecked."""
    tables = [pq.ParquetFile(path).read() for path in sorted(self._parts.glob("*.parquet"))]
    scratch = self.table.with_name(f".{self.table.name}.part")
    schema = tables[0].schema.with_metadata({results._STUDY: self._work.digest})
    with pq.ParquetWriter(scratch, schema) as writer:
        for table in tables:
            writer.write_table(table.replace_schema_metadata(schema.metadata))
    scratch.replace(self.table)


def _keep_twice(self: Any, task: Shard, data: bytes) -> None:
    path = self._part_path(task)
    write_atomic(path.with_suffix(".late.parquet") if path.exists() else path, data)


def _coming_once(ray: Any, work: Work, tasks: Sequence[Shard]) -> Iterator[tuple[Shard, bytes]]:
    remote = ray.remote(num_cpus=1, max_retries=0)(ray_workers._run_task)
    for task in tasks:
        reference = remote.remote(work, task)
        while not ray.wait([reference], num_returns=1, timeout=10)[0]:
            pass
        try:
            yield task, ray.get(reference)[0]
        except ray.exceptions.WorkerCrashedError:
            continue


def _is_there(_: Any, file: Path, *__: object) -> bool:
    return file.exists()


def _read_torn(self: Any, task: Shard) -> Any:
    try:
        return _read(self, task)
    except KhepTwinError:
        schema = pa.schema([])
        for other in self._work.tasks:
            try:
                schema = _read(self, other).schema
            except KhepTwinError:
                continue
        return schema.empty_table()


def _write_leaving_part(path: Path, data: bytes) -> None:
    scratch = path.with_name(f".{path.name}.part")
    try:
        with scratch.open("wb") as file:
            file.write(data)
    except OSError as error:
        raise KhepTwinError(f"{path}: cannot be written: {error.strerror}") from error
    scratch.replace(path)


def _join_in_place(self: Any) -> None:
    schema = self._read(self._work.tasks[0]).schema
    with results.pq.ParquetWriter(self.table, schema) as writer:
        for task in self._work.tasks:
            writer.write_table(self._read(task))


def _dropped() -> AbstractContextManager[object]:
    stack = ExitStack()
    stack.enter_context(replaced(ray_workers, _collect_results=_coming_once)())
    stack.enter_context(replaced(SweepFolder, _join_parts=_joined_as_found)())
    return stack


_broken: dict[str, tuple[str, Broken]] = {
    "sweep-late-result-added": (
        "results",
        replaced(SweepFolder, save=_keep_twice, _join_parts=_joined_as_found),
    ),
    "sweep-task-of-a-dead-worker-dropped": ("results", _dropped),
    "sweep-torn-part-taken-as-whole": (
        "results",
        replaced(SweepFolder, _is_complete=_is_there, _read_part=_read_torn),
    ),
    "sweep-resumed-from-nothing": (
        "results",
        replaced(SweepFolder, missing=lambda self: [*self._work.tasks]),
    ),
    "sweep-without-a-lock": ("errors", replaced(SweepFolder, _lock=nothing)),
    "sweep-leaves-a-part-on-a-full-disk": ("leftovers", replaced(results, write_atomic=_write_leaving_part)),
    "sweep-table-written-in-place": ("errors", replaced(SweepFolder, _join_parts=_join_in_place)),
}

MUTANTS = {name: Mutant("sweep", *broken) for name, broken in _broken.items()}
"""Broken builds, by name."""
