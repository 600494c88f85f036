"""Exchanges on a serial line: commands and their replies, from the bytes of both directions.

The robot answers commands in order, each by one line that begins with the command's letter in lower case or
is an error; a tool is answered by any number of lines. A line may lose or change bytes, a reply may come late
or not at all, several commands may wait, and a restart shows its banner at any moment. So a reply goes to
the first waiting command that it fits; a line that fits none is kept until the next one shows whose it was.
"""

import re
from collections import deque
from dataclasses import dataclass, replace
from functools import lru_cache

from khep_twin.board.protocol import COMMAND_NOT_FOUND, LINE_END
from khep_twin.clock import NS_PER_S
from khep_twin.firmware import ARGUMENT_COUNTS
from khep_twin.units import BITS_PER_BYTE

BANNER = b"ROM of minirobot"
"""Text within the first line that a robot shows after a restart (K-Team's FAQ)."""

LATE_NS = 50_000_000
"""Delay beyond the time on the line from which a reply may belong to a later command [ns] (assumed; hosts
give up after 50 to 100 ms)."""

GIVE_UP_NS = NS_PER_S
"""Silence of the robot after which a command counts as unanswered [ns] (assumed)."""

_TOLD_NS = NS_PER_S // 2
"""Silence that ends a banner or the output of a tool [ns] (assumed)."""

_LINE_LIMIT = 1024
"""Longest line that is kept [bytes]; the longest known reply is a camera's, of 262."""

_HELD_LIMIT = 16
"""Most lines that are kept until it is clear whose they are."""

_SLOW_BYTE_NS = BITS_PER_BYTE * NS_PER_S // 9600
_LETTERS = frozenset([*ARGUMENT_COUNTS, "T"])
_ERRORS = (b"z,", COMMAND_NOT_FOUND.strip())
_TOOL = re.compile(rb"[a-z][a-z-]*([ \t]|$)")
_ANSWER = re.compile(rb"[a-z](,|$)")
_INTEGER = re.compile(rb"-?[0-9]{1,10}")


@dataclass(frozen=True, slots=True)
class Exchange:
    """One command and the line that answers it.

    Attributes:
        command: Command without its line end; empty for a line that the robot sent unasked.
        sent_ns: Time of the command's line end; of an unasked line its own time [ns].
        reply: Reply without its line end; None if there was none.
        heard_ns: Time of the reply's line end; without a reply the time when it was given up [ns].
        abandoned: True if the host left, or the recording ended, before the reply.
        output_of: Tool, or first line of a banner, whose output an unasked line continues; else empty.
    """

    command: bytes
    sent_ns: int
    reply: bytes | None
    heard_ns: int
    abandoned: bool = False
    output_of: bytes = b""

    @property
    def letter(self) -> str:
        """Letter of the command; empty for a tool, an unknown word and an unasked line."""
        return _letter(self.command)

    @property
    def values(self) -> tuple[int, ...] | None:
        """Integers of a reply that has the command's letter; None for any other reply and for none."""
        head, *fields = (self.reply or b"").split(b",")
        if not self.letter or head != self.letter.lower().encode():
            return None
        return tuple(map(int, fields)) if all(map(_INTEGER.fullmatch, fields)) else None


class Dialogue:
    """Exchanges of one robot with its hosts, as their bytes come.

    Args:
        byte_ns: Time of a byte on the line [ns]; 0 if it is not known.
        give_up_ns: Silence of the robot after which a command counts as unanswered [ns].
    """

    def __init__(self, byte_ns: int = 0, give_up_ns: int = GIVE_UP_NS) -> None:
        self.byte_ns = byte_ns
        self._give_up_ns = give_up_ns
        self._begun = {True: b"", False: b""}
        self._open: deque[Exchange] = deque()
        self._held: deque[tuple[int, bytes]] = deque()
        self._heard_ns = 0
        self._output_of = b""

    def feed(self, time_ns: int, to_robot: bool, data: bytes) -> list[Exchange]:
        """Add bytes that crossed the line at a time [ns], no earlier than others; return what is complete."""
        *lines, begun = LINE_END.split(self._begun[to_robot] + data)
        self._begun[to_robot] = begun[:_LINE_LIMIT]
        done = self.wait(time_ns)
        for line in filter(None, lines):
            if to_robot:
                if self._held and time_ns - self._held[-1][0] > LATE_NS:
                    done += self._settle(len(self._open))
                self._open.append(Exchange(line[:_LINE_LIMIT], time_ns, None, time_ns))
            else:
                done += self._hear(time_ns, line[:_LINE_LIMIT])
        return done

    def wait(self, time_ns: int) -> list[Exchange]:
        """Return the exchanges that are given up by a time until which no more bytes came."""
        since_ns = time_ns - self._give_up_ns
        count = sum(max(each.sent_ns, self._heard_ns) < since_ns for each in self._open)
        return self._settle(count, time_ns) if count else []

    def disconnect(self) -> None:
        """Note that the host has left: nobody waits for the open replies or ends its unfinished line."""
        self._begun[True] = b""
        self._open = deque(replace(each, abandoned=True) for each in self._open)

    def close(self) -> list[Exchange]:
        """End the dialogue; return the exchanges that are still open."""
        self.disconnect()
        return self._settle(len(self._open))

    def _hear(self, time_ns: int, line: bytes) -> list[Exchange]:
        """Add a line of the robot's."""
        place = self._place(time_ns, line)
        telling = bool(self._output_of) and time_ns - self._heard_ns < _TOLD_NS
        done: list[Exchange] = []
        if place is not None:
            done = self._settle(place, time_ns)
            asked = self._open.popleft()
            done.append(replace(asked, reply=line, heard_ns=time_ns))
            self._output_of = asked.command if _is_tool(asked.command) and not _is_error(line) else b""
        elif BANNER in line:
            done = [Exchange(b"", time_ns, line, time_ns)]
            self._output_of = line
        elif telling or not self._open:
            done = [Exchange(b"", time_ns, line, time_ns, output_of=self._output_of if telling else b"")]
        else:
            self._held.append((time_ns, line))
            if len(self._held) > _HELD_LIMIT:
                done = self._settle(len(self._open), time_ns)
        self._heard_ns = time_ns
        return done

    def _place(self, time_ns: int, line: bytes) -> int | None:
        """Return the place of the open command that a line answers, None if it fits none."""
        fitting = [place for place, asked in enumerate(self._open) if _fits(asked.command, line)]
        if not fitting:
            return None
        # A reply that is too late for one command may be that to a later one, if it is not too early for it.
        on_time = (
            place
            for place in fitting
            if self._delay_ns(self._open[place], time_ns, line) <= LATE_NS
            and time_ns - self._open[place].sent_ns >= len(line) * self.byte_ns
        )
        return next(on_time, fitting[0])

    def _delay_ns(self, asked: Exchange, time_ns: int, line: bytes) -> int:
        """Return the delay of a reply beyond the time that command and reply take on the line [ns]."""
        on_the_line = (len(asked.command) + len(line) + 3) * max(self.byte_ns, _SLOW_BYTE_NS)
        return time_ns - max(asked.sent_ns, self._heard_ns) - on_the_line

    def _settle(self, count: int, time_ns: int | None = None) -> list[Exchange]:
        """Return the first open exchanges with the lines that are held, in order, and the lines beyond."""
        done: list[Exchange] = []
        for _ in range(count):
            asked = self._open.popleft()
            if self._held and self._held[0][0] >= asked.sent_ns:
                heard_ns, line = self._held.popleft()
                done.append(replace(asked, reply=line, heard_ns=heard_ns))
            else:
                done.append(replace(asked, heard_ns=asked.heard_ns if time_ns is None else time_ns))
        done += [Exchange(b"", heard_ns, line, heard_ns) for heard_ns, line in self._held]
        self._held.clear()
        return done


@lru_cache(maxsize=1024)
def _letter(command: bytes) -> str:
    head = command.partition(b",")[0].strip(b" \t").decode("latin-1")
    return head if head in _LETTERS else ""


def _is_tool(command: bytes) -> bool:
    return _TOOL.match(command.strip(b" \t")) is not None


def _is_error(line: bytes) -> bool:
    return line.startswith(_ERRORS)


def _fits(command: bytes, line: bytes) -> bool:
    """Return whether a line may be the reply to a command."""
    if _is_error(line):
        return True
    if letter := _letter(command):
        return line.partition(b",")[0] == letter.lower().encode()
    return _is_tool(command) and not _ANSWER.match(line)
