"""Replay of a log's host bytes to another port at their times, and comparison of the replies.

It compares a twin with a robot, or twins with other parameters. The bytes are sent as recorded, whatever the
replies: the loop through the host is open.
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
from khep_twin.host import Khepera, Khepera4
from khep_twin.log.channels import TextLine
from khep_twin.log.decoding import DecodeError, shown
from khep_twin.log.recorded import Recorded
from khep_twin.log.transcript import text_of
from khep_twin.playpen import parse

MEASURED = {"n": "proximity", "o": "ambient light", "e": "speed", "h": "position", "r": "position"}
"""Letters of the replies whose values are compared one by one."""

_LAST_WAIT = 0.5
_SLICE = 0.01
_WINDOW = 8
"""Number of lost or additional replies beyond which two transcripts are out of step."""


@dataclass(frozen=True, slots=True)
class Letter:
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
        letters: Comparisons by the first letter of the replies.
        missing: Number of recorded replies without a counterpart.
        more: Number of replies without a counterpart in the log.
        first: First recorded reply that differs or is missing, and the reply instead.
    """

    robot: str
    letters: dict[str, Letter]
    missing: int
    more: int
    first: tuple[TextLine, str] | None

    @property
    def identical(self) -> bool:
        """True if every reply is the recorded one."""
        return self.first is None and not self.more

    def text(self) -> str:
        """Return the comparison as lines of text."""
        compared = sum(each.compared for each in self.letters.values())
        different = sum(each.different for each in self.letters.values())
        lines = [
            f"{self.robot}: {compared} replies compared, {different} differ, {self.missing} missing, "
            f"{self.more} more"
        ]
        for letter, each in sorted(self.letters.items()):
            lines.append(f"{letter}  {each.different} of {each.compared} differ")
            if each.differences.size:
                mean, largest = each.differences.mean(axis=0), np.abs(each.differences).max(axis=0)
                lines.append(f"   {MEASURED[letter]}: mean difference  {_row(mean, '.1f')}")
                lines.append(f"   {MEASURED[letter]}: largest          {_row(largest, '.0f')}")
        if self.first is not None:
            line, instead = self.first
            lines.append(
                f"first difference at {line.time_ns / NS_PER_S:.4f} s, /{self.robot}/serial: recorded "
                f"{line.text}, now {instead or 'nothing'}"
            )
        return "\n".join(lines)


def replay_to_port(
    recorded: Recorded, url: str, progress: Callable[[float], None] | None = None
) -> Comparison:
    """Send a log's host bytes to a port and compare the replies.

    Args:
        recorded: Recorded run; of several robots the first with a host is used.
        url: URL of the port.
        progress: Called with the completed part of the run, 0 to 1.

    Raises:
        LogError: The log has no bytes of a host.
        PortError: The port cannot be opened or was lost.
    """
    robots = {index for _, index, event in recorded.events if event.kind == HostEventKind.SEND}
    if not robots:
        made = recorded.label.metadata.get("khep_twin", "an unknown version")
        raise LogError(f"{recorded.path}: no host has sent anything in it, or it is too old (of {made})")
    robot = min(robots)
    events = [event for _, index, event in recorded.events if index == robot]
    lines = [line for line in recorded.lines[robot] if line.name == "robot"]
    last_ns = lines[-1].time_ns if lines else 0
    came = _send(events, url, _baud(recorded, events), _model(recorded, robot), last_ns, progress)
    return _compared(recorded.label.robots[robot], lines, came)


def _model(recorded: Recorded, robot: int) -> str:
    """Return the model of a robot; empty for that of a relay, which is a Khepera."""
    attachments = recorded.label.attachments
    if "playpen.toml" not in attachments:
        return ""
    return parse(attachments["playpen.toml"], "playpen.toml", recorded=True).robots[robot].model


def _baud(recorded: Recorded, events: Sequence[HostEvent]) -> int:
    """Return the host's baud rate at the start."""
    known = [event.host.baud for event in events if event.host is not None and event.host.baud]
    if known:
        return known[0]
    text = recorded.label.metadata.get("baud", "9600")
    if not re.fullmatch("[1-9][0-9]{0,8}", text):
        raise DecodeError(f"baud = {shown(text)}", "an integer").at(recorded.path, "metadata")
    return int(text)


def _send(
    events: Sequence[HostEvent],
    url: str,
    baud: int,
    model: str,
    last_ns: int,
    progress: Callable[[float], None] | None,
) -> list[str]:
    """Repeat the host events of a model's log at their times; return the replies."""
    came = b""
    # A robot that stays silent at the end is reported by the comparison.
    kind = Khepera4 if model == "khepera4" else Khepera
    with closing(kind(url, timeout=0, baudrate=baud)) as khepera:
        port = khepera.port
        # A simulated port loses nothing, and each read would take time.
        simulated = hasattr(port, "time_ns")
        start = khepera.time
        end = HostEvent(HostEventKind.DISCONNECT, max(last_ns, events[-1].at_ns) + int(_LAST_WAIT * NS_PER_S))
        try:
            for event in (*events, end):
                while (wait := event.at_ns / NS_PER_S - (khepera.time - start)) > 0:
                    khepera.sleep(wait if simulated else min(wait, _SLICE))
                    came += b"" if simulated else port.read(port.in_waiting)
                if event.kind == HostEventKind.SEND:
                    port.write(event.data)
                elif event.kind == HostEventKind.FLUSH:
                    port.reset_output_buffer()
                elif event.kind == HostEventKind.SET and event.host is not None and event.host.baud:
                    port.baudrate = event.host.baud
                if progress is not None:
                    progress(min(event.at_ns / end.at_ns, 1.0))
            came += port.read(max(port.in_waiting, 1))
        except PORT_FAILURES as error:
            raise PortError(f"{url}: the port failed: {error}") from error
    return [text_of(line) for line in re.split(rb"[\r\n]", came) if line]


def _compared(robot: str, recorded: Sequence[TextLine], came: Sequence[str]) -> Comparison:
    pairs, more = _paired(recorded, came)
    first = next(((line, text) for line, text in pairs if line.text != text), None)
    letters: dict[str, Letter] = {}
    for letter in sorted({line.text[:1] for line, text in pairs if text}):
        own = [(line.text, text) for line, text in pairs if text and line.text[:1] == letter]
        rows = [_difference(before, now) for before, now in own] if letter in MEASURED else []
        widths = [len(row) for row in rows if row]
        fitting = [row for row in rows if row and len(row) == max(widths)]
        different = sum(before != now for before, now in own)
        letters[letter] = Letter(len(own), different, np.array(fitting, np.float64))
    return Comparison(robot, letters, sum(not text for _, text in pairs), more, first)


def _paired(recorded: Sequence[TextLine], came: Sequence[str]) -> tuple[list[tuple[TextLine, str]], int]:
    """Return each recorded reply with its counterpart, empty for none, and the number of other replies."""
    pairs: list[tuple[TextLine, str]] = []
    place, more = 0, 0
    texts = [line.text for line in recorded]
    for index, line in enumerate(recorded):
        ahead = _nearest(line.text, came[place : place + _WINDOW])
        behind = _nearest(came[place], texts[index : index + _WINDOW]) if place < len(came) else None
        if ahead is None or (behind is not None and behind < ahead):
            pairs.append((line, ""))
            continue
        more += ahead
        pairs.append((line, came[place + ahead]))
        place += ahead + 1
    return pairs, more + len(came) - place


def _nearest(reply: str, others: Sequence[str]) -> int | None:
    """Return the index of the first reply with the same letter, None without."""
    return next((index for index, other in enumerate(others) if other[:1] == reply[:1]), None)


def _difference(before: str, now: str) -> list[int]:
    """Return the values of a reply less those recorded; empty if they do not match."""
    try:
        old, new = ([int(field) for field in text.split(",")[1:]] for text in (before, now))
    except ValueError:
        return []
    return [b - a for a, b in zip(old, new, strict=True)] if len(old) == len(new) else []


def _row(values: NDArray[np.float64], form: str) -> str:
    return " ".join(f"{value:7{form}}" for value in values)
