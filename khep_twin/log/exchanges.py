"""Exchanges on a serial line: commands and their replies, from the bytes of both directions.

The robot answers commands in order, each by a line that starts with the command's letter in lower case or by
an error; a tool replies with any number of lines. Bytes may be lost or changed, replies late or missing,
several commands pending, and a restart prints its banner at any time. A reply is therefore assigned to the
first pending command that it can answer; other lines wait until a later reply resolves them.
"""

import re
from collections import deque
from dataclasses import dataclass, replace
from functools import lru_cache

from khep_twin.board.protocol import COMMAND_NOT_FOUND, LINE_END
from khep_twin.clock import NS_PER_S
from khep_twin.units import BITS_PER_BYTE

BANNER = b"ROM of minirobot"
"""Text within the first line that a robot prints after a restart (K-Team's FAQ)."""

LATE_NS = 50_000_000
"""Delay beyond the time on the line from which a reply may belong to a later command [ns] (assumed; hosts
give up after 50 to 100 ms)."""

REPLY_TIMEOUT_NS = NS_PER_S
"""Silence of the robot after which a command is unanswered [ns] (assumed)."""

_OUTPUT_GAP_NS = NS_PER_S // 2
"""Silence that ends a banner or the output of a tool [ns] (assumed)."""

_LINE_LIMIT = 1024
"""Longest line that is stored [bytes]; the longest known reply is a camera's, of 262."""

_UNMATCHED_LIMIT = 16
"""Maximum number of lines that wait for their command to be identified."""

_SLOW_BYTE_NS = BITS_PER_BYTE * NS_PER_S // 9600
_LETTER = re.compile("[A-Z]")
_ERRORS = (b"z,", COMMAND_NOT_FOUND.strip())
_TOOL = re.compile(rb"[a-z][a-z-]*([ \t]|$)")
_ANSWER = re.compile(rb"[a-z](,|$)")
_INTEGER = re.compile(rb"-?[0-9]{1,10}")


@dataclass(frozen=True, slots=True)
class Exchange:
    """A command and its reply.

    Attributes:
        command: Command without its line end; empty for an unsolicited line.
        sent_ns: Time of the command's line end; of an unsolicited line, the time of its end [ns].
        reply: Reply without its line end; None if there was none.
        reply_ns: Time of the reply's line end; without a reply, the time of its time-out [ns].
        abandoned: True if the host left, or the recording ended, before the reply.
        output_of: Tool, or first line of a banner, whose output an unsolicited line continues; or empty.
    """

    command: bytes
    sent_ns: int
    reply: bytes | None
    reply_ns: int
    abandoned: bool = False
    output_of: bytes = b""

    @property
    def letter(self) -> str:
        """Letter of the command; empty for a tool, an unknown word and an unsolicited line."""
        return _letter(self.command)

    @property
    def values(self) -> tuple[int, ...] | None:
        """Integers of a reply with the command's letter; None for any other reply and for none."""
        head, *fields = (self.reply or b"").split(b",")
        if not self.letter or head != self.letter.lower().encode():
            return None
        return tuple(map(int, fields)) if all(map(_INTEGER.fullmatch, fields)) else None


class Dialogue:
    """Incremental parser of the exchanges of one robot with its hosts.

    Args:
        byte_ns: Time of a byte on the line [ns]; 0 if it is unknown.
        timeout_ns: Silence of the robot after which a command is unanswered [ns].
    """

    def __init__(self, byte_ns: int = 0, timeout_ns: int = REPLY_TIMEOUT_NS) -> None:
        self.byte_ns = byte_ns
        self._timeout_ns = timeout_ns
        self._partial_lines = {True: b"", False: b""}
        self._pending: deque[Exchange] = deque()
        self._unmatched: deque[tuple[int, bytes]] = deque()
        self._last_line_ns = 0
        self._output_of = b""

    def feed(self, time_ns: int, to_robot: bool, data: bytes) -> list[Exchange]:
        """Add bytes transmitted at a non-decreasing time [ns]; return the completed exchanges."""
        *lines, partial_line = LINE_END.split(self._partial_lines[to_robot] + data)
        self._partial_lines[to_robot] = partial_line[:_LINE_LIMIT]
        exchanges = self.expire(time_ns)
        for line in filter(None, lines):
            if to_robot:
                if self._unmatched and time_ns - self._unmatched[-1][0] > LATE_NS:
                    exchanges += self._close_pending(len(self._pending))
                self._pending.append(Exchange(line[:_LINE_LIMIT], time_ns, None, time_ns))
            else:
                exchanges += self._add_robot_line(time_ns, line[:_LINE_LIMIT])
        return exchanges

    def expire(self, time_ns: int) -> list[Exchange]:
        """Return the exchanges that have timed out if no further bytes came until a time [ns]."""
        expiry_ns = time_ns - self._timeout_ns
        n_expired = sum(max(exchange.sent_ns, self._last_line_ns) < expiry_ns for exchange in self._pending)
        return self._close_pending(n_expired, time_ns) if n_expired else []

    def disconnect(self) -> None:
        """Mark pending exchanges as abandoned, and drop a partial command: the host has left."""
        self._partial_lines[True] = b""
        self._pending = deque(replace(exchange, abandoned=True) for exchange in self._pending)

    def close(self) -> list[Exchange]:
        """End the dialogue; return the pending exchanges."""
        self.disconnect()
        return self._close_pending(len(self._pending))

    def _add_robot_line(self, time_ns: int, line: bytes) -> list[Exchange]:
        """Add a line of the robot; return the completed exchanges."""
        index = self._match(time_ns, line)
        is_output = bool(self._output_of) and time_ns - self._last_line_ns < _OUTPUT_GAP_NS
        exchanges: list[Exchange] = []
        if index is not None:
            exchanges = self._close_pending(index, time_ns)
            exchange = self._pending.popleft()
            exchanges.append(replace(exchange, reply=line, reply_ns=time_ns))
            self._output_of = exchange.command if _is_tool(exchange.command) and not _is_error(line) else b""
        elif BANNER in line:
            exchanges = [Exchange(b"", time_ns, line, time_ns)]
            self._output_of = line
        elif is_output or not self._pending:
            output_of = self._output_of if is_output else b""
            exchanges = [Exchange(b"", time_ns, line, time_ns, output_of=output_of)]
        else:
            self._unmatched.append((time_ns, line))
            if len(self._unmatched) > _UNMATCHED_LIMIT:
                exchanges = self._close_pending(len(self._pending), time_ns)
        self._last_line_ns = time_ns
        return exchanges

    def _match(self, time_ns: int, line: bytes) -> int | None:
        """Return the index of the pending command that a line answers; None if it answers none."""
        matches = [i for i, exchange in enumerate(self._pending) if _can_answer(exchange.command, line)]
        if not matches:
            return None
        # A reply that is too late for one command may answer a later one, unless it is too early for that.
        on_time = (
            index
            for index in matches
            if self._delay_ns(self._pending[index], time_ns, line) <= LATE_NS
            and time_ns - self._pending[index].sent_ns >= len(line) * self.byte_ns
        )
        return next(on_time, matches[0])

    def _delay_ns(self, exchange: Exchange, time_ns: int, line: bytes) -> int:
        """Return the delay of a reply beyond the transmission time of command and reply [ns]."""
        line_time_ns = (len(exchange.command) + len(line) + 3) * max(self.byte_ns, _SLOW_BYTE_NS)
        return time_ns - max(exchange.sent_ns, self._last_line_ns) - line_time_ns

    def _close_pending(self, count: int, time_ns: int | None = None) -> list[Exchange]:
        """Remove the first `count` pending exchanges; return them, with other lines as replies."""
        exchanges: list[Exchange] = []
        for _ in range(count):
            exchange = self._pending.popleft()
            if self._unmatched and self._unmatched[0][0] >= exchange.sent_ns:
                reply_ns, line = self._unmatched.popleft()
                exchanges.append(replace(exchange, reply=line, reply_ns=reply_ns))
            else:
                end_ns = exchange.reply_ns if time_ns is None else time_ns
                exchanges.append(replace(exchange, reply_ns=end_ns))
        exchanges += [Exchange(b"", reply_ns, line, reply_ns) for reply_ns, line in self._unmatched]
        self._unmatched.clear()
        return exchanges


@lru_cache(maxsize=1024)
def _letter(command: bytes) -> str:
    head = command.partition(b",")[0].strip(b" \t").decode("latin-1")
    return head if _LETTER.fullmatch(head) else ""


def _is_tool(command: bytes) -> bool:
    return _TOOL.match(command.strip(b" \t")) is not None


def _is_error(line: bytes) -> bool:
    return line.startswith(_ERRORS)


def _can_answer(command: bytes, line: bytes) -> bool:
    """Return whether a line may answer a command."""
    if _is_error(line):
        return True
    if letter := _letter(command):
        return line.partition(b",")[0] == letter.lower().encode()
    return _is_tool(command) and not _ANSWER.match(line)
