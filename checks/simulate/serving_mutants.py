"""Broken builds of a served pseudo-terminal."""

# The breaks replace private functions.
# pyright: reportPrivateUsage=false

from contextlib import AbstractContextManager
from itertools import groupby
from unittest.mock import patch

from checks.simulate.mutants import Mutant
from khep_twin.ports import pty, terminal_hosts
from khep_twin.ports.host_writes import Change
from khep_twin.ports.link import Link
from khep_twin.ports.pty import PtyPort
from khep_twin.ports.terminal_hosts import TerminalHosts
from khep_twin.robot import Robot


def _deaf_line() -> AbstractContextManager[object]:
    """Count hosts by events alone, equal ones in a row once, as khep_twin did before it asked the kernel."""

    def poll(hosts: TerminalHosts, wrote: bool) -> Change:
        assert hosts._events is not None
        events = [event for event, _ in groupby(hosts._drain(hosts._events))]
        hosts.hosts, change = terminal_hosts._followed(hosts.hosts, Change(), events)
        return change

    return patch.object(TerminalHosts, "poll", poll)


def _no_room() -> AbstractContextManager[object]:
    def write(port: PtyPort, data: bytes) -> None:
        pty.os.write(port.descriptor, data)
        port._given_s = pty.time.monotonic()

    return patch.object(PtyPort, "write", write)


def _link_left() -> AbstractContextManager[object]:
    def close(link: Link) -> None:
        link._forget()
        pty.os.close(link._lock)

    return patch.object(Link, "close", close)


MUTANTS: dict[str, Mutant] = {
    "a line is deaf after hosts came together": Mutant("serve", "answers", _deaf_line),
    "unread replies reach the next host": Mutant(
        "serve", "replies", lambda: patch.object(PtyPort, "_drop_replies", lambda port: 0)
    ),
    "what a host has begun to write stays on the line": Mutant(
        "serve", "replies", lambda: patch.object(Robot, "disconnect", lambda robot: None)
    ),
    "a host that never reads ends the server": Mutant("serve", "errors", _no_room),
    "a server leaves its link": Mutant("serve", "leftovers", _link_left),
    "a server leaves its terminal open": Mutant(
        "serve", "leftovers", lambda: patch.object(TerminalHosts, "close", lambda hosts: None)
    ),
}
