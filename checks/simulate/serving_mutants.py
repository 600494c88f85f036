"""Broken builds of a served pseudo-terminal."""

# The breaks replace private functions.
# pyright: reportPrivateUsage=false

from itertools import groupby

from checks.simulate.mutants import Mutant, nothing, replaced
from khep_twin.ports import pty, terminal_hosts
from khep_twin.ports.host_writes import Change
from khep_twin.ports.link import Link
from khep_twin.ports.pty import PtyPort
from khep_twin.ports.terminal_hosts import TerminalHosts
from khep_twin.robots.robot import Robot


def _poll_events_alone(hosts: TerminalHosts, _: bool) -> Change:
    """Count hosts by events alone, equal ones in a row once, as khep_twin did before it asked the kernel."""
    assert hosts._events is not None
    events = [event for event, _ in groupby(hosts._drain(hosts._events))]
    hosts.n_hosts, change = terminal_hosts._apply_events(hosts.n_hosts, Change(), events)
    return change


def _write_without_room(port: PtyPort, data: bytes) -> None:
    pty.os.write(port.descriptor, data)
    port._unread_write_s = pty.time.monotonic()


def _leave_link(link: Link) -> None:
    link._unregister()
    pty.os.close(link._lock)


MUTANTS: dict[str, Mutant] = {
    "a line is deaf after hosts came together": Mutant(
        "serve", "answers", replaced(TerminalHosts, poll=_poll_events_alone)
    ),
    "unread replies reach the next host": Mutant(
        "serve", "replies", replaced(PtyPort, _drop_replies=lambda port: 0)
    ),
    "what a host has begun to write stays on the line": Mutant(
        "serve", "replies", replaced(Robot, disconnect=nothing)
    ),
    "a host that never reads ends the server": Mutant(
        "serve", "errors", replaced(PtyPort, write=_write_without_room)
    ),
    "a server leaves its link": Mutant("serve", "leftovers", replaced(Link, close=_leave_link)),
    "a server leaves its terminal open": Mutant("serve", "leftovers", replaced(TerminalHosts, close=nothing)),
}
