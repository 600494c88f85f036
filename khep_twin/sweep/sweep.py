"""Sweeps: all episodes of a study, run here or on Ray, each stored once.

    from khep_twin.sweep import study, sweep

    table = sweep.run_sweep(study.load("noise.toml"))

Workers only return bytes; this process alone writes them. So a task may be repeated as often as workers die,
and the folder shows the missing tasks.
"""

from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path

from khep_twin.files.paths import StrPath
from khep_twin.sweep.results import SweepFolder, encoded
from khep_twin.sweep.run_shard import run_shard
from khep_twin.sweep.shards import Shard, Work, work_of
from khep_twin.sweep.study import StudyFile

Executor = Callable[[Work, Sequence[Shard]], AbstractContextManager[Iterable[tuple[Shard, bytes]]]]
"""Function that runs tasks, in any order, and yields the results of each as soon as they arrive."""


def run_locally(threads: int | None = None) -> Executor:
    """Return a function that runs one task after another on some threads, None for one per core."""

    def done(work: Work, tasks: Sequence[Shard]) -> Iterator[tuple[Shard, bytes]]:
        for task in tasks:
            yield task, encoded(work, task, run_shard(work, task, threads))

    return lambda work, tasks: nullcontext(done(work, tasks))


def run_sweep(
    file: StudyFile,
    *,
    output: StrPath | None = None,
    resume: bool = False,
    executor: Executor | None = None,
    begin: Callable[[Work, Sequence[Shard]], None] | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> Path:
    """Run a study.

    Args:
        file: Study.
        output: Folder of the results; by default the study's.
        resume: Whether to resume with the results in the folder.
        executor: Workers; by default this process's threads.
        begin: Called with all the work and the tasks to be run.
        progress: Called with the number of finished episodes and the number that were missing at the start.

    Returns:
        Path of the table of all results.

    Raises:
        StudyError: The study or the folder cannot be used.
        KhepTwinError: The episodes cannot be run; finished tasks are kept.
    """
    place = Path(output or file.output).absolute()  # a program of the study may change the working directory
    work = work_of(file)
    folder = SweepFolder(place, work)
    with folder.opened(resume):
        missing = folder.missing()
        if begin is not None:
            begin(work, missing)
        if missing:
            total, done = sum(task.count for task in missing), 0
            with (executor or run_locally())(work, missing) as coming:
                for task, data in coming:
                    folder.keep(task, data)
                    done += task.count
                    if progress is not None:
                        progress(done, total)
        return folder.finish()
