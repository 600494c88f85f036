"""Resynchronization of a line after a missing or malformed reply, and the wait for late replies.

A probe is sent: the first of the dialect's probes, such as `B`, `H`, `E`, `K`, without a pending reply. All
lines before its reply are late, and the last of them is the expected reply. If replies to all probes are
pending, the line must also be silent after the reply.

A machine that is busy replies late. Without a reply to the probe, the next one is sent until the line has
been silent for long enough, and a late reply is reported once.
"""

import threading
import warnings

from khep_twin.host.robot_port import RobotPort, decode_line

_REPLY_TIMEOUT_S = 1.0
"""Wait for a reply on a port without a timeout [s]; the robot replies within 10 ms."""

_PROBE_READS = 1, 2, 4, 8
"""Number of the port's timeouts for which each of consecutive probes waits."""


class Resynchronization:
    """Resynchronization of one line.

    Args:
        port: Port of the robot.
        probe_letters: Reads that resynchronize the line.
        stop_request: Event after which one silent read ends a resynchronization.

    Attributes:
        unanswered_letters: First letters of the requests whose replies may still come.
        versions_reply: Last reply to the probe B.
    """

    def __init__(self, port: RobotPort, probe_letters: str, stop_request: threading.Event) -> None:
        self._port = port
        self._probe_letters = probe_letters
        self._stop_request = stop_request
        self._has_reported_delay = False
        self.unanswered_letters: set[str] = set()
        self.versions_reply = ""

    def resynchronize(self, end: float = 0.0) -> list[str] | None:
        """Send probes until one synchronizes the line, the first in any case, others before `end`.

        Returns:
            The lines before the reply to the first probe; None without a reply.
        """
        lines: list[str] = []
        is_answered: bool | None = False
        fresh_letters = {*self._probe_letters} - self.unanswered_letters
        for n_reads in _PROBE_READS:
            is_answered = self._probe(lines, n_reads, end)
            if is_answered or is_answered is None or self._is_over(end):
                break
        if not is_answered:
            return None
        self.unanswered_letters.clear()
        # Without a probe of a fresh letter, no line is certainly a late reply.
        heads = tuple(f"{letter.lower()}," for letter in fresh_letters)
        return lines[: next((index for index, text in enumerate(lines) if text.startswith(heads)), 0)]

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

    def _probe(self, lines: list[str], n_reads: int, end: float) -> bool | None:
        """Send a probe, and append the lines up to its reply.

        Args:
            lines: Lines of this resynchronization.
            n_reads: Number of silent reads after which the probe has no reply.
            end: Time of the last silent read, if there are several [s].

        Returns:
            Whether the line is synchronized; None if it is never silent.
        """
        letters = self._probe_letters
        probe = next((letter for letter in letters if letter not in self.unanswered_letters), letters[0])
        # If replies to several probes are pending, the line is synchronized only when it is silent.
        is_ambiguous = probe in self.unanswered_letters and self._port.serial_port.timeout is not None
        self.unanswered_letters.add(probe)
        # The leading line feed ends an interrupted command.
        self._port.write(f"\n{probe}\n".encode("ascii"), probe)
        is_answered: bool | None = False
        for _ in range(n_reads):
            is_answered = self._read_lines(lines, probe, is_ambiguous)
            if is_answered or is_answered is None or self._is_over(end):
                break
        return is_answered

    def _is_over(self, end: float) -> bool:
        """Return whether no further silent read is awaited."""
        return self._port.timeout_time >= end or self._stop_request.is_set()

    def _read_lines(self, lines: list[str], probe: str, is_ambiguous: bool) -> bool | None:
        """Append lines up to a silent read, or to the reply of a probe that is not ambiguous.

        Returns:
            Whether the probe is answered; None without a silent read within the timeout.
        """
        end = self._port.timeout_time + (self._port.serial_port.timeout or _REPLY_TIMEOUT_S)
        is_answered = False
        while self._port.timeout_time <= end:
            line = self._port.read_line(probe)
            if not line.endswith(b"\n"):
                return is_answered
            lines.append(text := decode_line(line))
            if text.startswith(f"{probe.lower()},"):
                is_answered = True
                self.versions_reply = text if probe == "B" else self.versions_reply
                if not is_ambiguous:
                    return True
        return None
