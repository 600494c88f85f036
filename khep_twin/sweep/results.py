"""A sweep's folder: one part file per finished task, joined into one table at the end.

    study.json                    the study, and the number of its tasks
    parts/task-000012.parquet     results of a task, written atomically
    results.parquet               all episodes in order; the parts are deleted when it is complete

A part is named by its task's number, and its content depends only on the study: a task that was run twice has
one part. The same study gives the same bytes of results.parquet, after any interruptions.
"""

# pyarrow is not typed.
# pyright: reportMissingTypeStubs=false, reportUnknownMemberType=false, reportUnknownVariableType=false
# pyright: reportUnknownArgumentType=false, reportUnknownParameterType=false

import io
import json
import os
import shutil
from collections.abc import Generator, Iterator
from contextlib import contextmanager
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq

from khep_twin import __version__
from khep_twin.errors import StudyError
from khep_twin.files.atomic import atomic_file, is_part, open_regular, read_regular, write_atomic
from khep_twin.process.machine import FOLDER_LOCK, lock, open_folder
from khep_twin.sweep.run_shard import Columns
from khep_twin.sweep.shards import Shard, Work
from khep_twin.sweep.study import COLUMNS

_STUDY, _TASK = b"khep_twin.study", b"khep_twin.task"
"""Keys of a table's metadata."""

_TYPES = {"failed_step": pa.int64(), "failure": pa.string()}
"""Types of columns that may be entirely empty."""

_MAX_ROWS = 12
"""Largest number of rows of means in a summary."""


def encode_part(work: Work, task: Shard, columns: Columns) -> bytes:
    """Return a task's results as the bytes of its part."""
    # NaN is stored as a missing value.
    arrays = {name: pa.array(values, _TYPES.get(name), from_pandas=True) for name, values in columns.items()}
    table = pa.table(arrays).replace_schema_metadata({_STUDY: work.digest, _TASK: str(task.index)})
    file = io.BytesIO()
    pq.write_table(table, file)
    return file.getvalue()


class SweepFolder:
    """Folder of a sweep's results."""

    def __init__(self, path: Path, work: Work) -> None:
        self._path = path
        self._work = work
        self._parts = path / "parts"
        self.table = path / "results.parquet"

    @contextmanager
    def open(self, resume: bool) -> Generator[None]:
        """Create or resume the folder, locked for this process.

        Raises:
            StudyError: The folder has other content, or results of this study without `resume`.
        """
        try:
            self._path.mkdir(parents=True, exist_ok=True)
            descriptor = open_folder(self._path)
        except OSError as error:
            raise StudyError(f"{self._path}: cannot be created: {error.strerror}") from error
        try:
            self._lock(descriptor)
            self._prepare(resume)
            yield
        finally:
            os.close(descriptor)

    def missing(self) -> list[Shard]:
        """Return the tasks without complete results."""
        if self.table.exists():
            if not self._is_complete(self.table, self._work.n_episodes):
                raise StudyError(f"{self.table}: damaged; delete it, and use --resume")
            return []
        return [
            task
            for task in self._work.tasks
            if not self._is_complete(self._part_path(task), task.count, str(task.index).encode())
        ]

    def save(self, task: Shard, data: bytes) -> None:
        """Store a task's results."""
        write_atomic(self._part_path(task), data)

    def finish(self) -> Path:
        """Join all parts into one table; return its path.

        Raises:
            StudyError: An episode is missing or duplicate; parts are kept.
            KhepTwinError: The table cannot be written; likewise.
        """
        if not self.table.exists():
            self._join_parts()
        shutil.rmtree(self._parts, ignore_errors=True)
        return self.table

    def _lock(self, descriptor: int) -> None:
        """Lock the folder; the system releases the lock when the process ends or is killed."""
        try:
            lock(descriptor)
        except BlockingIOError:
            raise StudyError(f"{self._path}: in use by another sweep; wait for its end") from None
        except OSError as error:
            raise StudyError(f"{self._path}: cannot be locked: {error.strerror}") from error

    def _prepare(self, resume: bool) -> None:
        """Write study.json into a new folder, or check that of the previous sweep."""
        file, work = self._path / "study.json", self._work
        previous = _read_json(file)
        # A sweep that was killed may have left an incomplete study.json or table.
        entries = sorted(path for path in self._path.iterdir() if path.name != FOLDER_LOCK)
        leftovers = [path for path in entries if is_part(path, file) or is_part(path, self.table)]
        files = [path for path in entries if path not in leftovers]
        if previous is None and files:
            raise StudyError(f"{self._path}: holds {files[0].name} and no study.json; expected a new folder")
        for path in leftovers:
            path.unlink(missing_ok=True)
        # A study without results, as with a program that does not compile, may be corrected and restarted.
        if previous is None or not self._has_results():
            description = {
                "name": work.study.name,
                "episodes": work.n_episodes,
                "tasks": len(work.tasks),
                "khep_twin": __version__,
                "digest": work.digest,
            }
            write_atomic(file, (json.dumps(description, indent=2) + "\n").encode())
        elif previous.get("digest") != work.digest:
            raise StudyError(
                f"{self._path}: holds results of another study, of another version, or of this study before "
                "it changed; expected a new folder"
            )
        elif not resume:
            raise StudyError(
                f"{self._path}: holds results of this study already; expected --resume, or a new folder"
            )
        if self.table.exists():
            return  # no more parts are written, and a kill would leave the empty folder
        try:
            self._parts.mkdir(exist_ok=True)
        except OSError as error:
            raise StudyError(f"{self._parts}: cannot be created: {error.strerror}") from error

    def _has_results(self) -> bool:
        """Return whether there are results, of any study."""
        return self.table.exists() or (self._parts.is_dir() and any(self._parts.iterdir()))

    def _part_path(self, task: Shard) -> Path:
        return self._parts / f"task-{task.index:06}.parquet"

    def _is_complete(self, file: Path, n_episodes: int, task: bytes | None = None) -> bool:
        """Return whether a file is complete, with the episodes of this study."""
        try:
            with open_regular(file) as content:
                footer = pq.read_metadata(content)
        except (OSError, pa.ArrowInvalid):
            return False
        metadata = footer.metadata or {}
        is_same_work = metadata.get(_STUDY) == self._work.digest.encode() and metadata.get(_TASK) == task
        return is_same_work and footer.num_rows == n_episodes

    def _join_parts(self) -> None:
        schema = self._read_part(self._work.tasks[0]).schema
        with atomic_file(self.table, False) as file, pq.ParquetWriter(file, schema) as writer:
            for task in self._work.tasks:
                writer.write_table(self._read_part(task))

    def _read_part(self, task: Shard) -> pa.Table:
        """Return a part; check that it holds each of its episodes once."""
        file = self._part_path(task)
        try:
            # read_table would turn folder names like a=1 into columns.
            with pq.ParquetFile(file) as part:
                table = part.read()
            is_complete = table["episode"].to_pylist() == list(range(task.first, task.first + task.count))
        except (OSError, pa.ArrowException):
            table, is_complete = pa.table({}), False
        if not is_complete:
            raise StudyError(
                f"{file}: does not hold episodes {task.first} to {task.first + task.count - 1}, each once; "
                "delete it, and use --resume"
            )
        return table.replace_schema_metadata({_STUDY: self._work.digest})


def summary(table: Path) -> Iterator[str]:
    """Yield the number of episodes in a table, and the means of each controller in each playpen."""
    measures = [name for name in pq.read_schema(table).names if name not in COLUMNS]
    results = pq.ParquetFile(table).read(["playpen", "controller", "failure", *measures])
    yield f"{results.num_rows} episodes, {results.num_rows - results['failure'].null_count} failed; means:"
    groups = results.group_by(["playpen", "controller"], use_threads=False)
    rows = groups.aggregate([(name, "mean") for name in measures]).to_pylist()
    for row in rows[:_MAX_ROWS]:
        means = [(name, row[f"{name}_mean"]) for name in measures]
        texts = [f"{name} {mean:.4g}" for name, mean in means if mean is not None]
        yield "  ".join([row["playpen"], row["controller"], *texts])
    if len(rows) > _MAX_ROWS:
        yield f"and {len(rows) - _MAX_ROWS} more"


def _read_json(file: Path) -> dict[str, object] | None:
    """Return the content of a file; None if there is no file."""
    try:
        content = json.loads(read_regular(file))
    except FileNotFoundError:
        return None
    except (OSError, ValueError):
        content = None
    if not isinstance(content, dict):
        raise StudyError(
            f"{file}: cannot be read, so the study of these results is unknown; expected a new folder"
        )
    return content  # pyright: ignore[reportUnknownVariableType]
