"""Replay of a log's host bytes to another port at their times, and comparison of the replies.

It compares a twin with a robot, or twins with other parameters. The bytes are sent as recorded and do not
depend on the replies: the control loop through the host is open.
"""

# pyserial is not typed.
# pyright: reportUnknownMemberType=false

import re
from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from khep_twin.board.uart import HostEvent, HostEventKind
from khep_twin.clock import NS_PER_S
from khep_twin.errors import PORT_FAILURES, LogError, PortError
from khep_twin.host.host_robot import open_robot
from khep_twin.log.channels import TextLine
from khep_twin.log.decoding import DecodeError, printable
from khep_twin.log.recorded import RecordedRun
from khep_twin.log.robot_models import models_of
from khep_twin.log.transcript import escape
from khep_twin.robots.model import RobotModel

QUANTITIES = {"n": "proximity", "o": "ambient light", "e": "speed", "h": "position", "r": "position"}
"""Quantities of the replies whose values are compared one by one, by letter."""

_LAST_WAIT_S, _SLICE_S = 0.5, 0.01
"""Waiting time for the last replies, and longest wait between two reads of a real port [s]."""
_SEARCH_WINDOW = 8
"""Number of replies within which the counterpart of a reply is searched."""


@dataclass(frozen=True, slots=True)
class LetterComparison:
    """Comparison of the replies to one command.

    Attributes:
        compared: Number of pairs.
        different: Number of pairs that differ.
        differences: Differences of the values, new less recorded (pairs, values); empty without values.
    """

    compared: int
    different: int
    differences: NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Comparison:
    """Comparison of a port's replies with those of a log.

    Attributes:
        robot: Name of the robot in the log.
        letters: Comparisons by the command of the replies, a letter of those that are lines.
        missing: Number of recorded replies without a counterpart.
        additional: Number of replies without a counterpart in the log.
        first_difference: First recorded reply that differs or is missing, and its counterpart or "".
    """

    robot: str
    letters: dict[str, LetterComparison]
    missing: int
    additional: int
    first_difference: tuple[TextLine, str] | None

    @property
    def is_identical(self) -> bool:
        """True if every reply equals the recorded one."""
        return self.first_difference is None and not self.additional

    def text(self) -> str:
        """Return the comparison as lines of text."""
        compared = sum(comparison.compared for comparison in self.letters.values())
        different = sum(comparison.different for comparison in self.letters.values())
        lines = [
            f"{self.robot}: {compared} replies compared, {different} differ, {self.missing} missing, "
            f"{self.additional} more"
        ]
        for letter, comparison in sorted(self.letters.items()):
            lines.append(f"{letter}  {comparison.different} of {comparison.compared} differ")
            if comparison.differences.size:
                mean = comparison.differences.mean(axis=0)
                largest = np.abs(comparison.differences).max(axis=0)
                lines.append(f"   {QUANTITIES[letter]}: mean difference  {_format_row(mean, '.1f')}")
                lines.append(f"   {QUANTITIES[letter]}: largest          {_format_row(largest, '.0f')}")
        if self.first_difference is not None:
            line, instead = self.first_difference
            lines.append(
                f"first difference at {line.time_ns / NS_PER_S:.4f} s, /{self.robot}/serial: recorded "
                f"{line.text}, now {instead or 'nothing'}"
            )
        return "\n".join(lines)


def replay_to_port(
    recorded: RecordedRun, url: str, progress: Callable[[float], None] | None = None
) -> Comparison:
    """Send a log's host bytes to a port and compare the replies.

    Args:
        recorded: Recorded run; of several robots, the first with a host is used.
        url: URL of the port.
        progress: Called with the completed share of the run, 0 to 1.

    Raises:
        LogError: The log has no bytes of a host.
        PortError: The port cannot be opened or was lost.
    """
    robots = {index for _, index, event in recorded.events if event.kind == HostEventKind.SEND}
    if not robots:
        version = recorded.label.metadata.get("khep_twin", "an unknown version")
        raise LogError(f"{recorded.path}: no host has sent anything in it, or it is too old (of {version})")
    robot = min(robots)
    events = [event for _, index, event in recorded.events if index == robot]
    lines = [line for line in recorded.lines[robot] if line.name == "robot"]
    last_ns = lines[-1].time_ns if lines else 0
    name = recorded.label.robots[robot]
    model = models_of(recorded.label.attachments, [name])[name]
    framing = model.dialect.framing
    received = _send(events, url, _baud(recorded, events), model, last_ns, progress)
    messages, rest = framing.split(received, to_robot=False)
    replies = [escape(framing.decode(message).encode("latin-1")) for message in (*messages, rest) if message]
    return _compare_replies(name, lines, replies, framing.command)


def _baud(recorded: RecordedRun, events: Sequence[HostEvent]) -> int:
    """Return the host's baud rate at the start."""
    rates = [event.host.baud for event in events if event.host is not None and event.host.baud]
    if rates:
        return rates[0]
    text = recorded.label.metadata.get("baud", "9600")
    if not re.fullmatch("[1-9][0-9]{0,8}", text):
        raise DecodeError(f"baud = {printable(text)}", "an integer").to_log_error(recorded.path, "metadata")
    return int(text)


def _send(
    events: Sequence[HostEvent],
    url: str,
    baud: int,
    model: RobotModel,
    last_ns: int,
    progress: Callable[[float], None] | None,
) -> bytes:
    """Repeat the host events at their times on a robot of this model; return the bytes of the replies."""
    received = b""
    # The comparison reports a robot that sends no last reply.
    with closing(open_robot(model, url, timeout=0, baudrate=baud)) as khepera:
        port = khepera.port
        # A simulated port loses no bytes, and each read would take simulated time.
        is_simulated = hasattr(port, "time_ns")
        start = khepera.time
        end_ns = max(last_ns, events[-1].at_ns) + int(_LAST_WAIT_S * NS_PER_S)
        end = HostEvent(HostEventKind.DISCONNECT, end_ns)
        try:
            for event in (*events, end):
                while (wait := event.at_ns / NS_PER_S - (khepera.time - start)) > 0:
                    khepera.sleep(wait if is_simulated else min(wait, _SLICE_S))
                    received += b"" if is_simulated else port.read(port.in_waiting)
                if event.kind == HostEventKind.SEND:
                    port.write(event.data)
                elif event.kind == HostEventKind.FLUSH:
                    port.reset_output_buffer()
                elif event.kind == HostEventKind.LINE_SETTINGS and event.host is not None and event.host.baud:
                    port.baudrate = event.host.baud
                if progress is not None:
                    progress(min(event.at_ns / end.at_ns, 1.0))
            received += port.read(max(port.in_waiting, 1))
        except PORT_FAILURES as error:
            raise PortError(f"{url}: the port failed: {error}") from error
    return received


def _compare_replies(
    robot: str, recorded: Sequence[TextLine], replies: Sequence[str], letter_of: Callable[[str], str]
) -> Comparison:
    """Return the comparison of a robot's replies with the recorded ones."""
    pairs, n_additional = _align(recorded, replies, letter_of)
    first_difference = next(((line, text) for line, text in pairs if line.text != text), None)
    letters: dict[str, LetterComparison] = {}
    for letter in sorted({letter_of(line.text) for line, text in pairs if text}):
        texts = [(line.text, text) for line, text in pairs if text and letter_of(line.text) == letter]
        rows = [_subtract(old, text) for old, text in texts] if letter in QUANTITIES else []
        widths = [len(row) for row in rows if row]
        complete_rows = [row for row in rows if row and len(row) == max(widths)]
        different = sum(old != text for old, text in texts)
        letters[letter] = LetterComparison(len(texts), different, np.array(complete_rows, np.float64))
    return Comparison(robot, letters, sum(not text for _, text in pairs), n_additional, first_difference)


def _align(
    recorded: Sequence[TextLine], replies: Sequence[str], letter_of: Callable[[str], str]
) -> tuple[list[tuple[TextLine, str]], int]:
    """Return each recorded reply with its counterpart or an empty text, and the number of other replies."""
    pairs: list[tuple[TextLine, str]] = []
    reply_index, n_additional = 0, 0
    old_letters = [letter_of(line.text) for line in recorded]
    new_letters = [letter_of(reply) for reply in replies]
    for index, line in enumerate(recorded):
        n_skipped = _find(old_letters[index], new_letters[reply_index : reply_index + _SEARCH_WINDOW])
        n_missing = None
        if reply_index < len(replies):
            n_missing = _find(new_letters[reply_index], old_letters[index : index + _SEARCH_WINDOW])
        if n_skipped is None or (n_missing is not None and n_missing < n_skipped):
            pairs.append((line, ""))
            continue
        n_additional += n_skipped
        pairs.append((line, replies[reply_index + n_skipped]))
        reply_index += n_skipped + 1
    return pairs, n_additional + len(replies) - reply_index


def _find(letter: str, letters: Sequence[str]) -> int | None:
    """Return the index of a letter; None if it is not there."""
    return letters.index(letter) if letter in letters else None


def _subtract(recorded: str, reply: str) -> list[int]:
    """Return the values of a reply less the recorded ones; empty if their numbers differ."""
    try:
        old, new = ([int(field) for field in text.split(",")[1:]] for text in (recorded, reply))
    except ValueError:
        return []
    return [b - a for a, b in zip(old, new, strict=True)] if len(old) == len(new) else []


def _format_row(values: NDArray[np.float64], form: str) -> str:
    return " ".join(f"{value:7{form}}" for value in values)
