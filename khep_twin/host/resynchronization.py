"""Resynchronization of a line after a missing or malformed reply, and the wait for late replies.

A probe is sent: the first of the dialect's probes (`B`, `H`, `E`, `K` of a Khepera) without a pending reply.
All replies before its reply are late, and the last of them is the expected reply. If replies to all probes
are pending, the line must also be silent after the reply.

A machine that is busy replies late. Without a reply to the probe, the next one is sent until the line has
been silent for long enough, and a late reply is reported once.
"""

import threading
import warnings
from collections.abc import Sequence

from khep_twin.host.robot_port import RobotPort

_REPLY_TIMEOUT_S = 1.0
"""Wait for a reply on a port without a timeout [s]; the robot replies within 10 ms."""

_PROBE_READS = 1, 2, 4, 8
"""Number of the port's timeouts for which each of consecutive probes waits."""


class Resynchronization:
    """Resynchronization of one line.

    Args:
        port: Port of the robot.
        probes: Reads that resynchronize the line.
        stop_request: Event after which one silent read ends a resynchronization.

    Attributes:
        unanswered: Commands whose replies may still come.
        versions_reply: Last reply to the first probe.
    """

    def __init__(self, port: RobotPort, probes: Sequence[str], stop_request: threading.Event) -> None:
        self._port = port
        self._framing = port.framing
        self._probes = probes
        self._stop_request = stop_request
        self._has_reported_delay = False
        self.unanswered: set[str] = set()
        self.versions_reply = ""

    def resynchronize(self, end: float = 0.0) -> list[str] | None:
        """Send probes until one synchronizes the line, the first in any case, others before `end`.

        Returns:
            The replies before that to the first probe; None without a reply.
        """
        replies: list[str] = []
        is_answered: bool | None = False
        fresh_probes = self._fresh_probes()
        for n_reads in _PROBE_READS:
            is_answered = self._probe(replies, n_reads, end)
            if is_answered or is_answered is None or self._is_over(end):
                break
        if not is_answered:
            return None
        self.unanswered.clear()
        # Without a fresh probe, no reply is certainly late.
        probe_indices = (
            index
            for index, reply in enumerate(replies)
            if any(self._framing.answers(probe, reply) for probe in fresh_probes)
        )
        return replies[: next(probe_indices, 0)]

    def report_delay(self, request: str, delay: float) -> None:
        """Warn, once, of a reply that came late."""
        # A twin in this process is late only by a fault.
        if not self._has_reported_delay and self._port.model is None:
            self._has_reported_delay = True
            warnings.warn(
                f"{self._port.name}: the reply to {request!r} took {delay:.1f} s; expected at most "
                f"{self._port.serial_port.timeout:.2g} s: the twin's machine or the line is busy",
                stacklevel=5,
            )

    def _fresh_probes(self) -> list[str]:
        """Return the probes without a pending reply."""
        return [probe for probe in self._probes if self._framing.command(probe) not in self.unanswered]

    def _probe(self, replies: list[str], n_reads: int, end: float) -> bool | None:
        """Send a probe, and append the replies up to the one to it.

        Args:
            replies: Replies of this resynchronization.
            n_reads: Number of silent reads after which the probe has no reply.
            end: Time of the last silent read, if there are several [s].

        Returns:
            Whether the line is synchronized; None if it is never silent.
        """
        fresh_probes = self._fresh_probes()
        probe = fresh_probes[0] if fresh_probes else self._probes[0]
        # If replies to several probes are pending, the line is synchronized only when it is silent.
        is_ambiguous = not fresh_probes and self._port.serial_port.timeout is not None
        self.unanswered.add(self._framing.command(probe))
        self._port.send([probe], resync=True)
        is_answered: bool | None = False
        for _ in range(n_reads):
            is_answered = self._read_replies(replies, probe, is_ambiguous)
            if is_answered or is_answered is None or self._is_over(end):
                break
        return is_answered

    def _is_over(self, end: float) -> bool:
        """Return whether no further silent read is awaited."""
        return self._port.timeout_time >= end or self._stop_request.is_set()

    def _read_replies(self, replies: list[str], probe: str, is_ambiguous: bool) -> bool | None:
        """Append replies up to a silent read, or to the reply of a probe that is not ambiguous.

        Returns:
            Whether the probe is answered; None without a silent read within the timeout.
        """
        end = self._port.timeout_time + (self._port.serial_port.timeout or _REPLY_TIMEOUT_S)
        is_answered = False
        while self._port.timeout_time <= end:
            reply, _ = self._port.read_reply(probe)
            if reply is None:
                return is_answered
            replies.append(reply)
            if self._framing.answers(probe, reply):
                is_answered = True
                self.versions_reply = reply if probe == self._probes[0] else self.versions_reply
                if not is_ambiguous:
                    return True
        return None
