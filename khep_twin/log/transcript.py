"""The transcript of serial lines: bytes as they come, written as whole lines, at the time of their end."""

import re
from typing import Protocol

from khep_twin.log import channels
from khep_twin.log.channels import Level, Line

_LINE_ENDS = re.compile(rb"[\r\n]")
_LINE_LIMIT = 1024


class Lines(Protocol):
    """Where lines go, such as a `LogFile`."""

    def add_lines(self, topic: str, times_ns: list[int], messages: list[bytes]) -> None:
        """Takes lines of one robot."""
        ...


class Transcript:
    """Both directions of the lines of one or more robots.

    Args:
        log: where it goes.
        robots: their names.
    """

    def __init__(self, log: Lines, robots: list[str]) -> None:
        self._log = log
        self._robots = robots
        self._heard: list[tuple[int, int, bool, bytes]] = []
        self._rests: dict[tuple[int, bool], bytes] = {}

    def hear(self, time_ns: int, robot: int, to_robot: bool, data: bytes) -> None:
        """Notes bytes; they are written with the next `write`."""
        self._heard.append((time_ns, robot, to_robot, data))

    def write(self) -> None:
        """Writes the lines that the noted bytes complete."""
        lines: dict[int, list[tuple[int, bytes]]] = {}
        for time_ns, robot, to_robot, data in self._heard:
            *whole, rest = _LINE_ENDS.split(self._rests.get((robot, to_robot), b"") + data)
            if len(rest) > _LINE_LIMIT:  # noise, or a host that knows no line ends
                whole, rest = [*whole, rest], b""
            self._rests[robot, to_robot] = rest
            lines.setdefault(robot, []).extend(
                (time_ns, _message(time_ns, to_robot, line)) for line in whole if line
            )
        self._heard.clear()
        for robot, messages in lines.items():
            self._add(robot, messages)

    def write_rests(self, time_ns: int) -> None:
        """Writes lines that were begun and never ended."""
        for (robot, to_robot), rest in self._rests.items():
            if rest:
                self._add(robot, [(time_ns, _message(time_ns, to_robot, rest))])

    def _add(self, robot: int, messages: list[tuple[int, bytes]]) -> None:
        times_ns, lines = [time_ns for time_ns, _ in messages], [line for _, line in messages]
        self._log.add_lines(f"/{self._robots[robot]}/serial", times_ns, lines)


def _message(time_ns: int, to_robot: bool, line: bytes) -> bytes:
    return channels.line_message(Line(time_ns, Level.INFO, "host" if to_robot else "robot", text_of(line)))


def text_of(line: bytes) -> str:
    """A line readable and whole: control characters and noise on the line become escapes of Python's."""
    return line.decode("latin-1").encode("unicode_escape").decode("ascii")
