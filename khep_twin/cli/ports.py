"""`khep-twin ports`: the ports of robots and twins."""

import typer

from khep_twin.cli.option_groups import with_help
from khep_twin.errors import PortError, PortInUse
from khep_twin.process.invocation import command
from khep_twin.robots.registry import default_model


@with_help
def ports(
    probe: bool = False,
) -> None:
    """List the ports of robots and twins.

    These are services of khep-twin on this machine, and serial ports.

    Args:
        probe: Query each port for a robot at every baud rate, except for ports in use.
    """
    from khep_twin.host.discovery import found_ports

    known_ports = found_ports()
    if not known_ports:
        typer.echo(f"no ports; {command('serve')} makes one, khep://default needs none", err=True)
    width = max((len(port.url) for port in known_ports), default=0)
    for port in known_ports:
        typer.echo(f"{port.url:{width}}  {port.description}{_describe_robot(port.url) if probe else ''}")


def _describe_robot(url: str) -> str:
    """Return the model and versions of the robot at a port, or why it does not answer, as text."""
    from khep_twin.host.commands import versions
    from khep_twin.host.discovery import identify_robot

    try:
        identity = identify_robot(url)
    except PortInUse as error:
        return f": {str(error).removeprefix(f'{url}: ')}"
    except PortError as error:
        return f": {error}"
    if identity is None:
        return ": no answer"
    baud, model, reply = identity
    if model.family == default_model().family:
        bios, protocol = versions().read(reply)
        return f": BIOS {bios}, protocol {protocol} at {baud} baud"
    return f": {model.title}, {reply} at {baud} baud"
