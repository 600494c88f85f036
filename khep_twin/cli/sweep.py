"""`khep-twin sweep`: a study's episodes, here or on Ray, each result once in one Parquet table."""

import sys
import time
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from khep_twin.cli.completion import studies
from khep_twin.cli.options import complain, usage
from khep_twin.cli.progress import clock, progress
from khep_twin.cli.rollout import is_compiled
from khep_twin.invocation import command
from khep_twin.signals import clear_at_end

if TYPE_CHECKING:
    from khep_twin.sweep.shards import Shard, Work

SECONDS_BETWEEN_LINES = 60.0
"""Interval of progress lines without a terminal [s]."""


def sweep(
    study: Annotated[
        Path, typer.Argument(metavar="STUDY.toml", help="Study to run.", autocompletion=studies)
    ],
    ray: Annotated[
        bool, typer.Option("--ray", help="Run on Ray, in processes that may die; without, in threads.")
    ] = False,
    address: Annotated[
        str | None,
        typer.Option(
            metavar="HOST:PORT", help="Address of a running Ray cluster, or auto; without, this machine."
        ),
    ] = None,
    workers: Annotated[
        int | None, typer.Option(min=1, help="Threads, or Ray's workers on this machine; without, all cores.")
    ] = None,
    output: Annotated[
        Path | None, typer.Option("-o", "--output", help="Folder of the results; without, the study's.")
    ] = None,
    resume: Annotated[
        bool, typer.Option("--resume", help="Resume a sweep: run only what is missing.")
    ] = False,
    check: Annotated[bool, typer.Option("--check", help="Only check it, and count its episodes.")] = False,
) -> None:
    """Run all the episodes of a study.

    The results of each are kept once, in a Parquet table.
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
        told = f"{work.n_episodes} episodes of {file.study.seconds:g} s in {len(work.tasks)} tasks"
        typer.echo(f"{file.study.name}: {told}")
        return
    executor = run_locally(workers)
    if ray:
        from khep_twin.sweep.ray_workers import on_ray

        executor = on_ray(address, workers)
    is_compiled()
    warnings.simplefilter("ignore", SlowerWarning)  # once is enough

    def begin(work: "Work", missing: Sequence["Shard"]) -> None:
        n_episodes = sum(task.count for task in missing)
        there = f", {work.n_episodes - n_episodes} are there already" if n_episodes < work.n_episodes else ""
        typer.echo(f"{file.study.name}: {work.n_episodes} episodes in {len(work.tasks)} tasks{there}")

    def tell_again() -> None:
        complain(f"stopped; go on: {command(*_again(study, ray, address, workers, output))}")

    forget = clear_at_end(tell_again)
    try:
        with progress() as show:
            lines = _Lines()

            def show_progress(done: int, total: int) -> None:
                lines(done, total) if show is None else show(done / total)

            table = run_sweep(
                file, output=output, resume=resume, executor=executor, begin=begin, progress=show_progress
            )
    except KeyboardInterrupt:
        tell_again()
        raise typer.Exit(130) from None
    finally:
        forget()
    for line in summary(table):
        typer.echo(line)
    typed = (study.parent / file.study.output if output is None else output) / table.name
    typer.echo(f"results  {typed}      read it: pyarrow.parquet.read_table({str(typed)!r})")


def _check_address(address: str | None, ray: bool, workers: int | None) -> None:
    """Refuse an unusable address of a cluster."""
    if address is None:
        return
    if not ray:
        raise usage(f"--address {address}: is Ray's; expected --ray, too")
    if workers is not None:
        raise usage("--workers is for this machine; a cluster at --address has its own")
    if address != "auto":
        from khep_twin.sweep.ray_workers import host_and_port

        try:
            host_and_port(address)
        except ValueError as error:
            raise usage(f"--address {error}") from None


def _again(
    study: Path, ray: bool, address: str | None, workers: int | None, output: Path | None
) -> list[str]:
    """Return the words of the command that resumes a sweep."""
    words = ["sweep", str(study), "--resume", *(["--ray"] if ray else [])]
    for name, value in (("--address", address), ("--workers", workers), ("--output", output)):
        words += [] if value is None else [name, str(value)]
    return words


class _Lines:
    """Progress in lines, for output without a terminal."""

    def __init__(self) -> None:
        self._start = self._last = time.monotonic()

    def __call__(self, done: int, total: int) -> None:
        now = time.monotonic()
        if now - self._last < SECONDS_BETWEEN_LINES:
            return
        self._last = now
        left = clock((now - self._start) * (total - done) / done)
        print(f"{done} of {total} episodes, {left} left", file=sys.stderr)
