"""A sweep's folder: a part for each finished task, then one table of all.

    study.json                    the study, and the number of its tasks
    parts/task-000012.parquet     results of a task, written atomically
    results.parquet               all episodes in order; the parts are deleted when it is complete

A part's name is its task's number, and its content depends on the study alone: a task that was run twice has
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
from khep_twin.files.atomic import is_part, kept_both, open_regular, put, read_regular, write_whole
from khep_twin.machine import lock
from khep_twin.sweep.run_shard import Columns
from khep_twin.sweep.shards import Shard, Work
from khep_twin.sweep.study import COLUMNS

_STUDY, _TASK = b"khep_twin.study", b"khep_twin.task"

_TYPES = {"failed_step": pa.int64(), "failure": pa.string()}
"""Types of columns that may have no value at all."""

_MOST_ROWS = 12
"""Most rows of means in a summary."""


def encoded(work: Work, task: Shard, columns: Columns) -> bytes:
    """Return a task's results as the bytes of its part."""
    # NaN is stored as a missing value.
    arrays = {name: pa.array(values, _TYPES.get(name), from_pandas=True) for name, values in columns.items()}
    marked = pa.table(arrays).replace_schema_metadata({_STUDY: work.digest, _TASK: str(task.index)})
    file = io.BytesIO()
    pq.write_table(marked, file)
    return file.getvalue()


class SweepFolder:
    """Folder of a sweep's results."""

    def __init__(self, path: Path, work: Work) -> None:
        self._path, self._work = path, work
        self._parts = path / "parts"
        self.table = path / "results.parquet"

    @contextmanager
    def opened(self, resume: bool) -> Generator[None]:
        """Create or resume the folder, locked for this process.

        Raises:
            StudyError: The folder has other content, or results of this study without `resume`.
        """
        try:
            self._path.mkdir(parents=True, exist_ok=True)
            descriptor = os.open(self._path, os.O_RDONLY)
        except OSError as error:
            raise StudyError(f"{self._path}: cannot be created: {error.strerror}") from error
        try:
            self._lock(descriptor)
            self._begin(resume)
            yield
        finally:
            os.close(descriptor)

    def missing(self) -> list[Shard]:
        """Return the tasks without complete results."""
        if self.table.exists():
            if not self._holds(self.table, self._work.n_episodes):
                raise StudyError(f"{self.table}: damaged; delete it, and use --resume")
            return []
        return [
            task
            for task in self._work.tasks
            if not self._holds(self._part(task), task.count, str(task.index).encode())
        ]

    def keep(self, task: Shard, data: bytes) -> None:
        """Store a task's results."""
        write_whole(self._part(task), data)

    def finish(self) -> Path:
        """Join all parts to one table; return its path.

        Raises:
            StudyError: The table cannot be written, or an episode is missing or duplicate; the parts stay.
        """
        if not self.table.exists():
            self._join()
        shutil.rmtree(self._parts, ignore_errors=True)
        return self.table

    def _lock(self, descriptor: int) -> None:
        """Lock the folder; the lock ends with the process, even if that is killed."""
        try:
            lock(descriptor)
        except BlockingIOError:
            raise StudyError(f"{self._path}: in use by another sweep; wait for its end") from None
        except OSError as error:
            raise StudyError(f"{self._path}: cannot be locked: {error.strerror}") from error

    def _begin(self, resume: bool) -> None:
        file, work = self._path / "study.json", self._work
        known = _json(file)
        # A sweep that was killed at once may have left a part of its file.
        there = sorted(self._path.iterdir())
        left = [path for path in there if is_part(path, file)]
        found = [path for path in there if path not in left]
        if known is None and found:
            raise StudyError(f"{self._path}: holds {found[0].name} and no study.json; expected a new folder")
        for path in left:
            path.unlink(missing_ok=True)
        # A study without results, as with a program that does not compile, may be corrected and restarted.
        if known is None or not self._has_results():
            told = {
                "name": work.study.name,
                "episodes": work.n_episodes,
                "tasks": len(work.tasks),
                "khep_twin": __version__,
                "digest": work.digest,
            }
            write_whole(file, (json.dumps(told, indent=2) + "\n").encode())
        elif known.get("digest") != work.digest:
            raise StudyError(
                f"{self._path}: holds results of another study, or of this one before it changed; expected a "
                "new folder"
            )
        elif not resume:
            raise StudyError(
                f"{self._path}: holds results of this study already; expected --resume, or a new folder"
            )
        if self.table.exists():
            return  # no part is written any more, and a kill would leave the folder
        try:
            self._parts.mkdir(exist_ok=True)
        except OSError as error:
            raise StudyError(f"{self._parts}: cannot be created: {error.strerror}") from error

    def _has_results(self) -> bool:
        """Return whether there are results, of any study."""
        return self.table.exists() or (self._parts.is_dir() and any(self._parts.iterdir()))

    def _part(self, task: Shard) -> Path:
        return self._parts / f"task-{task.index:06}.parquet"

    def _holds(self, file: Path, n_episodes: int, task: bytes | None = None) -> bool:
        """Return whether a file is complete, with the episodes of this study."""
        try:
            with open_regular(file) as content:
                known = pq.read_metadata(content)
        except (OSError, pa.ArrowInvalid):
            return False
        told = known.metadata or {}
        ours = told.get(_STUDY) == self._work.digest.encode() and told.get(_TASK) == task
        return ours and known.num_rows == n_episodes

    def _join(self) -> None:
        scratch = self.table.with_name(f".{self.table.name}.part")
        schema = self._read(self._work.tasks[0]).schema
        try:
            with pq.ParquetWriter(scratch, schema) as writer:
                for task in self._work.tasks:
                    writer.write_table(self._read(task))
            # The table must be on disk before the parts are deleted, in case of a power failure.
            with scratch.open("rb") as file:
                os.fsync(file.fileno())
            placed = put(scratch, self.table, None)
        except OSError as error:
            raise StudyError(f"{self.table}: cannot be written: {error.strerror or error}") from error
        finally:
            scratch.unlink(missing_ok=True)
        if placed != self.table:
            raise StudyError(kept_both(self.table, placed))

    def _read(self, task: Shard) -> pa.Table:
        """Return a part; check that it has each of its episodes once."""
        file = self._part(task)
        try:
            # read_table would turn folders such as a=1 into columns.
            with pq.ParquetFile(file) as part:
                table = part.read()
            whole = table["episode"].to_pylist() == list(range(task.first, task.first + task.count))
        except (OSError, pa.ArrowException):
            table, whole = pa.table({}), False
        if not whole:
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
    for row in rows[:_MOST_ROWS]:
        means = [(name, row[f"{name}_mean"]) for name in measures]
        told = [f"{name} {mean:.4g}" for name, mean in means if mean is not None]
        yield "  ".join([row["playpen"], row["controller"], *told])
    if len(rows) > _MOST_ROWS:
        yield f"and {len(rows) - _MOST_ROWS} more"


def _json(file: Path) -> dict[str, object] | None:
    """Return the content of a file; None if there is no file."""
    try:
        found = json.loads(read_regular(file))
    except FileNotFoundError:
        return None
    except (OSError, ValueError):
        found = None
    if not isinstance(found, dict):
        raise StudyError(
            f"{file}: cannot be read, so the study of these results is unknown; expected a new folder"
        )
    return found  # pyright: ignore[reportUnknownVariableType]
