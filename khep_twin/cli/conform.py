"""`khep-twin conform`: checks of the serial protocol."""

from pathlib import Path
from typing import Annotated

import typer

from khep_twin.cli.completion import logs, models, ports
from khep_twin.cli.option_groups import with_help
from khep_twin.cli.options import Force, check_new, refuse, usage
from khep_twin.errors import PortError
from khep_twin.files.atomic import unusable, write_atomic
from khep_twin.robots.registry import DEFAULT

_PORT_OPTIONS = {"move", "baudrate", "model"}
"""Options that do not apply to a log, by their parameters' names."""


@with_help
def conform(
    context: typer.Context,
    port: Annotated[str, typer.Argument(autocompletion=lambda: ports() + logs())],
    move: bool = False,
    model: Annotated[str, typer.Option(autocompletion=models)] = DEFAULT,
    baudrate: int | None = None,
    report: Path | None = None,
    force: Force = False,
) -> None:
    """Check that a robot speaks the protocol, at a port or in a log.

    The exit code is 1 if it does not.

    Args:
        port: Port of a robot or a twin, e.g. khep://default, or a log, FILE.mcap.
        move: Also run the checks that move the robot.
        model: Model of the robot, or its family, e.g. khepera.
        baudrate: Baud rate of the line; by default the usual one of the model.
        report: Also write the report to this JSON file.
    """
    if report is not None and (reason := unusable(report)):
        raise usage(f"--report {report}: cannot be written: {reason}")
    check_new(force, report)
    if "://" not in port and (port.endswith(".mcap") or Path(port).is_file()):
        from khep_twin.lab.conformance.recording.conform import conform_recording

        refuse(context, _PORT_OPTIONS, "a port, not for a log")
        outcome = conform_recording(Path(port))
    else:
        from khep_twin.lab.conformance.port.conform import checks
        from khep_twin.lab.conformance.port.conform import conform as check_port

        if move:
            movements = dict.fromkeys(check.moves for check in checks(True, model) if check.moves)
            typer.echo(f"the robot {', '.join(movements)}", err=True)
        try:
            outcome = check_port(port, move=move, baudrate=baudrate, model=model)
        except PortError as error:
            if error.key != "model":
                raise
            message = error.plain.removesuffix(str(error.expected))
            raise PortError(f"{message}--model {error.value}") from None
    typer.echo(outcome.text())
    if report is not None:
        write_atomic(report, outcome.json().encode("utf-8"), force)
    if not outcome.passed:
        raise typer.Exit(1)
