"""Discovery of robots and twins: this machine's serial ports, and what `khep-twin serve` offers on it."""

import time
from dataclasses import dataclass

from serial.tools import list_ports

from khep_twin.errors import PortError, PortInUse, PortTimeout
from khep_twin.host import commands
from khep_twin.host.opening import find_speed, open_port
from khep_twin.ports.port_users import port_user
from khep_twin.ports.service_registry import served

_WAIT = 0.3
"""Longest wait for an answer to B [s]."""


@dataclass(frozen=True, slots=True)
class FoundPort:
    """A port that can be opened.

    Attributes:
        url: URL that `Khepera` opens.
        what: Description of an adapter, or of a twin and its playpen.
        twin: True if a server of this project is behind it; of other ports that is unknown.
    """

    url: str
    what: str
    twin: bool


def found_ports() -> list[FoundPort]:
    """Return served twins first, then serial ports; no port is opened.

    Raises:
        PortError: The directory in which servers leave their notes is not this user's alone.
    """
    twins = [FoundPort(path, what, True) for path, what in served()]
    adapters = [
        # "n/a" is what pyserial calls a port of the machine's own.
        FoundPort(port.device, "serial port" if port.description == "n/a" else port.description, False)
        for port in sorted(list_ports.comports())
    ]
    return twins + adapters


def who_answers(url: str) -> tuple[int, commands.Versions] | None:
    """Ask a port for its robot's versions, at every speed of the line; the motors go on as they are.

    A port that another program has open is not touched: each would take half of the other's bytes.

    Returns:
        The speed [baud] and the versions; None if there is no answer.

    Raises:
        PortInUse: Another program has the port open.
        PortError: The port cannot be opened or fails.
    """
    if who := port_user(url):
        raise PortInUse(f"{url}: in use by {who}")
    port = open_port(url, 9600, _WAIT, exclusive=True)
    try:
        speed = find_speed(port, url, time.monotonic)
        port.write(b"B\n")
        return speed, commands.versions().read(port.read_until(b"\n", None).decode("latin-1").strip())
    except (PortTimeout, ValueError):
        return None
    except OSError as error:
        raise PortError(f"{url}: the port failed at 'B': {error}") from error
    finally:
        port.close()
