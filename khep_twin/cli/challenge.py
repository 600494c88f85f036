"""`khep-twin challenge COMMAND`: tasks with a score for controller files, and the results of a class."""

import sys
from codecs import getincrementaldecoder
from pathlib import Path
from typing import Annotated

import typer

from khep_twin.cli import completion
from khep_twin.cli.option_groups import with_help
from khep_twin.cli.options import (
    Force,
    check_new,
    check_picture,
    check_writable,
    command_group,
    notify,
    print_files,
    usage,
)
from khep_twin.cli.progress import progress as progress_bar
from khep_twin.errors import ControllerError
from khep_twin.files.atomic import write_atomic

challenge_app = command_group("Score controller files in challenges, one or a whole class.")

ChallengeName = Annotated[
    str,
    typer.Argument(
        metavar="NAME",
        help="Name of a shipped challenge, or path of a challenge file.",
        autocompletion=completion.challenges,
    ),
]
Runs = Annotated[
    int | None, typer.Option(min=1, max=1000, help="Number of runs; by default the challenge's.")
]
Seed = Annotated[
    int | None,
    typer.Option(min=0, help="Seed of the first run; run n has this + n - 1. By default the challenge's."),
]
_MAX_PRINTED_BYTES = 200_000
"""Largest number of bytes of a controller's output that are printed."""

RealSeconds = Annotated[
    float, typer.Option(min=1, max=86_400, help="Stop a file that runs longer than this real time [s].")
]


@challenge_app.command("list")
def list_challenges() -> None:
    """List the shipped challenges, one per line."""
    from khep_twin.lab.challenge.challenge import load, names

    challenge_names = names()
    for name in challenge_names:
        challenge = load(name).challenge
        typer.echo(f"{name:{max(map(len, challenge_names))}}  {challenge.title} ({challenge.reading})")


@challenge_app.command()
def show(
    name: ChallengeName,
    picture: Annotated[Path | None, typer.Option(help="Draw the challenge in this PNG file.")] = None,
    force: Force = False,
) -> None:
    """Print a challenge: task, playpen, scoring, and its files."""
    from khep_twin.lab.challenge.challenge import load

    if picture is not None and picture.suffix.lower() != ".png":
        raise usage(f"--picture {picture}: expected a name that ends in .png")
    check_picture(picture)
    check_new(force, picture)
    file = load(name)
    challenge = file.challenge
    typer.echo(f"{challenge.name}: {challenge.title}\n\n{challenge.description.strip()}\n")
    typer.echo(f"playpen    {challenge.playpen}, {challenge.length} from seed {challenge.seed}")
    typer.echo(f"score      {challenge.reading}")
    for penalty in challenge.penalties:
        typer.echo(f"penalty    {penalty.each:g} for each of {penalty.metric}")
    for goal in challenge.goals:
        goal_text = f"within {goal.radius_mm:g} mm of ({goal.x_mm:g}, {goal.y_mm:g})"
        typer.echo(
            f"goal       {goal_text}{'' if goal.lamp is None else f', if the lamp {goal.lamp} is on first'}"
        )
    for title, score in (("reference", challenge.reference), ("passed", challenge.threshold)):
        if score is not None:
            typer.echo(f"{title:9}  {challenge.value(score)}")
    for title, path in (("solution", file.solution), ("picture", file.picture)):
        if path.is_file() and (picture is None or title == "solution"):
            typer.echo(f"{title:9}  {path}")
    if picture is not None:
        from khep_twin.lab.challenge.picture import save

        save(file, picture, force)
        typer.echo(f"picture    {picture}")


@challenge_app.command()
@with_help
def run(
    name: ChallengeName,
    controller: Annotated[
        str | None, typer.Argument(metavar="FILE.py", autocompletion=completion.controllers)
    ] = None,
    runs: Runs = None,
    seed: Seed = None,
    log: Path | None = None,
    real_seconds: RealSeconds = 60.0,
    force: Force = False,
) -> None:
    """Score a controller in a challenge.

    The exit code is 4 if it does not pass.

    Args:
        controller: Controller, FILE.py[:NAME] or a network's FILE.npz; by default the reference solution.
        log: Record the run in this MCAP file; several in NAME-001.mcap and so on.
    """
    from khep_twin.lab.challenge.attempt import score_file
    from khep_twin.lab.challenge.challenge import load
    from khep_twin.lab.experiment.series_run import run_files

    file = load(name)
    challenge = file.challenge
    count = challenge.runs if runs is None else runs
    logs = [] if log is None else run_files(log, count)
    check_new(force, *logs)
    check_writable(*logs)
    if controller is None and not file.solution.is_file():
        raise usage(f"{name}: has no reference solution {file.solution}; expected a FILE.py to score")
    controller_spec = str(file.solution) if controller is None else controller
    printer = _OutputPrinter()
    attempt = score_file(
        file, controller_spec, runs=count, seed=seed, log=log, real_seconds=real_seconds, show=printer.show
    )
    printer.end()
    if attempt.score is None:
        raise ControllerError(attempt.reason)
    for number, value in enumerate(attempt.score.runs if count > 1 else (), 1):
        typer.echo(f"run {number:3}    {challenge.value(value)}")
    typer.echo(f"score      {challenge.value(attempt.score.value)}")
    if challenge.reference is not None:
        typer.echo(f"reference  {challenge.value(challenge.reference)}")
    passes = challenge.passes(attempt.score.value)
    if passes is not None:
        typer.echo(f"{'passed' if passes else 'failed'}     {challenge.passing_scores}")
    if logs:
        print_files("log", logs, width=9)
    if passes is False:
        raise typer.Exit(4)


@challenge_app.command()
def table(
    name: ChallengeName,
    folder: Annotated[Path, typer.Argument(metavar="FOLDER", help="Folder with a FILE.py per participant.")],
    output: Annotated[
        Path | None, typer.Option("--output", "-o", help="Also write the table to this CSV file.")
    ] = None,
    runs: Runs = None,
    seed: Seed = None,
    real_seconds: RealSeconds = 60.0,
    jobs: Annotated[
        int, typer.Option(min=1, max=256, help="Number of files scored in parallel; the table is the same.")
    ] = 1,
    force: Force = False,
) -> None:
    """Score every controller file in a folder, and print them by rank."""
    from khep_twin.lab.challenge.attempt import Attempt
    from khep_twin.lab.challenge.challenge import load
    from khep_twin.lab.challenge.results import participants, score_files, to_csv
    from khep_twin.lab.challenge.results import table as as_text

    file = load(name)
    files = participants(folder)
    check_new(force, output)
    check_writable(output)
    scored_attempts: list[Attempt] = []
    try:
        with progress_bar() as bar:

            def add(attempt: Attempt, share: float) -> None:
                scored_attempts.append(attempt)
                if bar is not None:
                    bar(share)

            score_files(
                file, files, runs=runs, seed=seed, real_seconds=real_seconds, jobs=jobs, on_result=add
            )
    finally:
        # If the command is stopped, print the scores so far.
        if scored_attempts:
            typer.echo(as_text(file.challenge, scored_attempts))
            if output is not None:
                write_atomic(output, to_csv(file.challenge, scored_attempts), force)
                typer.echo(f"table  {output}")


class _OutputPrinter:
    """Printer of a controller's output, in pieces that may end within a character."""

    def __init__(self) -> None:
        self._decoder = getincrementaldecoder("utf-8")("replace")
        self._in_line = False
        self._bytes_left = _MAX_PRINTED_BYTES

    def show(self, data: bytes, final: bool = False) -> None:
        """Print a piece, up to the largest number of bytes."""
        self._bytes_left, data = self._bytes_left - len(data), data[: max(self._bytes_left, 0)]
        if text := self._decoder.decode(data, final):
            self._in_line = not text.endswith("\n")
            sys.stdout.write(text)
            sys.stdout.flush()

    def end(self) -> None:
        """End the last line."""
        self.show(b"", final=True)
        if self._in_line:
            typer.echo()
        if self._bytes_left < 0:
            notify(f"{-self._bytes_left} more bytes that it printed are not shown")
