"""Discovery of robots and twins: the serial ports and served twins of this machine."""

import time
from dataclasses import dataclass

from serial.tools import list_ports

from khep_twin.errors import PortError, PortInUse, PortTimeout
from khep_twin.host.opening import find_baud_rate, open_port
from khep_twin.ports.port_users import port_user
from khep_twin.ports.service_registry import served_ports
from khep_twin.renamed import renamed_attribute
from khep_twin.robots.model import RobotModel
from khep_twin.robots.registry import find_replying_model

_TIMEOUT_S = 0.3
"""Longest wait for a reply to command B [s]."""


@dataclass(frozen=True, slots=True)
class FoundPort:
    """A port that can be opened.

    Attributes:
        url: URL that `Khepera` opens.
        description: Description of an adapter, or of a twin and its playpen.
        twin: True if the port is known to be served by this project.
    """

    url: str
    description: str
    twin: bool
    what = renamed_attribute("what", "description")


def found_ports() -> list[FoundPort]:
    """Return served twins first, then serial ports, without opening any.

    Raises:
        PortError: The directory of the servers' registry entries is accessible to other users.
    """
    twins = [FoundPort(path, description, twin=True) for path, description, _ in served_ports()]
    adapters = [
        # pyserial describes a built-in port as "n/a".
        FoundPort(port.device, "serial port" if port.description == "n/a" else port.description, twin=False)
        for port in sorted(list_ports.comports())
    ]
    return twins + adapters


def identify_robot(url: str) -> tuple[int, RobotModel, str] | None:
    """Request the identity of a port's robot at every baud rate, without an effect on its motors.

    A port that another program has open is not opened, as the programs would share its bytes.

    Returns:
        Baud rate, model and text of its reply; None without a reply.

    Raises:
        PortInUse: Another program has the port open.
        PortError: The port cannot be opened or fails.
    """
    if user := port_user(url):
        raise PortInUse(f"{url}: in use by {user}")
    port = open_port(url, 9600, _TIMEOUT_S, exclusive=True)
    try:
        baud_rate, reply = find_baud_rate(port, url, time.monotonic)
        model = find_replying_model(reply)
        return None if model is None else (baud_rate, model, reply)
    except PortTimeout:
        return None
    except OSError as error:
        raise PortError(f"{url}: the port failed at its identification: {error}") from error
    finally:
        port.close()
