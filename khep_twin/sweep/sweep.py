"""Sweeps: all episodes of a study, run locally or on Ray, each stored once.

    from khep_twin.sweep import study, sweep

    table = sweep.run_sweep(study.load("noise.toml"))

Workers return bytes, and only this process writes them. So a task may be repeated when a worker dies, and the
folder shows the missing tasks.
"""

from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path

from khep_twin.files.paths import StrPath
from khep_twin.sweep.results import SweepFolder, encode_part
from khep_twin.sweep.run_shard import run_shard
from khep_twin.sweep.shards import Shard, Work, work_of
from khep_twin.sweep.study import StudyFile

Executor = Callable[[Work, Sequence[Shard]], AbstractContextManager[Iterable[tuple[Shard, bytes]]]]
"""Function that runs tasks, in any order, and yields each result as soon as it arrives."""


def run_locally(threads: int | None = None) -> Executor:
    """Return a function that runs tasks one by one on this number of threads; None for one per core."""

    def run_tasks(work: Work, tasks: Sequence[Shard]) -> Iterator[tuple[Shard, bytes]]:
        for task in tasks:
            yield task, encode_part(work, task, run_shard(work, task, threads))

    return lambda work, tasks: nullcontext(run_tasks(work, tasks))


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
        progress: Called with the numbers of episodes finished, and missing at the start.

    Returns:
        Path of the table of all results.

    Raises:
        StudyError: The study or the folder cannot be used.
        KhepTwinError: The episodes cannot be run; finished tasks are kept.
    """
    output_path = Path(output or file.output).absolute()  # programs may change the working directory
    work = work_of(file)
    folder = SweepFolder(output_path, work)
    with folder.open(resume):
        missing = folder.missing()
        if begin is not None:
            begin(work, missing)
        if missing:
            total, n_done = sum(task.count for task in missing), 0
            with (executor or run_locally())(work, missing) as results:
                for task, data in results:
                    folder.save(task, data)
                    n_done += task.count
                    if progress is not None:
                        progress(n_done, total)
        return folder.finish()
