"""Session on a Zenoh network with the settings of rmw_zenoh, without scouting by multicast."""

# The stubs of eclipse-zenoh have no types of results.
# pyright: reportUnknownMemberType=false

import json
import os
from enum import StrEnum

from khep_twin.errors import KhepTwinError, MissingExtraError, PortError

try:
    import zenoh
except ImportError as error:
    raise MissingExtraError("eclipse-zenoh", "ros") from error

_OPEN_TIMEOUT_MS = 3000
"""Longest wait for a router that accepts the connection but does not reply [ms]."""

_RETRY = {"period_init_ms": 200, "period_max_ms": 2000, "period_increase_factor": 2}
"""Periods of attempts to connect to a router that has gone."""

_MAX_DOMAIN = 232
"""Largest domain of ROS."""


class SessionMode(StrEnum):
    """Part of a session in the Zenoh network.

    A client only connects to a router. A peer has the settings of the nodes of ROS: it also listens on the
    loopback interface, and waits for the router. Other nodes connect to a router.
    """

    CLIENT = "client"
    PEER = "peer"
    ROUTER = "router"


def open_session(mode: SessionMode, router: str | None) -> tuple[zenoh.Session, str]:
    """Return a session, and the address "host:port" of its router, by default with ROS's port.

    Raises:
        PortError: No router replies, or the address cannot be used.
        KhepTwinError: A variable of the environment cannot be used.
    """
    address = router or f"{'127.0.0.1' if mode is SessionMode.ROUTER else 'localhost'}:7447"
    variable = f"ZENOH_{'ROUTER' if mode is SessionMode.ROUTER else 'SESSION'}_CONFIG_URI"
    path = os.environ.get(variable, "")
    config = _read_config(variable, path) if path and router is None else _make_config(mode, address)
    config.insert_json5("timestamping/enabled", "true")  # which latched topics need
    _override(config, os.environ.get("ZENOH_CONFIG_OVERRIDE", ""))
    return _open(config, mode, address), address


def domain_of_environment() -> int:
    """Return the domain of `ROS_DOMAIN_ID`, by default 0.

    Raises:
        KhepTwinError: The variable is no number of a domain.
    """
    text = os.environ.get("ROS_DOMAIN_ID", "") or "0"
    if not (text.isascii() and text.isdigit() and int(text) <= _MAX_DOMAIN):
        raise KhepTwinError(f"ROS_DOMAIN_ID={text}: expected an integer from 0 to {_MAX_DOMAIN}")
    return int(text)


def _read_config(variable: str, path: str) -> zenoh.Config:
    try:
        return zenoh.Config.from_file(path)
    except zenoh.ZError as error:
        text = f"{variable}={path}: {_reason(error)}; expected a configuration of Zenoh"
        raise KhepTwinError(text) from None


def _make_config(mode: SessionMode, address: str) -> zenoh.Config:
    endpoint = json.dumps([_endpoint(address)])
    connections = {
        SessionMode.CLIENT: {"connect/endpoints": endpoint, "listen/endpoints": "[]"},
        SessionMode.PEER: {"connect/endpoints": endpoint, "listen/endpoints": '["tcp/localhost:0"]'},
        SessionMode.ROUTER: {"connect/endpoints": "[]", "listen/endpoints": endpoint, "scouting/delay": "0"},
    }
    values = {
        "mode": json.dumps(mode),
        "scouting/multicast/enabled": "false",
        "transport/unicast/open_timeout": str(_OPEN_TIMEOUT_MS),
        "connect/retry": json.dumps(_RETRY),
        **connections[mode],
    }
    config = zenoh.Config()
    for key, value in values.items():
        config.insert_json5(key, value)
    return config


def _override(config: zenoh.Config, overrides: str) -> None:
    """Set values of a configuration by the text of `ZENOH_CONFIG_OVERRIDE`."""
    for override in filter(None, map(str.strip, overrides.split(";"))):
        key, _, value = override.partition("=")
        try:
            config.insert_json5(key.strip(), value.strip())
        except zenoh.ZError as error:
            text = f"ZENOH_CONFIG_OVERRIDE: {override}: {_reason(error)}; expected path/of/key=value;..."
            raise KhepTwinError(text) from None


def _endpoint(address: str) -> str:
    """Return Zenoh's form of an address "host:port"; one in Zenoh's form is unchanged.

    Raises:
        PortError: The address has no port.
    """
    if "/" in address:
        return address
    host, _, port = address.rpartition(":")
    if not host or not (port.isascii() and port.isdigit() and 0 < int(port) < 2**16):
        raise PortError(f"{address}: no address of a router; expected HOST:PORT, as in localhost:7447")
    return f"tcp/{address}"


def _open(config: zenoh.Config, mode: SessionMode, router: str) -> zenoh.Session:
    try:
        return zenoh.open(config)
    except zenoh.ZError as error:
        if "Address already in use" in str(error):
            text = f"{router}: in use; expected a free address"
            raise PortError(text, ", or no --be-router if that is the router") from None
        if mode is SessionMode.CLIENT and "Unable to connect" in str(error):
            text = f"{router}: no Zenoh router; expected one, started by 'ros2 run rmw_zenoh_cpp rmw_zenohd'"
            raise PortError(text, " or --be-router") from None
        raise PortError(f"{router}: Zenoh cannot be opened: {_reason(error)}") from None


def _reason(error: Exception) -> str:
    """Return the reason in an error of Zenoh, without the lines of its source."""
    return " ".join(str(error).partition(" at /")[0].split())
