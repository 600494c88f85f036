"""Recorded runs, as far as they are needed to repeat them or to take them up at a moment.

A run that was branched off another one begins as that one; its attachment branch.json has what changed when.
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
from khep_twin.log.decoding import LATEST_NS, DecodeError, decoded, read_line, shown
from khep_twin.log.entries import Entry, Label
from khep_twin.log.host_events import PIECE_ENDS, read_events
from khep_twin.log.reader import read_raw, read_since
from khep_twin.log.snapshots import TOPIC, read_states
from khep_twin.world import SAMPLE_NS

RecordedEvent = tuple[int, int, HostEvent]
"""World time [ns], robot index and host event."""

BRANCH = "branch.json"
"""Attachment with the changes of a run that was branched off another one."""

PROGRAM = "program"
"""Fact of a run that a program drove, of which the log has nothing: its command line."""


@dataclass(frozen=True, slots=True)
class BranchPoint:
    """Moment at which a run was branched off another one, and what is different from then on.

    Attributes:
        at_ns: Moment [ns]; what hosts did at it, and later, follows the change.
        parent: File name of the other run's log.
        sha256: Hash of that file.
        seed: New seed of every random stream; None to go on with the parent's draws.
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
        """Description of what is different; empty for nothing."""
        seed = [] if self.seed is None else [f"seed {self.seed}"]
        fitted = [f"another calibration of {robot}" for robot in self.calibrations or {}]
        return ", ".join([*seed, *(f"fault {fault}" for fault in self.faults), *self.edits, *fitted])


@dataclass(frozen=True, slots=True)
class Recorded:
    """Recorded run to be repeated.

    Attributes:
        path: Path of the log.
        label: Metadata and attachments of the log.
        events: World time [ns], robot index and host event, in order.
        states: Hash of each sample.
        lines: Transcripts by robot.
        last_ns: Time of the run's end, or of the last that is known of it [ns].
        torn: True if the end of the run may be missing.
        changes: Changes of a run that was branched off another one, in order of time.
    """

    path: Path
    label: Label
    events: Sequence[RecordedEvent]
    states: Sequence[int]
    lines: Sequence[Sequence[TextLine]]
    last_ns: int
    torn: bool
    changes: Sequence[BranchPoint] = ()

    @property
    def end_ns(self) -> int:
        """Time of the last sample [ns]."""
        return (len(self.states) - 1) * SAMPLE_NS


def read_recorded(path: Path) -> Recorded:
    """Read a recorded run from a log that has what a repetition needs."""
    channels = ("/serial", "/state", TOPIC)
    label, found, recovered = read_raw(path, lambda topic: topic.endswith(channels))
    check_line(path, label)
    states: list[int] = []
    for time_ns, hashed in decoded(path, "/state", found, read_states):
        if time_ns != len(states) * SAMPLE_NS:
            at_s = len(states) * SAMPLE_NS / NS_PER_S
            raise LogError(f"{path}: cannot be repeated: the state at {at_s:.2f} s is missing")
        states += hashed
    last_ns = (len(states) - 1) * SAMPLE_NS + _OVERTIME_NS if states and not recovered else LATEST_NS
    pieces = read_since(path, TOPIC, -1)
    next(pieces)
    events = list(events_in(path, pieces, label.robots))
    topics = [f"/{name}/serial" for name in label.robots]
    lines = [[line for _, line in decoded(path, topic, found, read_line)] for topic in topics]
    lines_ns = [line.time_ns for each in lines for line in each]
    for time_ns in (*(at_ns for at_ns, _, _ in events), *lines_ns):
        if time_ns > last_ns:
            wish = f"at most {last_ns / NS_PER_S:.2f} s, {_OVERTIME_NS // NS_PER_S} s after the last state"
            what = f"something at {time_ns / NS_PER_S:.2f} s"
            raise DecodeError(what, wish).at(path, "/host_events and /serial")
    changes, end_ns = changes_of(path, label), (len(states) - 1) * SAMPLE_NS
    # Replies may still be on their way at the end, which the last snapshot has.
    ended_ns = [time_ns for time_ns, _ in found.get(TOPIC, ()) if time_ns >= end_ns] or [end_ns, *lines_ns]
    events.sort(key=lambda each: each[0])
    return Recorded(path, label, events, states, lines, max(ended_ns), recovered, changes)


_OVERTIME_NS = 10 * NS_PER_S
"""Longest time from the last state to any event or line [ns]."""


def check_line(path: Path, label: Label) -> None:
    """Raise a `LogError` if a log has nothing of what moved its robots."""
    if PROGRAM in label.metadata:
        raise LogError(f"{path}: cannot be repeated: a program drove it; expected a log of a serial line")
    if label.metadata.get("line") == "none":
        raise LogError(
            f"{path}: cannot be repeated: its controller ran without a line, of which the log has nothing; "
            "expected a log of khep-twin run or serve"
        )


def changes_of(path: Path, label: Label) -> tuple[BranchPoint, ...]:
    """Return the changes of a run that was branched off another one; none for others."""
    try:
        changes = _CHANGES.validate_json(label.attachments.get(BRANCH, "[]"), strict=True)
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        place = ".".join(map(str, first["loc"]))
        raise DecodeError(f"{place} = {shown(first['input'])}", first["msg"]).at(path, BRANCH) from None
    if list(changes) != sorted(changes, key=lambda each: each.at_ns):
        raise DecodeError("changes out of order", "them in order of time").at(path, BRANCH)
    return changes


def changes_text(changes: Sequence[BranchPoint]) -> str:
    """Return changes as the text of an attachment."""
    return _CHANGES.dump_json(tuple(changes), indent=2).decode("utf-8") + "\n"


_CHANGES = TypeAdapter(tuple[BranchPoint, ...])


def events_in(
    path: Path, pieces: Iterable[Sequence[Entry]], robots: Sequence[str]
) -> Iterator[RecordedEvent]:
    """Yield the host events of a log's pieces, each in order of time.

    As khep_twin writes it, a piece is a chunk, with one message of each robot at most. Other tools have other
    chunks: then a piece ends before the second message of a robot, and after an event that ends it.
    """
    topics = {f"/{name}/host_events": index for index, name in enumerate(robots)}
    held: list[RecordedEvent] = []
    last: RecordedEvent | None = None
    told: set[int] = set()
    ended_in = 0
    for chunk, piece in enumerate(pieces):
        for entry in piece:
            if (index := topics.get(entry.topic)) is None:
                continue
            try:
                events = [(at_ns, index, event) for at_ns, event in read_events(entry.data)]
            except DecodeError as error:
                raise error.at(path, entry.topic, entry.time_ns) from None
            if not events:
                continue
            begin_ns, end_ns = events[0][0], events[-1][0]
            if index in told or (
                last is not None and begin_ns >= last[0] and (chunk > ended_in or end_ns > last[0])
            ):
                yield from _ordered(held, last)
                held, last, told = [], None, set[int]()
            held += events
            told.add(index)
            if events[-1][2].kind in PIECE_ENDS:
                last, ended_in = events[-1], chunk
    yield from _ordered(held, last)


def _ordered(events: list[RecordedEvent], last: RecordedEvent | None) -> list[RecordedEvent]:
    # What has ended its piece was the last of those at the same time.
    return sorted(events, key=lambda each: (each[0], each is last))
