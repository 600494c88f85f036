"""`khep-twin sweep`: a study's episodes, run locally or on Ray, in one Parquet table."""

import sys
import time
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from khep_twin.cli.completion import studies
from khep_twin.cli.option_groups import with_help
from khep_twin.cli.options import notify, usage
from khep_twin.cli.progress import duration_text, progress
from khep_twin.cli.rollout import check_compiled
from khep_twin.process.invocation import command
from khep_twin.process.signals import register_cleanup

if TYPE_CHECKING:
    from khep_twin.sweep.shards import Shard, Work

SECONDS_BETWEEN_LINES = 60.0
"""Interval of progress lines if there is no terminal [s]."""


@with_help
def sweep(
    study: Annotated[Path, typer.Argument(metavar="STUDY.toml", autocompletion=studies)],
    ray: bool = False,
    address: Annotated[str | None, typer.Option(metavar="HOST:PORT")] = None,
    workers: Annotated[int | None, typer.Option(min=1)] = None,
    output: Annotated[Path | None, typer.Option("-o", "--output")] = None,
    resume: bool = False,
    check: bool = False,
) -> None:
    """Run all episodes of a study.

    The results are stored in a Parquet table, one row per episode.

    Args:
        study: Study to run.
        ray: Run on Ray, in processes that may die; by default in threads.
        address: Address of a running Ray cluster, or auto; by default this machine.
        workers: Threads, or Ray workers here; by default one per core.
        output: Folder of the results; by default the study's.
        resume: Resume a sweep: run only missing tasks.
        check: Only check the study, and count episodes.
    """
    from khep_twin.episodes.episode import SlowerWarning
    from khep_twin.sweep import study as studies
    from khep_twin.sweep.results import summary
    from khep_twin.sweep.shards import work_of
    from khep_twin.sweep.sweep import run_locally, run_sweep

    _check_address(address, ray, workers)
    file = studies.load(study)
    if check:
        work = work_of(file)
        seconds = " or ".join(f"{seconds:g}" for seconds in file.study.values("seconds"))
        counts = f"{work.n_episodes} episodes of {seconds} s in {len(work.tasks)} tasks"
        typer.echo(f"{file.study.name}: {counts}")
        return
    executor = run_locally(workers)
    if ray:
        from khep_twin.sweep.ray_workers import on_ray

        executor = on_ray(address, workers)
    check_compiled()
    warnings.simplefilter("ignore", SlowerWarning)  # is_compiled has reported it

    def on_start(work: "Work", missing: Sequence["Shard"]) -> None:
        n_missing = sum(task.count for task in missing)
        saved = f", {work.n_episodes - n_missing} are there already" if n_missing < work.n_episodes else ""
        typer.echo(f"{file.study.name}: {work.n_episodes} episodes in {len(work.tasks)} tasks{saved}")

    def print_resume() -> None:
        notify(f"stopped; resume: {command(*_resume_command(study, ray, address, workers, output))}")

    unregister = register_cleanup(print_resume)
    try:
        with progress() as show:
            print_progress = _ProgressLines()

            def show_progress(n_done: int, total: int) -> None:
                print_progress(n_done, total) if show is None else show(n_done / total)

            table = run_sweep(
                file, output=output, resume=resume, executor=executor, begin=on_start, progress=show_progress
            )
    except KeyboardInterrupt:
        print_resume()
        raise typer.Exit(130) from None
    finally:
        unregister()
    for line in summary(table):
        typer.echo(line)
    table_path = (study.parent / file.study.output if output is None else output) / table.name
    typer.echo(f"results  {table_path}      read it: pyarrow.parquet.read_table({str(table_path)!r})")


def _check_address(address: str | None, ray: bool, workers: int | None) -> None:
    """Refuse an unusable address of a cluster."""
    if address is None:
        return
    if not ray:
        raise usage(f"--address {address}: is Ray's; expected --ray with it")
    if workers is not None:
        raise usage("--workers is for this machine; expected none, as a cluster has its own")
    if address != "auto":
        from khep_twin.sweep.ray_workers import host_and_port

        try:
            host_and_port(address)
        except ValueError as error:
            raise usage(f"--address {error}") from None


def _resume_command(
    study: Path, ray: bool, address: str | None, workers: int | None, output: Path | None
) -> list[str]:
    """Return the arguments of the command that resumes a sweep."""
    arguments = ["sweep", str(study), "--resume", *(["--ray"] if ray else [])]
    for name, value in (("--address", address), ("--workers", workers), ("--output", output)):
        arguments += [] if value is None else [name, str(value)]
    return arguments


class _ProgressLines:
    """Progress as lines, for output without a terminal."""

    def __init__(self) -> None:
        self._start_s = self._last_line_s = time.monotonic()

    def __call__(self, n_done: int, total: int) -> None:
        now = time.monotonic()
        if now - self._last_line_s < SECONDS_BETWEEN_LINES:
            return
        self._last_line_s = now
        time_left = duration_text((now - self._start_s) * (total - n_done) / n_done)
        print(f"{n_done} of {total} episodes, {time_left} left", file=sys.stderr)
