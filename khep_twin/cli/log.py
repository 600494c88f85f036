"""`khep-twin recover` and `khep-twin repeat`: recovery of interrupted logs, and repeated runs."""

from pathlib import Path
from typing import Annotated

import typer

from khep_twin.cli.completion import logs, ports
from khep_twin.cli.option_groups import with_help
from khep_twin.cli.options import notify
from khep_twin.cli.progress import progress as progress_bar
from khep_twin.clock import NS_PER_S


def recover(
    log: Annotated[Path, typer.Argument(help="An interrupted log, NAME.mcap.part, or a damaged one.")],
) -> None:
    """Recover an interrupted log.

    The exit code is 0 if all of it was recovered, 3 if a part, 1 if nothing.
    """
    from khep_twin.log.recover import recover as rescue
    from khep_twin.log.recover import summary

    with progress_bar() as progress:
        recovery = rescue(log, progress)
    typer.echo(summary(log, recovery))
    typer.echo(f"log      {recovery.path}")
    if not recovery.is_complete:
        raise typer.Exit(3)


@with_help
def repeat(
    log: Annotated[Path, typer.Argument(autocompletion=logs)],
    port: Annotated[str | None, typer.Option(autocompletion=ports)] = None,
) -> None:
    """Repeat a log's run and compare.

    The exit code is 0 if it is the same, 3 if not, 1 if it cannot be repeated.

    Args:
        log: A log, FILE.mcap.
        port: Send the log's host bytes to this robot or twin instead, and compare its replies.
    """
    from khep_twin.lab.experiment.repeat import repeat as run_again
    from khep_twin.lab.experiment.repeat import require_states
    from khep_twin.log.recorded import read_recorded_run
    from khep_twin.log.run_description import version_differences

    recorded = read_recorded_run(log)
    if port is not None:
        from khep_twin.lab.experiment.replay_to_port import replay_to_port

        with progress_bar() as progress:
            comparison = replay_to_port(recorded, port, progress)
        typer.echo(comparison.text())
        if not comparison.is_identical:
            raise typer.Exit(3)
        return
    require_states(recorded)
    for line in version_differences(recorded.label):
        notify(line)
    with progress_bar() as progress:
        difference = run_again(recorded, progress)
    if difference is None:
        counts = f"{len(recorded.states)} states, {sum(map(len, recorded.lines))} lines"
        typer.echo(f"identical: {recorded.end_ns / NS_PER_S:.2f} s, {counts}")
        return
    typer.echo(f"different from {difference.time_ns / NS_PER_S:.4f} s on, {difference.channel}")
    typer.echo(f"recorded  {difference.recorded}")
    typer.echo(f"repeated  {difference.repeated}")
    raise typer.Exit(3)
