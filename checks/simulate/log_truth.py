"""True content of a run, collected independently of its recorder, and the comparison of a log with it."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from operator import itemgetter
from typing import Any

import numpy as np

from khep_twin.board.uart import HostEvent
from khep_twin.clock import NS_PER_S
from khep_twin.log.decoding import read_array, read_line
from khep_twin.log.host_events import read_events
from khep_twin.log.snapshots import board_registers
from khep_twin.observers import Observer
from khep_twin.world import World

LOCK_STEP_LOSS_NS = 5 * NS_PER_S
"""Simulated time that a log may lack after a kill (docs/logs.md) [ns]."""

WALL_LOSS_NS = NS_PER_S // 2
"""Wall time that a log of a served twin may lack after a kill, and a turn of its loop [ns]."""

_SETTLED_NS = 2 * NS_PER_S
"""Time after which all that was on a line has arrived: 1024 bytes at 9600 baud take 1.2 s [ns]."""

Messages = Mapping[str, Sequence[tuple[int, bytes]]]
"""Times [ns] and bytes of a log's messages by topic."""

_Line = tuple[int, str, str]
"""Time [ns], name and text."""


class Truth:
    """True content of a run; observes its world before the recorder, which may end amid an observation.

    Args:
        number: Number of the run, its seed.
        failed: Function that returns whether the log is no longer written.

    Attributes:
        closed: True if the log was completed.
        closing: True if its completion was started.
        kept_ns: Time up to which the log is complete, as it was flushed later [ns]; -1 for none.
        last_ns: Time of the last sample that the recorder took [ns].
        begun_ns: Moment at which the run was branched off another one; -1 for a run from its start [ns].
    """

    def __init__(self, number: int, failed: Callable[[], bool] = lambda: False) -> None:
        self.number, self.failed = number, failed
        self.closed = self.closing = False
        self.kept_ns = self.last_ns = self.begun_ns = -1
        self.names: list[str] = []
        self.samples: dict[str, dict[int, bytes]] = {}
        self.lines: dict[str, list[_Line]] = {}
        self.host: dict[str, list[tuple[int, HostEvent]]] = {}
        self.events: list[_Line] = []
        self._rests: dict[tuple[str, bool], bytes] = {}
        self._turns: list[tuple[int, int]] = []

    def watch(self, names: Iterable[str], world: World | None = None) -> None:
        """Begin, at the start of a run or where it is branched off another one."""
        self.names = [*names]
        if world is not None:
            if world.time_ns:
                self.begun_ns = world.time_ns
                self.kept_ns = world.time_ns - LOCK_STEP_LOSS_NS
            world.add_observer(self, sample_now=not world.time_ns)
            world.observers.insert(0, world.observers.pop())
            world.add_observer(_Promises(self), sample_now=not world.time_ns)

    def resume(self, pieces: Iterable[tuple[int, int, bool, bytes]]) -> None:
        """Keep the lines that are not complete yet, of bytes from before the moment."""
        for piece in pieces:
            self.on_bytes(*piece)
        self.lines.clear()

    def sample(self, world: World) -> None:
        """Keep the registers."""
        for robot in world.robots:
            names = ["registers", *(kind.name for kind in robot.firmware.turrets)]
            for name, board in zip(names, board_registers(robot), strict=True):
                topic = f"/{robot.name}/{name}"
                self.samples.setdefault(topic, {})[world.time_ns] = board.tobytes()

    def on_bytes(self, time_ns: int, robot: int, to_robot: bool, data: bytes) -> None:
        """Keep the lines that bytes complete."""
        name = self.names[robot]
        rest = self._rests.pop((name, to_robot), b"")
        for byte in data:
            if byte in b"\r\n":
                if rest:
                    self.lines.setdefault(name, []).append((time_ns, *_transcript_line(to_robot, rest)))
                rest = b""
            else:
                rest += bytes([byte])
        if rest:
            self._rests[name, to_robot] = rest

    def on_host_event(self, time_ns: int, robot: int, event: HostEvent) -> None:
        """Keep a host event."""
        self.host.setdefault(self.names[robot], []).append((time_ns, event))

    def on_event(self, time_ns: int, robot: int | None, text: str) -> None:
        """Keep an event."""
        self.events.append((time_ns, "world" if robot is None else self.names[robot], text))

    def note_sample(self, time_ns: int) -> None:
        """Note that the recorder has taken the sample of a time."""
        if not self.failed():
            self.last_ns = time_ns
            self.kept_ns = max(self.kept_ns, time_ns - LOCK_STEP_LOSS_NS)

    def note_flush(self, time_ns: int) -> None:
        """Note that the recorder has taken an event of a time, with which the log was flushed."""
        if not self.failed():
            self.kept_ns = max(self.kept_ns, time_ns - 1)

    def turn(self, wall_ns: int, time_ns: int) -> None:
        """Note the end of a turn of a serving loop, which flushes by the wall clock."""
        if self.failed():
            return
        self._turns.append((wall_ns, time_ns))
        while len(self._turns) > 2 and wall_ns - self._turns[1][0] > WALL_LOSS_NS:
            del self._turns[0]
        # The turn before the last one that began long enough ago was flushed by one of those since.
        if wall_ns - self._turns[0][0] > WALL_LOSS_NS:
            self.kept_ns = max(self.kept_ns, self._turns[0][1])

    def difference(self, log_messages: Messages, is_complete: bool, has_gaps: bool, is_durable: bool) -> str:
        """Return the first difference between a log and this; empty if there is none.

        Args:
            log_messages: Messages of the log.
            is_complete: True if nothing of the run may be missing.
            has_gaps: True if pieces amid it may be missing.
            is_durable: True if nothing that was flushed may be missing.
        """
        if not self.names:  # it ended as it began
            return ""
        must_ns = self.last_ns if is_complete else self.kept_ns if is_durable else -1
        for topic, samples in self.samples.items():
            messages = log_messages.get(topic, [])
            wrong = _first_wrong(
                [(time_ns, (data,)) for time_ns, data in samples.items()],
                [(time_ns, (_words(data),)) for time_ns, data in messages if time_ns > self.begun_ns],
                has_gaps,
                must_ns,
            )
            if wrong:
                return f"{topic}: {wrong}"
        for name in self.names:
            lines = _lines(log_messages, f"/{name}/serial")
            expected = sorted(self.lines.get(name, []), key=itemgetter(0))
            if self.closing and (is_complete or len(lines) > len(expected) or self.begun_ns >= 0):
                for key, rest in sorted(self._rests.items()):
                    rest_line = _transcript_line(key[1], rest)
                    # A reply on the line at the end may be later.
                    numbers = [number for number, line in enumerate(lines) if line[1:] == rest_line]
                    if key[0] == name and numbers:
                        del lines[numbers[-1]]
                    elif key[0] == name and self.begun_ns < 0:
                        return f"/{name}/serial: without the incomplete line {rest_line}"
            if wrong := self._first_wrong(expected, lines, has_gaps, must_ns):
                return f"/{name}/serial: {wrong}"
            events = [
                event for data in _data(log_messages, f"/{name}/host_events") for event in read_events(data)
            ]
            if wrong := self._first_wrong(self.host.get(name, []), events, has_gaps, must_ns):
                return f"/{name}/host_events: {wrong}"
        wrong = self._first_wrong(self.events, _lines(log_messages, "/events"), has_gaps, must_ns)
        return f"/events: {wrong}" if wrong else ""

    def _first_wrong(
        self,
        expected: Sequence[tuple[Any, ...]],
        logged: Sequence[tuple[Any, ...]],
        has_gaps: bool,
        must_ns: int,
    ) -> str:
        """Compare entries, of a branch those of lines that were not on their way when it began."""
        since_ns = self.begun_ns + _SETTLED_NS if self.begun_ns >= 0 else -1
        expected_entries, logged_entries = (
            [entry for entry in entries if entry[0] > since_ns] for entries in (expected, logged)
        )
        return _first_wrong(expected_entries, logged_entries, has_gaps, must_ns)


class _Promises(Observer):
    """Observer of the world, after the recorder, which notes the content that the log must have."""

    def __init__(self, truth: Truth) -> None:
        self._truth = truth

    def sample(self, world: World) -> None:
        """Note a sample."""
        self._truth.note_sample(world.time_ns)

    def on_event(self, time_ns: int, robot: int | None, text: str) -> None:
        """Note an event."""
        self._truth.note_flush(time_ns)


def _data(log_messages: Messages, topic: str) -> list[bytes]:
    return [data for _, data in log_messages.get(topic, ())]


def _lines(log_messages: Messages, topic: str) -> list[_Line]:
    return [(line.time_ns, line.name, line.text) for line in map(read_line, _data(log_messages, topic))]


def _transcript_line(to_robot: bool, line: bytes) -> tuple[str, str]:
    text = line.decode("latin-1").encode("unicode_escape").decode("ascii")
    return "host" if to_robot else "robot", text


def _words(message: bytes) -> bytes:
    return np.array(read_array(message, "q"), np.int64).tobytes()


def _first_wrong(
    expected: Sequence[tuple[Any, ...]], logged: Sequence[tuple[Any, ...]], has_gaps: bool, must_ns: int
) -> str:
    """Return the first place in which entries are not the beginning of those that are expected."""
    index = 0
    for number, entry in enumerate(logged):
        while has_gaps and index < len(expected) and expected[index] != entry:
            index += 1
        if index >= len(expected) or expected[index] != entry:
            wished = _short(expected[index]) if index < len(expected) else "no more"
            return f"entry {number} is {_short(entry)}; expected {wished}"
        index += 1
    if not has_gaps and index < len(expected) and expected[index][0] <= must_ns:
        return f"{len(logged)} entries, without {_short(expected[index])}; expected all up to {must_ns} ns"
    return ""


def _short(entry: object) -> str:
    return str(entry)[:120]
