"""Transcript of serial lines: received bytes, written as complete lines at the time of their end."""

from collections.abc import Iterable
from typing import Protocol

from khep_twin.log.channels import Level, LineFrame

_LINE_ENDS = b"\r\n"
_LINE_LIMIT = 1024
_PRINTABLE = bytes(code for code in range(0x20, 0x7F) if code != ord("\\"))
_FRAMES = {to_robot: LineFrame("host" if to_robot else "robot", Level.INFO) for to_robot in (True, False)}


class LineSink(Protocol):
    """Destination of lines, e.g. a `LogFile`."""

    def add_lines(self, topic: str, times_ns: list[int], messages: list[bytes]) -> None:
        """Add lines of one robot."""


class Transcript:
    """Transcript of the lines to and from one or more robots, by their names."""

    def __init__(self, log: LineSink, robots: list[str]) -> None:
        self._log = log
        self._robots = robots
        self._received: list[tuple[int, int, bool, bytes]] = []
        self._partial_lines: dict[tuple[int, bool], bytes] = {}

    @property
    def partial_lines(self) -> tuple[tuple[int, bool, bytes], ...]:
        """Bytes of incomplete lines after the last `write`: robot, whether to the robot, bytes."""
        return tuple((*key, partial_line) for key, partial_line in sorted(self._partial_lines.items()))

    def resume(self, partial_lines: Iterable[tuple[int, bool, bytes]]) -> None:
        """Resume with incomplete lines, as `partial_lines` of another transcript returns them."""
        self._partial_lines = {(robot, to_robot): line for robot, to_robot, line in partial_lines}

    def on_bytes(self, time_ns: int, robot: int, to_robot: bool, data: bytes) -> None:
        """Record bytes for the next `write`."""
        self._received.append((time_ns, robot, to_robot, data))

    def write(self) -> None:
        """Write the lines that the recorded bytes complete."""
        messages_by_robot: list[tuple[list[int], list[bytes]]] = [([], []) for _ in self._robots]
        received, self._received = self._received, []
        for time_ns, robot, to_robot, data in received:
            text = self._partial_lines.pop((robot, to_robot), b"") + data if self._partial_lines else data
            lines = text.splitlines()
            # A line beyond the limit is noise, or comes from a host that sends no line ends.
            if text[-1:] not in _LINE_ENDS and len(lines[-1]) <= _LINE_LIMIT:
                self._partial_lines[robot, to_robot] = lines.pop()
            times_ns, messages = messages_by_robot[robot]
            for line in lines:
                if line:
                    times_ns.append(time_ns)
                    messages.append(_encode_line(time_ns, to_robot, line))
        for robot, (times_ns, messages) in enumerate(messages_by_robot):
            if messages:
                self._log.add_lines(f"/{self._robots[robot]}/serial", times_ns, messages)

    def write_partial_lines(self, time_ns: int) -> None:
        """Write incomplete lines."""
        for (robot, to_robot), partial_line in self._partial_lines.items():
            message = _encode_line(time_ns, to_robot, partial_line)
            self._log.add_lines(f"/{self._robots[robot]}/serial", [time_ns], [message])


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
