"""Runs of stand-in robots: a hidden world, a host on a recorded line, and comparisons of replies.

The host sends its next command after the complete reply. Bytes are recorded at the times at which `LineTimes`
lets them pass the relay between host and robot; an `Exchange` has the times of the robot's line.
"""

import re
from collections import deque
from collections.abc import Iterator, Sequence
from typing import NamedTuple

from khep_twin.board.fault_injection import Fault
from khep_twin.clock import NS_PER_S, to_ns
from khep_twin.log.line_recorder import LineRecorder
from khep_twin.playpen import Block, Playpen
from khep_twin.randomness import stream
from khep_twin.units import BITS_PER_BYTE, COUNTS_LIMIT, SCAN_NS
from khep_twin.world import World
from stand_ins.hidden_changes import Added, Change, apply, hide_added, with_added
from stand_ins.hosts import BODIES, HostKind
from stand_ins.line_times import LineTimes

_TIMEOUT_NS = 300_000_000
"""Longest wait of a host for a reply, six times the longest reply (assumed)."""
_PAUSE_NS = 500_000, 3_000_000
"""Time from a reply to the next command, drawn evenly: the work of program and system (assumed)."""
_POLL_NS = 5_000_000
"""Interval at which a host looks for unexpected bytes."""
_LATE_NS = 10_000_000
"""Delay of a reply that is noticeable."""
_REPLY = re.compile(rb"[no](,\d{1,4}){8}|[hr](,-?\d{1,10}){2}|[no](,\d{1,4}){12}|g(,\d{1,4}){5}")
_OFF = {b"H": (100, 0.0), b"R": (1180, 0.0)}
"""Noticeable difference of counters [pulses], 8 mm of travel, by command; others [counts, part]."""


class Line(NamedTuple):
    """A line of the robot, and the arrivals of its first and last byte [ns]."""

    text: bytes
    first_ns: int
    last_ns: int


class Exchange(NamedTuple):
    """A command, its time on the line [ns], its reply if any, its end [ns], and the number of other lines."""

    sent_ns: int
    command: bytes
    reply: Line | None
    end_ns: int
    n_other_lines: int


class Run:
    """A stand-in robot's world, its hidden changes and the track of its robot.

    Args:
        playpen: Playpen as the twin knows it, with the robot at its true start.
        seed: Seed of the robot and of the changes' random values.
        vary: Draw another robot of the same model.
        faults: Faults of the robot.
        changes: Changes of its world; None for one that is left out.

    Attributes:
        world: World.
        robot: Its robot.
        relayed_ns: Time at which the relay last forwarded bytes [ns].
        times_ns: Times of the poses [ns].
        poses: x, y [m] and heading [rad].
        applied_changes: Applied changes with their times and drawn values; None for others.
    """

    def __init__(
        self,
        playpen: Playpen,
        seed: int,
        vary: bool,
        faults: Sequence[Fault],
        changes: Sequence[Change | None],
    ) -> None:
        active_changes = [change for change in changes if change is not None]
        self.world = World(
            with_added(playpen, active_changes), seed=seed, vary=vary, faults=faults, compiled=True
        )
        self.robot = self.world.robots[0]
        self.relayed_ns = 0
        self.times_ns: list[int] = []
        self.poses: list[tuple[float, float, float]] = []
        self.applied_changes: list[Change | None] = [None] * len(changes)
        self._rng = stream(seed, "stand-in", "changes")
        self._waiting: list[tuple[int, int, Change, int]] = []
        counts = {kind: len(items) for kind, items in playpen.objects.items()}
        for index, change in enumerate(changes):
            added = 0
            if isinstance(change, Added):
                kind = "block" if isinstance(change.item, Block) else "cylinder"
                added, counts[kind] = counts[kind], counts[kind] + 1
            if change is not None:
                self._waiting.append((to_ns(change.at_s), index, change, added))
        hide_added(self.world, playpen)
        self._change()
        # The conversions at time 0 include the changes at the start.
        self.world.scan()
        self._sample()

    def advance_to(self, time_ns: int) -> None:
        """Advance the world, sample its robot every 20 ms, and apply changes that are due."""
        while (sample_ns := len(self.times_ns) * SCAN_NS) <= time_ns:
            self.world.advance_to(sample_ns)
            self._change()
            self._sample()
        self.world.advance_to(time_ns)

    def receive(self) -> Iterator[tuple[int, bytes]]:
        """Yield the bytes received from the robot, one by one with their arrivals [ns]."""
        tx = self.robot.uart.tx
        while (arrival_ns := tx.next_ns) is not None and arrival_ns <= self.world.time_ns:
            yield arrival_ns, tx.read(arrival_ns, 1)

    def next_ns(self) -> int:
        """Return the time of the next poll for a reply [ns]."""
        tx, now_ns = self.robot.uart.tx, self.world.time_ns
        length = tx.count_to_end_of(b"\n")
        end_ns = None if length is None else tx.arrival_ns(length)
        next_times_ns = [time_ns for time_ns in (end_ns, self.robot.next_answer_ns()) if time_ns is not None]
        return max(min([*next_times_ns, now_ns + _POLL_NS]), now_ns + 1)

    def _change(self) -> None:
        for waiting in [entry for entry in self._waiting if entry[0] <= self.world.time_ns]:
            _, index, change, added = waiting
            if (applied := apply(self.world, change, added, self._rng)) is not None:
                self._waiting.remove(waiting)
                self.applied_changes[index] = applied

    def _sample(self) -> None:
        self.times_ns.append(self.world.time_ns)
        self.poses.append(self.robot.pose)


def converse(
    run: Run,
    recorder: LineRecorder,
    times: LineTimes,
    seed: int,
    host: HostKind,
    asks: Sequence[bytes],
    end_ns: int,
) -> Iterator[Exchange]:
    """Run a host with the robot until a time; record the line and yield the exchanges."""
    world, lines, rng, decide = run.world, _Lines(), stream(seed, "host", "pauses"), host.make(seed)
    model = world.playpen.robots[0].robot_model
    body, drive = BODIES[model.family], model.dialect.drive
    counts, speeds, cycle_ns = [0] * len(model.body.sensors), (0, 0), 0
    underway: deque[tuple[int, int, bytes]] = deque()
    unlogged = b""

    def receive_lines() -> Iterator[Line]:
        """Forward the received bytes, and yield their lines."""
        nonlocal unlogged
        underway.extend((times.from_robot(at_ns), at_ns, byte) for at_ns, byte in run.receive())
        while underway and underway[0][0] <= world.time_ns:
            run.relayed_ns, arrival_ns, byte = underway.popleft()
            unlogged += byte
            if not times.whole_replies or byte == b"\n":
                recorder.on_bytes(False, unlogged)
                unlogged = b""
            if line := lines.feed(arrival_ns, byte):
                yield line

    while world.time_ns < end_ns:
        run.advance_to(max(cycle_ns, world.time_ns))
        cycle_ns = world.time_ns + max(host.cycle_ns, body.cycle_ns)
        for command in (*asks, drive(*speeds).encode() + b"\n"):
            run.advance_to(times.host(world.time_ns + int(rng.integers(*_PAUSE_NS))))
            other_lines = list(receive_lines())
            run.relayed_ns, sent_ns = times.to_robot(world.time_ns)
            recorder.on_bytes(True, command)
            run.advance_to(sent_ns)
            run.robot.send(command)
            reply = None
            while reply is None and world.time_ns < sent_ns + _TIMEOUT_NS:
                next_ns = max(underway[-1][0], world.time_ns + 1) if underway else run.next_ns()
                run.advance_to(min(next_ns, sent_ns + _TIMEOUT_NS))
                for line in receive_lines():
                    if _answers(line, command):
                        reply = line
                    else:
                        other_lines.append(line)
            yield Exchange(sent_ns, command, reply, world.time_ns, len(other_lines))
            if command == b"N\n" and reply is not None:
                counts = _values(reply) or counts
        speeds = body.decide(decide, counts)


def noticeable(exchanges: Sequence[Exchange], run: Run) -> int:
    """Return the end of the first reply that differs noticeably from this world's [ns]; -1 if none does."""
    lines, n_other_lines = _Lines(), 0
    pending: list[Exchange] = []
    off: dict[bytes, tuple[int, set[int]]] = {}
    sent = [(exchange.sent_ns, exchange) for exchange in exchanges]
    for time_ns, exchange in [*sent, (exchanges[-1].end_ns + _TIMEOUT_NS, None)]:
        run.advance_to(time_ns)
        for line in filter(None, (lines.feed(*arrival) for arrival in run.receive())):
            count = next((i for i, waiting in enumerate(pending) if _answers(line, waiting.command)), None)
            if count is None:
                n_other_lines += 1
                continue
            for recorded, simulated in zip(pending[: count + 1], [*[None] * count, line], strict=True):
                if (
                    _differs(recorded, simulated, run.world.playpen.robots[0].robot_model.dialect.baud)
                    or recorded.n_other_lines > n_other_lines
                ):
                    return recorded.end_ns
                channels = _channels_off(recorded, simulated)
                since_ns, before = off.get(recorded.command[:1], (0, set[int]()))
                if channels & before:
                    return since_ns
                off[recorded.command[:1]] = recorded.end_ns, channels
            del pending[: count + 1]
        if exchange is not None:
            run.robot.send(exchange.command)
            pending.append(exchange)
    return -1


class _Lines:
    """Assembler of the robot's lines."""

    def __init__(self) -> None:
        self._line_bytes, self._first_ns = b"", 0

    def feed(self, arrival_ns: int, byte: bytes) -> Line | None:
        """Add a byte; return the line that it ends, if any."""
        if not self._line_bytes:
            self._first_ns = arrival_ns
        self._line_bytes += byte
        if byte != b"\n":
            return None
        text, self._line_bytes = self._line_bytes.strip(), b""
        return Line(text, self._first_ns, arrival_ns)


def _answers(line: Line, command: bytes) -> bool:
    return line.text[:1] == command[:1].lower()


def _values(line: Line | None) -> list[int] | None:
    """Return the numbers of a well-formed reply to N, O or H; None for any other."""
    if line is None or not (match := _REPLY.fullmatch(line.text)):
        return None
    values = [int(field) for field in match[0].split(b",")[1:]]
    return values if match[0][:1] in b"hr" or max(values) <= COUNTS_LIMIT else None


def _differs(recorded: Exchange, simulated: Line | None, baud: int) -> bool:
    """Return whether a reply is missing, malformed or late, unlike the simulated one."""
    reply = recorded.reply
    if reply is None or simulated is None:
        return (reply is None) is not (simulated is None)
    if _values(reply) is None or _values(simulated) is None:
        return reply.text != simulated.text
    least_ns = (len(recorded.command) + 1) * BITS_PER_BYTE * NS_PER_S // baud + _LATE_NS
    return reply.first_ns - recorded.sent_ns > least_ns >= simulated.first_ns - recorded.sent_ns


def _channels_off(recorded: Exchange, simulated: Line | None) -> set[int]:
    """Return the channels whose values differ noticeably from the simulated ones."""
    pairs = list(zip(_values(recorded.reply) or [], _values(simulated) or [], strict=False))
    limit, part = _OFF.get(recorded.command[:1], (100, 0.25))
    return {i for i, (one, two) in enumerate(pairs) if abs(one - two) > max(limit, part * max(one, two))}
