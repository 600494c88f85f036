"""Transcript of serial lines: bytes as they come, written as whole lines, at the time of their end."""

from collections.abc import Iterable
from typing import Protocol

from khep_twin.log.channels import Level, LineFrame

_LINE_ENDS = b"\r\n"
_LINE_LIMIT = 1024
_PLAIN = bytes(each for each in range(0x20, 0x7F) if each != ord("\\"))
_FROM = {to_robot: LineFrame("host" if to_robot else "robot", Level.INFO) for to_robot in (True, False)}


class LineSink(Protocol):
    """Destination of lines, such as a `LogFile`."""

    def add_lines(self, topic: str, times_ns: list[int], messages: list[bytes]) -> None:
        """Add lines of one robot."""
        ...


class Transcript:
    """Transcript of both directions of one or more robots."""

    def __init__(self, log: LineSink, robots: list[str]) -> None:
        self._log = log
        self._robots = robots
        self._heard: list[tuple[int, int, bool, bytes]] = []
        self._rests: dict[tuple[int, bool], bytes] = {}

    @property
    def rests(self) -> tuple[tuple[int, bool, bytes], ...]:
        """Bytes of incomplete lines as written so far: robot, whether to the robot, bytes."""
        return tuple((*whose, rest) for whose, rest in sorted(self._rests.items()))

    def resume(self, rests: Iterable[tuple[int, bool, bytes]]) -> None:
        """Go on with incomplete lines."""
        self._rests = {(robot, to_robot): rest for robot, to_robot, rest in rests}

    def on_bytes(self, time_ns: int, robot: int, to_robot: bool, data: bytes) -> None:
        """Record bytes; they are written with the next `write`."""
        self._heard.append((time_ns, robot, to_robot, data))

    def write(self) -> None:
        """Write the lines that the recorded bytes complete."""
        lines: list[tuple[list[int], list[bytes]]] = [([], []) for _ in self._robots]
        heard, self._heard = self._heard, []
        for time_ns, robot, to_robot, data in heard:
            text = self._rests.pop((robot, to_robot), b"") + data if self._rests else data
            whole = text.splitlines()
            # A line beyond the limit is noise, or from a host that sends no line ends.
            if text[-1:] not in _LINE_ENDS and len(whole[-1]) <= _LINE_LIMIT:
                self._rests[robot, to_robot] = whole.pop()
            times_ns, messages = lines[robot]
            for line in whole:
                if line:
                    times_ns.append(time_ns)
                    messages.append(_message(time_ns, to_robot, line))
        for robot, (times_ns, messages) in enumerate(lines):
            if messages:
                self._log.add_lines(f"/{self._robots[robot]}/serial", times_ns, messages)

    def write_rests(self, time_ns: int) -> None:
        """Write unfinished lines."""
        for (robot, to_robot), rest in self._rests.items():
            message = _message(time_ns, to_robot, rest)
            self._log.add_lines(f"/{self._robots[robot]}/serial", [time_ns], [message])


def _message(time_ns: int, to_robot: bool, line: bytes) -> bytes:
    # Nearly all lines are printable as they are.
    text = text_of(line).encode("ascii") if line.translate(None, _PLAIN) else line
    return _FROM[to_robot].message(time_ns, text)


def text_of(line: bytes) -> str:
    """Return a line in printable form: control characters and noise become Python escapes."""
    return line.decode("latin-1").encode("unicode_escape").decode("ascii")


def bytes_of(text: str) -> bytes:
    """Return a line of a transcript as it was (`text_of`)."""
    try:
        return text.encode("ascii").decode("unicode_escape").encode("latin-1")
    except UnicodeError:
        return text.encode("utf-8")
