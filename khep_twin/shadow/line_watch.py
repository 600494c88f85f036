"""Watch of the line: missing or damaged replies, and restarts.

sound -- 3 bad replies within 5 s --> losing bytes -- no bad reply in 5 mean intervals, at most 5 s --> sound
"""

from collections import deque
from dataclasses import replace

from khep_twin.board.protocol import Malformed
from khep_twin.firmware import parse
from khep_twin.log.exchanges import BANNER, Exchange
from khep_twin.log.shadow_channels import Alarm
from khep_twin.robots.model import Dialect

LOSING, RESTART = "line losing bytes", "restart"
"""Names of the faults."""

_N_BAD, _WINDOW_NS = 3, 5_000_000_000
"""Number of damaged or missing replies within a time [ns] that raise an alarm (assumed)."""

_N_INTERVALS, _MAX_SOUND_NS = 5, 5_000_000_000
"""Time without a bad reply that ends the alarm: a number of mean intervals, and its maximum [ns]. If losses
are independent, one interval in 150 (exp(5)) is that long."""

SHOWN_NS = 1_000_000_000
"""Time for which the alarm of an event without a duration is shown [ns]."""


class LineWatch:
    """Watch of the line of a robot with a dialect.

    Attributes:
        alarms: Alarms that last.
        lossy_ns: Time of the last exchange while it lost bytes [ns]; long ago before any.
    """

    def __init__(self, dialect: Dialect) -> None:
        self._dialect = dialect
        self._bad_ns: deque[int] = deque()
        self.alarms: list[Alarm] = []
        self.lossy_ns = -2 * _MAX_SOUND_NS

    def update(self, exchange: Exchange) -> tuple[Alarm, ...]:
        """Update by an exchange; return the alarms that end."""
        time_ns = exchange.reply_ns
        ended = self._end_alarms(time_ns)
        if exchange.reply is not None and BANNER in exchange.reply:
            if not exchange.command.strip().startswith(b"restart"):  # as the host has requested
                self.alarms.append(Alarm(RESTART, "line", time_ns, time_ns, 0.999))
        elif self._is_bad(exchange):
            self._bad_ns.append(time_ns)
            while self._bad_ns[0] < time_ns - _WINDOW_NS:
                self._bad_ns.popleft()
            if len(self._bad_ns) >= _N_BAD and all(alarm.fault != LOSING for alarm in self.alarms):
                self.alarms.append(Alarm(LOSING, "line", self._bad_ns[0], time_ns, 0.99))
        if any(alarm.fault == LOSING for alarm in self.alarms):
            self.lossy_ns = time_ns
        return ended

    def _end_alarms(self, time_ns: int) -> tuple[Alarm, ...]:
        sound_ns = min(_N_INTERVALS * _WINDOW_NS // max(len(self._bad_ns), 1), _MAX_SOUND_NS)
        ended = [
            alarm
            for alarm in self.alarms
            if (alarm.fault == RESTART and time_ns - alarm.raised_ns > SHOWN_NS)
            or (alarm.fault == LOSING and time_ns - self._bad_ns[-1] > sound_ns)
        ]
        self.alarms = [alarm for alarm in self.alarms if alarm not in ended]
        if any(alarm.fault == LOSING for alarm in ended):
            self._bad_ns.clear()
        return tuple(replace(alarm, ended_ns=time_ns) for alarm in ended)

    def _is_bad(self, exchange: Exchange) -> bool:
        """Return whether a reply is missing or damaged; one at the end of a recording is not."""
        if exchange.abandoned or exchange.output_of:
            return False
        if not exchange.command:
            return True
        if exchange.letter == self._dialect.probes[0]:
            reply = (exchange.reply or b"").decode("latin-1")
            return self._dialect.versions_reply.fullmatch(reply) is None
        if not exchange.letter or isinstance(parse(exchange.command), Malformed):
            return exchange.reply is None
        return exchange.values is None
