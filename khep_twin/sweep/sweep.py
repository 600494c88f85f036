"""Sweeps: all the lives of a study, here or on Ray, each result once.

    from khep_twin.sweep import study, sweep

    table = sweep.run_sweep(study.load(Path("noise.toml")))

Whoever does the tasks only gives bytes back; this process alone writes them down. So a task may be begun as
often as workers die, and what is missing is seen in the folder.
"""

from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path

from khep_twin.sweep.results import SweepFolder, encoded
from khep_twin.sweep.study import StudyFile
from khep_twin.sweep.task_lives import results
from khep_twin.sweep.tasks import Task, Work, work_of

Doers = Callable[[Work, Sequence[Task]], AbstractContextManager[Iterable[tuple[Task, bytes]]]]
"""Does tasks, in whichever order, and gives each one's results as soon as they are there."""


def here(threads: int | None = None) -> Doers:
    """One task after the other on this machine's cores.

    Args:
        threads: how many; None for as many as there are cores.
    """

    def done(work: Work, tasks: Sequence[Task]) -> Iterator[tuple[Task, bytes]]:
        for task in tasks:
            yield task, encoded(work, task, results(work, task, threads))

    return lambda work, tasks: nullcontext(done(work, tasks))


def run_sweep(
    file: StudyFile,
    *,
    output: Path | None = None,
    resume: bool = False,
    doers: Doers | None = None,
    begin: Callable[[Work, Sequence[Task]], None] | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> Path:
    """Goes through a study.

    Args:
        file: the study.
        output: where results go; without, as the study says.
        resume: goes on with what is there.
        doers: who does the tasks; without, this process's threads.
        begin: is told all the work, and which tasks are to be done.
        progress: is told how many lives of how many that were missing are there now.

    Returns:
        The path of the table of all results.

    Raises:
        StudyError: the study or the folder cannot be used.
        KhepTwinError: the lives cannot be led; what was done is kept.
    """
    place = (output or file.output).absolute()  # a program of the study may go to another folder
    work = work_of(file)
    folder = SweepFolder(place, work)
    with folder.opened(resume):
        missing = folder.missing()
        if begin is not None:
            begin(work, missing)
        if missing:
            total, done = sum(task.count for task in missing), 0
            with (doers or here())(work, missing) as coming:
                for task, data in coming:
                    folder.keep(task, data)
                    done += task.count
                    if progress is not None:
                        progress(done, total)
        return folder.finish()
