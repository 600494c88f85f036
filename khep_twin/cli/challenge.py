"""`khep-twin challenge COMMAND`: tasks with a score for controller files, and the results of a class."""

import sys
from codecs import getincrementaldecoder
from pathlib import Path
from typing import Annotated

import typer

from khep_twin.cli import completion
from khep_twin.cli.options import (
    Force,
    check_new,
    check_picture,
    check_writable,
    command_group,
    complain,
    tell_written,
    usage,
)
from khep_twin.cli.progress import progress as progress_bar

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
    int | None, typer.Option(min=1, max=1000, help="Number of runs; without, the challenge's own.")
]
Seed = Annotated[
    int | None,
    typer.Option(min=0, help="Seed of the first run, run n has this + n - 1; without, the challenge's."),
]
RealSeconds = Annotated[
    float, typer.Option(min=1, max=86_400, help="End a file after this real time [s], as one that hangs.")
]


@challenge_app.command("list")
def list_challenges() -> None:
    """List the shipped challenges, a line each."""
    from khep_twin.lab.challenge.challenge import load, names

    found = names()
    for name in found:
        challenge = load(name).challenge
        typer.echo(f"{name:{max(map(len, found))}}  {challenge.title} ({challenge.reading})")


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
        where = f"within {goal.radius_mm:g} mm of ({goal.x_mm:g}, {goal.y_mm:g})"
        typer.echo(
            f"goal       {where}{'' if goal.lamp is None else f', if the lamp {goal.lamp} is on first'}"
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
def run(
    name: ChallengeName,
    controller: Annotated[
        str | None,
        typer.Argument(
            metavar="FILE.py",
            help="Controller, FILE.py[:NAME] or a network's FILE.npz; without, the reference solution.",
            autocompletion=completion.controllers,
        ),
    ] = None,
    runs: Runs = None,
    seed: Seed = None,
    log: Annotated[
        Path | None,
        typer.Option(help="Record the run in this MCAP file; several runs in NAME-001.mcap and so on."),
    ] = None,
    real_seconds: RealSeconds = 60.0,
    force: Force = False,
) -> None:
    """Score a controller in a challenge.

    The exit code is 4 if it does not pass.
    """
    from khep_twin.errors import ControllerError
    from khep_twin.lab.challenge.attempt import score_file
    from khep_twin.lab.challenge.challenge import load
    from khep_twin.lab.experiment.series_run import own_files

    file = load(name)
    challenge = file.challenge
    count = challenge.runs if runs is None else runs
    logs = [] if log is None else own_files(log, count)
    check_new(force, *logs)
    check_writable(*logs)
    if controller is None and not file.solution.is_file():
        raise usage(f"{name}: has no reference solution {file.solution}; expected a FILE.py to score")
    typed = str(file.solution) if controller is None else controller
    printer = _Printer()
    found = score_file(
        file, typed, runs=count, seed=seed, log=log, real_seconds=real_seconds, show=printer.show
    )
    printer.end()
    if found.score is None:
        raise ControllerError(found.reason)
    for number, value in enumerate(found.score.runs if count > 1 else (), 1):
        typer.echo(f"run {number:3}    {challenge.value(value)}")
    typer.echo(f"score      {challenge.value(found.score.value)}")
    if challenge.reference is not None:
        typer.echo(f"reference  {challenge.value(challenge.reference)}")
    passes = challenge.passes(found.score.value)
    if passes is not None:
        typer.echo(f"{'passed' if passes else 'failed'}     {challenge.wanted}")
    if logs:
        tell_written("log", logs, width=9)
    if passes is False:
        raise typer.Exit(4)


@challenge_app.command()
def table(
    name: ChallengeName,
    folder: Annotated[Path, typer.Argument(metavar="FOLDER", help="Folder with a FILE.py per participant.")],
    output: Annotated[
        Path | None, typer.Option("--output", "-o", help="Write the table to this CSV file, too.")
    ] = None,
    runs: Runs = None,
    seed: Seed = None,
    real_seconds: RealSeconds = 60.0,
    jobs: Annotated[
        int, typer.Option(min=1, max=256, help="Score so many files side by side; the table is the same.")
    ] = 1,
    force: Force = False,
) -> None:
    """Score every controller file of a folder, and print them by rank."""
    from khep_twin.files.atomic import write_whole
    from khep_twin.lab.challenge.attempt import Attempt
    from khep_twin.lab.challenge.challenge import load
    from khep_twin.lab.challenge.results import attempts, participants, to_csv
    from khep_twin.lab.challenge.results import table as as_text

    file = load(name)
    files = participants(folder)
    check_new(force, output)
    check_writable(output)
    found: list[Attempt] = []
    try:
        with progress_bar() as bar:

            def done(each: Attempt, part: float) -> None:
                found.append(each)
                if bar is not None:
                    bar(part)

            attempts(file, files, runs=runs, seed=seed, real_seconds=real_seconds, jobs=jobs, done=done)
    finally:
        # Of a table that is stopped, there is what was found so far.
        if found:
            typer.echo(as_text(file.challenge, found))
            if output is not None:
                write_whole(output, to_csv(file.challenge, found), force)
                typer.echo(f"table  {output}")


_SHOWN = 200_000
"""Most bytes of what a controller prints that are shown."""


class _Printer:
    """Printer of what a controller prints, in pieces that may end within a character."""

    def __init__(self) -> None:
        self._decoder = getincrementaldecoder("utf-8")("replace")
        self._in_line = False
        self._left = _SHOWN

    def show(self, data: bytes, final: bool = False) -> None:
        """Print a piece, as long as it is not too much for a terminal."""
        self._left, data = self._left - len(data), data[: max(self._left, 0)]
        if text := self._decoder.decode(data, final):
            self._in_line = not text.endswith("\n")
            sys.stdout.write(text)
            sys.stdout.flush()

    def end(self) -> None:
        """End the last line."""
        self.show(b"", final=True)
        if self._in_line:
            typer.echo()
        if self._left < 0:
            complain(f"{-self._left} more bytes that it printed are not shown")
