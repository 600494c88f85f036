"""Transcript of serial lines: received bytes, written as complete lines in the order of their ends."""

from bisect import bisect_right
from collections.abc import Iterable, Mapping
from operator import itemgetter
from typing import Protocol

from khep_twin.clock import NEVER_NS
from khep_twin.log.channels import Level, LineFrame
from khep_twin.robots.framing import Framing

_LINE_LIMIT = 1024
_PRINTABLE = bytes(code for code in range(0x20, 0x7F) if code != ord("\\"))
_FRAMES = {to_robot: LineFrame("host" if to_robot else "robot", Level.INFO) for to_robot in (True, False)}


_Line = tuple[int, int, bool, bytes]
"""Time of its end [ns], robot, whether to the robot, and bytes of a line."""


class LineSink(Protocol):
    """Destination of lines, e.g. a `LogFile`."""

    def add_lines(self, topic: str, times_ns: list[int], messages: list[bytes]) -> None:
        """Add lines of one robot."""


class Transcript:
    """Transcript of the lines to and from one or more robots, by their names, with their framings."""

    def __init__(self, log: LineSink, robots: Mapping[str, Framing]) -> None:
        self._log = log
        self._robots = list(robots)
        self._framings = list(robots.values())
        self._received: list[_Line] = []
        self._early_lines: list[_Line] = []
        self._partial_lines: dict[tuple[int, bool], bytes] = {}

    @property
    def partial_lines(self) -> tuple[tuple[int, bool, bytes], ...]:
        """Bytes of incomplete lines after the last `write`: robot, whether to the robot, bytes."""
        return tuple((*key, partial_line) for key, partial_line in sorted(self._partial_lines.items()))

    @property
    def early_lines(self) -> tuple[_Line, ...]:
        """Lines later than the last `write`: time of the end [ns], robot, whether to the robot, bytes."""
        return tuple(self._early_lines)

    def resume(self, partial_lines: Iterable[tuple[int, bool, bytes]], early_lines: Iterable[_Line]) -> None:
        """Resume with incomplete and early lines, as another transcript returns them."""
        self._partial_lines = {(robot, to_robot): line for robot, to_robot, line in partial_lines}
        self._early_lines = list(early_lines)

    def on_bytes(self, time_ns: int, robot: int, to_robot: bool, data: bytes) -> None:
        """Record bytes for the next `write`."""
        self._received.append((time_ns, robot, to_robot, data))

    def write(self, end_ns: int = NEVER_NS) -> None:
        """Write the lines that the recorded bytes complete until a time [ns], in order of time.

        A reply is recorded when its transmission starts, and may end after the host's next line.
        """
        lines = self._early_lines + self._take_lines()
        lines.sort(key=itemgetter(0))
        n_due = bisect_right(lines, end_ns, key=itemgetter(0))
        self._early_lines = lines[n_due:]
        messages_by_robot: list[tuple[list[int], list[bytes]]] = [([], []) for _ in self._robots]
        for time_ns, robot, to_robot, line in lines[:n_due]:
            times_ns, messages = messages_by_robot[robot]
            times_ns.append(time_ns)
            messages.append(_encode_line(time_ns, to_robot, line))
        for robot, (times_ns, messages) in enumerate(messages_by_robot):
            if messages:
                self._log.add_lines(f"/{self._robots[robot]}/serial", times_ns, messages)

    def finish(self, time_ns: int) -> None:
        """Write all lines, and incomplete ones as lines that end at a time [ns]."""
        self._early_lines += self._take_lines()
        self._early_lines += [
            self._line(time_ns, robot, to_robot, data) for robot, to_robot, data in self.partial_lines
        ]
        self.write()

    def _take_lines(self) -> list[_Line]:
        """Return the lines that the recorded bytes complete."""
        complete_lines: list[_Line] = []
        received, self._received = self._received, []
        for time_ns, robot, to_robot, data in received:
            text = self._partial_lines.pop((robot, to_robot), b"") + data if self._partial_lines else data
            framing = self._framings[robot]
            lines, rest = framing.split(text, to_robot)
            # A line beyond the limit is noise, or comes from a host that sends no line ends.
            if len(rest) > _LINE_LIMIT:
                lines.append(rest)
            elif rest:
                self._partial_lines[robot, to_robot] = rest
            complete_lines += [self._line(time_ns, robot, to_robot, line) for line in lines if line]
        return complete_lines

    def _line(self, time_ns: int, robot: int, to_robot: bool, message: bytes) -> _Line:
        """Return the line of a message, or of a part of one."""
        return time_ns, robot, to_robot, self._framings[robot].decode(message).encode("latin-1")


def _encode_line(time_ns: int, to_robot: bool, line: bytes) -> bytes:
    # Nearly all lines are printable.
    text = escape(line).encode("ascii") if line.translate(None, _PRINTABLE) else line
    return _FRAMES[to_robot].message(time_ns, text)


def escape(line: bytes) -> str:
    """Return a line with control characters and noise as Python escapes."""
    return line.decode("latin-1").encode("unicode_escape").decode("ascii")


def unescape(text: str) -> bytes:
    """Return the bytes of a line of a transcript (inverse of `escape`)."""
    try:
        return text.encode("ascii").decode("unicode_escape").encode("latin-1")
    except UnicodeError:
        return text.encode("utf-8")
