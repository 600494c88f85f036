"""`khep-twin ports`: ports of robots and twins."""

from typing import Annotated

import typer

from khep_twin.errors import PortError, PortInUse
from khep_twin.invocation import command


def ports(
    probe: Annotated[
        bool,
        typer.Option(
            "--probe", help="Ask at each port for a robot, at every speed; ports in use are left alone."
        ),
    ] = False,
) -> None:
    """List the ports at which a robot or a twin may be.

    These are what is served on this machine, and serial ports.
    """
    from khep_twin.host.discovery import found_ports

    found = found_ports()
    if not found:
        typer.echo(f"no ports; {command('serve')} makes one, khep://default needs none", err=True)
    width = max((len(port.url) for port in found), default=0)
    for port in found:
        typer.echo(f"{port.url:{width}}  {port.what}{_answer(port.url) if probe else ''}")


def _answer(url: str) -> str:
    from khep_twin.host.discovery import who_answers

    try:
        answer = who_answers(url)
    except PortInUse as error:
        return f": {str(error).removeprefix(f'{url}: ')}"
    except PortError as error:
        return f": {error}"
    if answer is None:
        return ": no answer"
    speed, versions = answer
    if versions.bios.isalpha():
        return f": Khepera IV, revision {''.join(versions)} at {speed} baud"
    return f": BIOS {versions.bios}, protocol {versions.protocol} at {speed} baud"
