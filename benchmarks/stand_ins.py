"""Stand-in robots: recordings of a robot's line as a relay makes them, with the truth beside them.

    python -m benchmarks.stand_ins FOLDER --runs 20 --playpen obstacles

A twin with hidden differences stands in for a robot: another robot of the same make, faults, and changes of
its world that the playpen does not tell. A scripted host asks N and sets speeds, one exchange at a time. The
log NAME.mcap has what crossed the line alone, with the times at which a relay passes it on; NAME.npz the
truth. Simulated time is the only clock, so a recording is the same each time.
"""

import argparse
import math
import re
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from benchmarks.hidden_changes import Added, Change, apply, hide_added, reachable, with_added
from benchmarks.stand_in_hosts import HOSTS, Host
from khep_twin import playpen as playpens
from khep_twin.board import fault_injection
from khep_twin.clock import NS_PER_S, to_ns
from khep_twin.log.line_recorder import LineRecorder
from khep_twin.playpen import Block, Playpen
from khep_twin.playpen.starts import Start, at_spots, at_start, no_room
from khep_twin.randomness import stream
from khep_twin.units import BITS_PER_BYTE, COUNTS_LIMIT, N_SENSORS, SCAN_NS
from khep_twin.world import World

BAUD = 9600

_TIMEOUT_NS = 300_000_000
"""Longest wait of a host for a reply, six times the longest reply (assumed)."""
_PAUSE_NS = 500_000, 3_000_000
"""Time from a reply to the next command, drawn evenly: the work of program and system (assumed)."""
_LOOK_NS = 5_000_000
"""Interval at which a host looks for bytes that nothing announces."""
_LATE_NS = 10_000_000
"""Delay of a reply that is noticeable."""
_REPLY = re.compile(rb"[no](,\d{1,4}){8}|h(,-?\d{1,10}){2}")


@dataclass(frozen=True)
class Truth:
    """Truth of a recording.

    A hidden change is noticeable from the first reply on that differs from that of a second world, which has
    the same seed and everything else, and gets the same bytes at the same times, but not this change. It
    differs if

    - a count of N or O is off by more than 100 counts and more than 25 % of the larger one, a counter of H by
      more than 100 pulses, in this reply and, in the same channel, in the next to the same command;
    - or it is missing, malformed or of another kind, or its first byte comes more than 10 ms late, or another
      line such as a banner comes before it.

    Attributes:
        times_ns: Times of the poses, every 20 ms (n,) [ns].
        poses: x, y [m] and heading [rad] (n, 3).
        start: Pose at the start (3,).
        told: Pose at the start that the twin is told (3,).
        hidden: Faults and changes, in words (k,).
        changed_ns: Time of each (k,) [ns]; -1 if there was no room for it.
        ended_ns: End of each (k,) [ns]; -1 if it does not end.
        noticeable_ns: Arrival of the first reply that each changes noticeably (k,) [ns]; -1 if none is.
    """

    times_ns: NDArray[np.int64]
    poses: NDArray[np.float64]
    start: NDArray[np.float64]
    told: NDArray[np.float64]
    hidden: NDArray[np.str_]
    changed_ns: NDArray[np.int64]
    ended_ns: NDArray[np.int64]
    noticeable_ns: NDArray[np.int64]

    def save(self, path: Path) -> None:
        """Write it as NumPy's .npz."""
        np.savez(path, **{each.name: getattr(self, each.name) for each in fields(self)})

    @classmethod
    def load(cls, path: Path) -> Self:
        """Read it from the .npz beside a log."""
        with np.load(path) as found:
            return cls(**{each.name: found[each.name] for each in fields(cls)})


def record(
    path: Path,
    playpen: Playpen,
    *,
    seed: int,
    seconds: float,
    host: str,
    asks_counters: bool = False,
    asks_light: bool = False,
    vary: bool = True,
    faults: Sequence[str] = (),
    changes: Sequence[Change] = (),
    start: Start | None = None,
    start_error: Start | None = None,
) -> Truth:
    """Record a run of a stand-in robot; return the truth, which is also saved beside the log.

    Args:
        path: Path of the log, NAME.mcap; the truth goes to NAME.npz.
        playpen: Playpen of one robot, as the twin is told it.
        seed: Seed of the robot, the host and all that is drawn.
        seconds: Length of the recording [s].
        host: Name of the host in `stand_in_hosts.HOSTS`.
        asks_counters: Ask H in each cycle, too.
        asks_light: Ask O in each cycle, too.
        vary: Draw another robot of the same make.
        faults: Faults of the robot, in the syntax of `khep_twin.board.fault_injection`.
        changes: Changes of its world.
        start: Start that the twin is told; by default the playpen's, or a spot drawn by the seed.
        start_error: Error of that, in mm and degrees; drawn within 10 mm and 5 degrees if not given.
    """
    told = at_spots(playpen, seed) if start is None else at_start(playpen, 0, start)
    actual = _misplaced(told, seed, start_error)
    run = _Run(actual, seed, vary, faults, changes)
    asks = [b"N\n", *([b"H\n"] if asks_counters else []), *([b"O\n"] if asks_light else [])]
    settings = {"relay": "stand-in", "baud": BAUD}
    recorder = LineRecorder(path, settings, lambda: run.relayed_ns)
    exchanges = list(
        _converse(run, recorder, stream(seed, "host", "pauses"), HOSTS[host](seed), asks, to_ns(seconds))
    )
    recorder.close()
    noticeable: list[int] = []
    for index in range(len(faults) + len(changes)):
        fewer = [fault for number, fault in enumerate(faults) if number != index]
        without = [None if number == index else each for number, each in enumerate(run.made, len(faults))]
        noticeable.append(_noticeable(exchanges, _Run(actual, seed, vary, fewer, without)))
    parsed = [fault_injection.parse(fault) for fault in faults]
    starts_ns = [fault.start_ns for fault in parsed]
    ends_ns = [fault.end_ns if fault.ends else -1 for fault in parsed]
    truth = Truth(
        np.array(run.times_ns),
        np.array(run.poses),
        np.array(run.poses[0]),
        np.array(_pose(told)),
        np.array([*faults, *(str(run.made[i] or each) for i, each in enumerate(changes))], np.str_),
        np.array([*starts_ns, *(-1 if each is None else to_ns(each.at_s) for each in run.made)], np.int64),
        np.array([*ends_ns, *[-1] * len(changes)], np.int64),
        np.array(noticeable, np.int64),
    )
    truth.save(path.with_suffix(".npz"))
    return truth


class _Line(NamedTuple):
    """A line of the robot, and the arrivals of its first and last byte [ns]."""

    text: bytes
    first_ns: int
    last_ns: int


class _Exchange(NamedTuple):
    """A command, when it was sent [ns], its reply if one came, its end [ns], and a number of other lines."""

    sent_ns: int
    command: bytes
    reply: _Line | None
    end_ns: int
    others: int


class _Run:
    """A stand-in robot's world, its hidden changes and the track of its robot."""

    def __init__(
        self,
        playpen: Playpen,
        seed: int,
        vary: bool,
        faults: Sequence[str],
        changes: Sequence[Change | None],
    ) -> None:
        wanted = [change for change in changes if change is not None]
        self.world = World(
            with_added(playpen, wanted),
            seed=seed,
            vary=vary,
            faults=[fault_injection.parse(fault) for fault in faults],
            compiled=True,
        )
        self.robot = self.world.robots[0]
        self.relayed_ns = 0
        self.times_ns: list[int] = []
        self.poses: list[tuple[float, float, float]] = []
        self.made: list[Change | None] = [None] * len(changes)
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
        # The conversions of time 0 show what is there, or not, from the start.
        self.world.scan()
        self._sample()

    def advance_to(self, time_ns: int) -> None:
        """Advance the world, sample its robot every 20 ms, and make changes that are due."""
        while (sample_ns := len(self.times_ns) * SCAN_NS) <= time_ns:
            self.world.advance_to(sample_ns)
            self._change()
            self._sample()
        self.world.advance_to(time_ns)

    def receive(self) -> Iterator[tuple[int, bytes]]:
        """Yield the bytes that have come from the robot, one by one with their arrivals [ns]."""
        tx = self.robot.uart.tx
        while (arrival_ns := tx.next_ns) is not None and arrival_ns <= self.world.time_ns:
            yield arrival_ns, tx.read(arrival_ns, 1)

    def next_ns(self) -> int:
        """Return when to look for a reply next [ns]."""
        tx, now_ns = self.robot.uart.tx, self.world.time_ns
        length = tx.count_to_end_of(b"\n")
        end_ns = None if length is None else tx.arrival(length)
        found = [each for each in (end_ns, self.robot.next_answer_ns()) if each is not None]
        return max(min([*found, now_ns + _LOOK_NS]), now_ns + 1)

    def _change(self) -> None:
        for waiting in [each for each in self._waiting if each[0] <= self.world.time_ns]:
            _, index, change, added = waiting
            if (made := apply(self.world, change, added, self._rng)) is not None:
                self._waiting.remove(waiting)
                self.made[index] = made

    def _sample(self) -> None:
        self.times_ns.append(self.world.time_ns)
        self.poses.append(self.robot.pose)


class _Lines:
    """Assembler of the robot's lines."""

    def __init__(self) -> None:
        self._begun, self._first_ns = b"", 0

    def feed(self, arrival_ns: int, byte: bytes) -> _Line | None:
        """Add a byte; return the line that it ends, if any."""
        if not self._begun:
            self._first_ns = arrival_ns
        self._begun += byte
        if byte != b"\n":
            return None
        text, self._begun = self._begun.strip(), b""
        return _Line(text, self._first_ns, arrival_ns)


def _converse(
    run: _Run,
    recorder: LineRecorder,
    rng: np.random.Generator,
    decide: Host,
    asks: Sequence[bytes],
    end_ns: int,
) -> Iterator[_Exchange]:
    """Let a host talk to the robot until a time; record the line and yield the exchanges."""
    world, lines = run.world, _Lines()
    counts, speeds = [0] * N_SENSORS, (0, 0)

    def hear() -> Iterator[_Line]:
        """Pass on what has come, and yield its lines."""
        for arrival_ns, byte in run.receive():
            run.relayed_ns = arrival_ns
            recorder.on_bytes(False, byte)
            if line := lines.feed(arrival_ns, byte):
                yield line

    while world.time_ns < end_ns:
        for command in (*asks, b"D,%d,%d\n" % speeds):
            run.advance_to(world.time_ns + int(rng.integers(*_PAUSE_NS)))
            others = list(hear())
            sent_ns = run.relayed_ns = world.time_ns
            recorder.on_bytes(True, command)
            run.robot.send(command)
            reply = None
            while reply is None and world.time_ns < sent_ns + _TIMEOUT_NS:
                run.advance_to(min(run.next_ns(), sent_ns + _TIMEOUT_NS))
                for line in hear():
                    if _answers(line, command):
                        reply = line
                    else:
                        others.append(line)
            yield _Exchange(sent_ns, command, reply, world.time_ns, len(others))
            if command == b"N\n" and reply is not None:
                counts = _values(reply) or counts
        speeds = decide(counts)


def _noticeable(exchanges: Sequence[_Exchange], run: _Run) -> int:
    """Return when the first reply came that differs noticeably from this world's [ns]; -1 if none does."""
    lines, others = _Lines(), 0
    pending: list[_Exchange] = []
    off: dict[bytes, tuple[int, set[int]]] = {}
    sent = [(each.sent_ns, each) for each in exchanges]
    for time_ns, exchange in [*sent, (exchanges[-1].end_ns + _TIMEOUT_NS, None)]:
        run.advance_to(time_ns)
        for line in filter(None, (lines.feed(*heard) for heard in run.receive())):
            count = next((i for i, each in enumerate(pending) if _answers(line, each.command)), None)
            if count is None:
                others += 1
                continue
            for asked, here in zip(pending[: count + 1], [*[None] * count, line], strict=True):
                if _differs(asked, here) or asked.others > others:
                    return asked.end_ns
                channels = _channels_off(asked, here)
                since_ns, before = off.get(asked.command[:1], (0, set[int]()))
                if channels & before:
                    return since_ns
                off[asked.command[:1]] = asked.end_ns, channels
            del pending[: count + 1]
        if exchange is not None:
            run.robot.send(exchange.command)
            pending.append(exchange)
    return -1


def _answers(line: _Line, command: bytes) -> bool:
    return line.text[:1] == command[:1].lower()


def _values(line: _Line | None) -> list[int] | None:
    """Return the numbers of a well-formed reply to N, O or H; None for any other."""
    if line is None or not (found := _REPLY.fullmatch(line.text)):
        return None
    values = [int(field) for field in found[0].split(b",")[1:]]
    return values if found[0][:1] == b"h" or max(values) <= COUNTS_LIMIT else None


def _differs(asked: _Exchange, here: _Line | None) -> bool:
    """Return whether a reply is missing, malformed or late, unlike here."""
    reply = asked.reply
    if reply is None or here is None:
        return (reply is None) is not (here is None)
    if _values(reply) is None or _values(here) is None:
        return reply.text != here.text
    least_ns = (len(asked.command) + 1) * BITS_PER_BYTE * NS_PER_S // BAUD + _LATE_NS
    return reply.first_ns - asked.sent_ns > least_ns >= here.first_ns - asked.sent_ns


def _channels_off(asked: _Exchange, here: _Line | None) -> set[int]:
    """Return the channels whose values differ noticeably from those here."""
    pairs = list(zip(_values(asked.reply) or [], _values(here) or [], strict=False))
    part = 0.0 if asked.command == b"H\n" else 0.25
    return {i for i, (one, two) in enumerate(pairs) if abs(one - two) > max(100, part * max(one, two))}


def _misplaced(playpen: Playpen, seed: int, error: Start | None) -> Playpen:
    """Return the playpen with its robot off by an error; a drawn one is halved until there is room."""
    entry = playpen.robots[0]
    if error is None:
        rng = stream(seed, "stand-in", "start")
        radius, angle = 10 * math.sqrt(rng.random()), math.tau * rng.random()
        error = radius * math.cos(angle), radius * math.sin(angle), float(rng.uniform(-5, 5))
        while no_room(playpen, 0, entry.x_mm + error[0], entry.y_mm + error[1]):
            error = error[0] / 2, error[1] / 2, error[2]
    return at_start(playpen, 0, (entry.x_mm + error[0], entry.y_mm + error[1], entry.heading_deg + error[2]))


def _pose(playpen: Playpen) -> Start:
    """Return the start of a playpen's robot in metres and radians."""
    entry = playpen.robots[0]
    return entry.x_mm / 1e3, entry.y_mm / 1e3, math.radians(entry.heading_deg)


def free_start(playpen: Playpen, seed: int) -> Start:
    """Return a start that a robot could have driven to from the playpen's own, drawn by the seed."""
    rng = stream(seed, "stand-in", "free start")
    places = reachable(at_spots(playpen, seed))
    return (*places[int(rng.integers(len(places)))], round(float(rng.uniform(-180, 180)), 1))


def main() -> None:
    """Record runs, and print how fast."""
    options = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    options.add_argument("folder", type=Path, help="folder of the recordings, made if it is not there")
    options.add_argument(
        "--runs", type=int, default=3, help="number of runs, which take turns with the hosts"
    )
    options.add_argument("--playpen", default="workshop", help="name or path of the playpen")
    options.add_argument("--seconds", type=float, default=300.0, help="length of each run [s]")
    options.add_argument("--seed", type=int, default=0, help="seed of the first run")
    options.add_argument("--host", choices=HOSTS, help="one host for all runs")
    options.add_argument("--asks-counters", action="store_true", help="ask H as well")
    options.add_argument("--asks-light", action="store_true", help="ask O as well")
    options.add_argument("--free-start", action="store_true", help="start anywhere")
    options.add_argument("--fault", action="append", default=[], help="a hidden fault, such as stuck:2@60")
    given = options.parse_args()
    given.folder.mkdir(parents=True, exist_ok=True)
    playpen = playpens.load(given.playpen)
    for seed in range(given.seed, given.seed + given.runs):
        host = given.host or list(HOSTS)[seed % len(HOSTS)]
        path = given.folder / f"{playpen.name}_{host.replace(' ', '_')}_{seed}.mcap"
        began = time.perf_counter()
        truth = record(
            path,
            playpen,
            seed=seed,
            seconds=given.seconds,
            host=host,
            asks_counters=given.asks_counters,
            asks_light=given.asks_light,
            faults=given.fault,
            start=free_start(playpen, seed) if given.free_start else None,
        )
        path_m = float(np.hypot(*np.diff(truth.poses[:, :2], axis=0).T).sum())
        rate = given.seconds / (time.perf_counter() - began)
        print(f"{path}  {path_m:.1f} m driven, {rate:.0f} simulated s per s")


if __name__ == "__main__":
    main()
