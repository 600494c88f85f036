"""Recorded runs: the part of a log that is needed to repeat a run or to resume it at some time.

A run branched off another one starts like that one; its attachment branch.json lists the changes by time.
"""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from pydantic import Field, TypeAdapter, ValidationError

from khep_twin.board.uart import HostEvent
from khep_twin.clock import NS_PER_S
from khep_twin.errors import LogError
from khep_twin.log.channels import TextLine
from khep_twin.log.decoding import LATEST_NS, DecodeError, decode_messages, printable, read_line
from khep_twin.log.entries import Entry, Label
from khep_twin.log.host_events import FLUSHING_KINDS, read_events
from khep_twin.log.reader import read_raw, read_since
from khep_twin.log.snapshots import SNAPSHOT_TOPIC, read_states
from khep_twin.observers import SAMPLE_NS

RecordedEvent = tuple[int, int, HostEvent]
"""World time [ns], robot index and host event."""

BRANCH = "branch.json"
"""Attachment with the changes of a run branched off another one."""

PROGRAM = "program"
"""Metadata key for the command line of a program that drove the run, whose actions are not logged."""

_OVERTIME_NS = 10 * NS_PER_S
"""Longest time from the last state to any event or line [ns]."""


@dataclass(frozen=True, slots=True)
class BranchPoint:
    """Time at which a run was branched off another one, and the changes from then on.

    Attributes:
        at_ns: Time [ns]; host events at this time, and later, follow the change.
        parent: File name of the parent run's log.
        sha256: Hash of that file.
        seed: New seed of every random stream; None to continue the parent's streams.
        faults: Further faults.
        edits: Changes of the playpen, as `khep_twin.playpen.changes` reads them.
        calibrations: Texts of other calibrations by robot.
    """

    at_ns: Annotated[int, Field(ge=0, le=LATEST_NS)]
    parent: str = ""
    sha256: str = ""
    seed: Annotated[int, Field(ge=0, lt=2**63)] | None = None
    faults: tuple[str, ...] = ()
    edits: tuple[str, ...] = ()
    calibrations: Mapping[str, str] | None = None

    @property
    def text(self) -> str:
        """Description of the changes; empty without any."""
        seed = [] if self.seed is None else [f"seed {self.seed}"]
        calibrations = [f"another calibration of {robot}" for robot in self.calibrations or {}]
        return ", ".join([*seed, *(f"fault {fault}" for fault in self.faults), *self.edits, *calibrations])


_CHANGES = TypeAdapter(tuple[BranchPoint, ...])


@dataclass(frozen=True, slots=True)
class RecordedRun:
    """Recorded run to be repeated.

    Attributes:
        path: Path of the log.
        label: Metadata and attachments of the log.
        events: World time [ns], robot index and host event, in order.
        states: Hash of each sample.
        lines: Transcripts by robot.
        last_ns: Time of the run's end, or of its last known data [ns].
        is_truncated: True if the end of the run may be missing.
        changes: Changes of a run branched off another one, in order of time.
    """

    path: Path
    label: Label
    events: Sequence[RecordedEvent]
    states: Sequence[int]
    lines: Sequence[Sequence[TextLine]]
    last_ns: int
    is_truncated: bool
    changes: Sequence[BranchPoint] = ()

    @property
    def end_ns(self) -> int:
        """Time of the last sample [ns]."""
        return (len(self.states) - 1) * SAMPLE_NS


def read_recorded_run(path: Path) -> RecordedRun:
    """Read the data that a repetition needs from a log."""
    channels = ("/serial", "/state", SNAPSHOT_TOPIC)
    label, messages, is_recovered = read_raw(path, lambda topic: topic.endswith(channels))
    require_serial_line(path, label)
    states: list[int] = []
    for time_ns, hashes in decode_messages(path, "/state", messages, read_states):
        if time_ns != len(states) * SAMPLE_NS:
            at_s = len(states) * SAMPLE_NS / NS_PER_S
            raise LogError(f"{path}: cannot be repeated: the state at {at_s:.2f} s is missing")
        states += hashes
    last_ns = (len(states) - 1) * SAMPLE_NS + _OVERTIME_NS if states and not is_recovered else LATEST_NS
    chunks = read_since(path, SNAPSHOT_TOPIC, -1)
    next(chunks)
    events = list(order_events(path, chunks, label.robots))
    topics = [f"/{name}/serial" for name in label.robots]
    lines = [[line for _, line in decode_messages(path, topic, messages, read_line)] for topic in topics]
    lines_ns = [line.time_ns for transcript in lines for line in transcript]
    for time_ns in (*(at_ns for at_ns, _, _ in events), *lines_ns):
        if time_ns > last_ns:
            last_s = last_ns / NS_PER_S
            expected = f"at most {last_s:.2f} s, {_OVERTIME_NS // NS_PER_S} s after the last state"
            actual = f"something at {time_ns / NS_PER_S:.2f} s"
            raise DecodeError(actual, expected).to_log_error(path, "/host_events and /serial")
    changes, end_ns = read_changes(path, label), (len(states) - 1) * SAMPLE_NS
    # At the end, replies may still be in transmission; the last snapshot contains them.
    snapshots_ns = [time_ns for time_ns, _ in messages.get(SNAPSHOT_TOPIC, ()) if time_ns >= end_ns]
    last_ns = max(snapshots_ns or [end_ns, *lines_ns])
    events.sort(key=lambda event: event[0])
    return RecordedRun(path, label, events, states, lines, last_ns, is_recovered, changes)


def require_serial_line(path: Path, label: Label) -> None:
    """Raise a `LogError` if a log lacks the actions that moved its robots."""
    if PROGRAM in label.metadata:
        raise LogError(f"{path}: cannot be repeated: a program drove it; expected a log of a serial line")
    if label.metadata.get("line") == "none":
        raise LogError(
            f"{path}: cannot be repeated: its controller ran without a line, of which the log has nothing; "
            "expected a log of khep-twin run or serve"
        )


def read_changes(path: Path, label: Label) -> tuple[BranchPoint, ...]:
    """Read the changes of a run branched off another one; none for other runs."""
    try:
        changes = _CHANGES.validate_json(label.attachments.get(BRANCH, "[]"), strict=True)
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        location = ".".join(map(str, first["loc"]))
        problem = DecodeError(f"{location} = {printable(first['input'])}", first["msg"])
        raise problem.to_log_error(path, BRANCH) from None
    if list(changes) != sorted(changes, key=lambda change: change.at_ns):
        raise DecodeError("changes out of order", "them in order of time").to_log_error(path, BRANCH)
    return changes


def changes_text(changes: Sequence[BranchPoint]) -> str:
    """Return changes as the text of an attachment."""
    return _CHANGES.dump_json(tuple(changes), indent=2).decode("utf-8") + "\n"


def order_events(
    path: Path, chunks: Iterable[Sequence[Entry]], robots: Sequence[str]
) -> Iterator[RecordedEvent]:
    """Yield the host events of a log's chunks, sorted by time within each flush of the recorder.

    khep_twin writes one chunk per flush, with at most one message of each robot, in the robots' order: a
    flush ends before a later chunk that continues with an earlier robot. For chunks of other tools, it ends
    before the second message of a robot, and after an event of `FLUSHING_KINDS`.
    """
    indices_by_topic = {f"/{name}/host_events": index for index, name in enumerate(robots)}
    pending: list[RecordedEvent] = []
    trigger: RecordedEvent | None = None
    pending_robots: set[int] = set()
    flush_chunk = last_chunk = last_index = last_ns = 0
    for chunk, entries in enumerate(chunks):
        for entry in entries:
            if (index := indices_by_topic.get(entry.topic)) is None:
                continue
            try:
                events = [(at_ns, index, event) for at_ns, event in read_events(entry.data)]
            except DecodeError as error:
                raise error.to_log_error(path, entry.topic, entry.time_ns) from None
            if not events:
                continue
            start_ns, end_ns = events[0][0], events[-1][0]
            is_next_chunk = chunk > last_chunk and index < last_index and start_ns >= last_ns
            if (
                index in pending_robots
                or is_next_chunk
                or (trigger and start_ns >= trigger[0] and (chunk > flush_chunk or end_ns > trigger[0]))
            ):
                yield from _sort_events(pending, trigger)
                pending, trigger, pending_robots = [], None, set[int]()
            pending += events
            pending_robots.add(index)
            last_chunk, last_index, last_ns = chunk, index, max(last_ns, end_ns)
            if events[-1][2].kind in FLUSHING_KINDS:
                trigger, flush_chunk = events[-1], chunk
    yield from _sort_events(pending, trigger)


def _sort_events(events: list[RecordedEvent], trigger: RecordedEvent | None) -> list[RecordedEvent]:
    """Return events in order of time; the one that triggered the flush is the last of its time."""
    return sorted(events, key=lambda event: (event[0], event is trigger))
