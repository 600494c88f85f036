"""A fuzz target: logs with changed records, reassembled with valid lengths and checksums.

    python -m checks fuzz-logs -runs=1000000      with atheris (libFuzzer)

The first byte selects the use of the log, whether it is a Khepera IV's, and whether the file as a whole is
damaged at the end. The others are steps of six bytes: operation, record, position, and value. `check` states
the conditions.
"""

import atexit
import shutil
import struct
import tempfile
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache
from io import BytesIO
from pathlib import Path

from mcap.opcode import Opcode

from checks.fuzz.libfuzzer import fuzz
from checks.fuzz.log_mutations import Record, assemble_log, parse_records

MODULES = (
    "content",
    "entries",
    "decoding",
    "host_events",
    "messages",
    "reader",
    "record_bytes",
    "recover",
    "mcap_recovery",
    "snapshots",
)
"""Modules of khep_twin.log, whose branches libFuzzer looks for."""

STEP = 6
"""Size of a step [bytes]."""

ODD = [0, 1, -1, 7, 255, 256, 2**15, 2**16 - 1, 2**31 - 1, 2**31, 2**32 - 1, 2**62, 2**63 - 1, -(2**63)]
"""Boundary values."""

DAMAGED = 0x80
"""Bit of the first byte: the last step applies to the file."""

KHEPERA4 = 0x20
"""Bit of the first byte: the log is of a Khepera IV."""

SMALL = ("/scene", "/robot_description", "/channel_names")
"""Channels that are left out of the initial log, since they are slow and nothing reads them."""


@cache
def base(playpen: str = "default") -> tuple[Record, ...]:
    """Return the records of a log of two samples, with few attachments."""
    from khep_twin.ports.twin import TwinOptions, open_twin

    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "base.mcap"
        with open_twin(playpen, TwinOptions(log=str(path))) as twin:
            twin.robot.send(b"N\n")
            twin.advance_to(20_000_000)
            twin.world.log_event(0, "x")
        return tuple(small(record) for record in parse_records(path.read_bytes()))


def small(record: Record) -> Record:
    """Return a record without its long parts."""
    if record.opcode == Opcode.CHUNK:
        dropped = {
            struct.unpack_from("<H", entry.content)[0]
            for entry in record.inner
            if entry.opcode == Opcode.CHANNEL and any(name.encode() in entry.content for name in SMALL)
        }
        entries = (
            entry
            for entry in record.inner
            if entry.opcode == Opcode.SCHEMA or struct.unpack_from("<H", entry.content)[0] not in dropped
        )
        short = (shorten(entry) if entry.opcode == Opcode.SCHEMA else entry for entry in entries)
        return replace(record, inner=tuple(short))
    if record.opcode == Opcode.ATTACHMENT:
        (name,) = struct.unpack_from("<I", record.content, 16)
        (kind,) = struct.unpack_from("<I", record.content, 20 + name)
        head = record.content[: 24 + name + kind]
        return replace(record, content=head + struct.pack("<Q", 4) + b"a=1\n" + bytes(4))
    return record


def shorten(schema: Record) -> Record:
    """Return a schema without its text."""
    place = 2
    for _ in range(2):
        place += 4 + struct.unpack_from("<I", schema.content, place)[0]
    return replace(schema, content=schema.content[:place] + struct.pack("<I", 1) + b"x")


@dataclass(frozen=True)
class Step:
    """One change.

    Attributes:
        kind: Operation.
        which: Number of the record.
        place: Position in the record.
        value: Value of the change.
    """

    kind: int
    which: int
    place: int
    value: int

    def changed(self, content: bytes) -> bytes:
        """Return the content of a record, changed."""
        place = self.place % (len(content) + 1)
        number = ODD[self.value % len(ODD)]
        match self.kind % 8:
            case 0:
                return content[:place] + bytes([self.value % 256]) + content[place + 1 :]
            case 1:
                return content[:place] + struct.pack("<I", number % 2**32) + content[place + 4 :]
            case 2:
                return content[:place] + struct.pack("<Q", number % 2**64) + content[place + 8 :]
            case 3:
                return content[:place]
            case 4:
                return content[:place] + content[place + self.value % 64 :]
            case 5:
                return content[:place] + content[-(self.value % 64) :] + content[place:]
            case 6:
                odd = (float("nan"), float("inf"), -1e300, 0.5)[self.value % 4]
                return content[:place] + struct.pack("<d", odd) + content[place + 8 :]
            case _:
                return content[:place] + struct.pack("<H", self.value % 2**16) + content[place + 2 :]

    def apply(self, records: list[Record]) -> list[Record]:
        """Return records with one of them changed, removed, doubled, moved or of another kind."""
        which = self.which % len(records)
        record, rest = records[which], [*records[:which], *records[which + 1 :]]
        if record.opcode == Opcode.CHUNK and self.kind < 0xE0 and record.inner:
            inner = replace(self, which=self.value).apply(list(record.inner))
            return [*records[:which], replace(record, inner=tuple(inner)), *records[which + 1 :]]
        match self.kind // 32:
            case 7 if self.kind % 4 == 0:
                return rest or records
            case 7 if self.kind % 4 == 1:
                return [*records[:which], record, *records[which:]][:200]
            case 7 if self.kind % 4 == 2:
                return [*rest, record]
            case 7 if record.opcode != Opcode.CHUNK:
                return [*records[:which], replace(record, opcode=self.value % 16), *records[which + 1 :]]
            case 6 if record.opcode == Opcode.CHUNK:
                return [*records[:which], replace(record, size=ODD[self.value % len(ODD)])]
            case _:
                changed = replace(record, content=self.changed(record.content))
                return [*records[:which], changed, *records[which + 1 :]]


def cooked(data: bytes, first: tuple[Record, ...] | None = None) -> bytes:
    """Return the log of a recipe, made from the small log or from these records."""
    if first is None:
        first = base(playpen_of(data))
    records = list(first)
    choice, steps = data[0] if data else 0, list(struct.iter_unpack("<BBHH", whole_steps(data[1:])))
    last = steps.pop() if steps and choice & DAMAGED else None
    for step in steps:
        records = Step(*step).apply(records)
    log = assemble_log([record if record.opcode else replace(record, opcode=1) for record in records])
    if last is not None:
        kind, which, place, value = last
        log = Step(kind, 0, (which << 16 | place) % (len(log) + 1), value).changed(log)
    return log


def playpen_of(data: bytes) -> str:
    """Return the playpen of a recipe's log."""
    return "arena4" if data and data[0] & KHEPERA4 else "default"


def whole_steps(data: bytes) -> bytes:
    """Return bytes truncated to whole steps."""
    return data[: len(data) // STEP * STEP]


@cache
def folder() -> Path:
    """Return a folder for the logs, in memory if possible, which is removed with the process."""
    shared = Path("/dev/shm")
    path = Path(tempfile.mkdtemp(prefix="khep-fuzz-", dir=shared if shared.is_dir() else None))
    atexit.register(shutil.rmtree, path, ignore_errors=True)
    return path


def check(data: bytes) -> None:
    """Use one log as commands do.

    Raises:
        AssertionError: An error has several lines, or a recovered log cannot be read.
        Exception: Any error that is no KhepTwinError is a finding.
    """
    path = folder() / "x.mcap"
    path.write_bytes(cooked(data))
    use = USES[(data[0] if data else 0) % KHEPERA4 % len(USES)]
    line = error_text(use, path)
    assert line.isprintable(), line


def error_text(use: Callable[[Path], object], path: Path) -> str:
    """Return the error of a use of a log, empty for a result."""
    from khep_twin.errors import KhepTwinError

    try:
        use(path)
    except KhepTwinError as error:
        return str(error)
    return ""


def read_whole(path: Path) -> None:
    """Read a log as pictures of paths do."""
    from khep_twin.log.reader import read_end_ns, read_log

    read_log(path)
    read_end_ns(path)


def read_series(path: Path) -> None:
    """Read a log as reports and views do."""
    from khep_twin.log import reader

    reader.read_series(path)


def read_recorded(path: Path) -> None:
    """Read a log as a replay does."""
    from khep_twin.log.recorded import read_recorded_run

    read_recorded_run(path)


def export(path: Path) -> None:
    """Write a log's tables."""
    from khep_twin.lab.report import export as tables
    from khep_twin.log.reader import read_first_messages

    recording = read_first_messages(path)
    robots = tables.choose_robots(recording, None)
    channels = tables.choose_channels(recording, robots, None)
    if channels:
        tables.write_table(path, robots, channels, ".csv", BytesIO())
    tables.write_transcript(path, robots, BytesIO())


def rescue(path: Path) -> None:
    """Recover a log and read the result."""
    from khep_twin.log.reader import read_log
    from khep_twin.log.recover import recover

    recovery = recover(path)
    line = error_text(read_log, recovery.path)
    recovery.path.unlink()
    # These records are not a log of khep_twin.
    assert not line or "no log of khep_twin" in line or ": metadata: robots = " in line, line


USES: list[Callable[[Path], None]] = [read_whole, read_series, read_recorded, export, rescue]
"""Uses of a log, chosen by the first byte."""


def seeds(target: Path) -> None:
    """Write seed inputs: each use, and each kind of step."""
    write_steps(target, len(USES))


def write_steps(target: Path, n_uses: int) -> None:
    """Write seed inputs of so many uses, and of each kind of step."""
    for use in [robot | use for robot in (0, KHEPERA4) for use in range(n_uses)]:
        (target / f"use{use}").write_bytes(bytes([use]))
        for kind in range(0, 256, 24):
            step = struct.pack("<BBHH", kind, 3 * kind % 256, kind % 40, kind)
            (target / f"step{use}-{kind}").write_bytes(bytes([use]) + step)
            (target / f"file{use}-{kind}").write_bytes(bytes([use | DAMAGED]) + step * 2)


def main() -> None:
    """Run libFuzzer with options of the command line."""
    folder()
    base()
    base("arena4")
    names = [f"khep_twin.log.{name}" for name in MODULES]
    fuzz(check, seeds, names, "-max_len=61", "-len_control=0", "-rss_limit_mb=2000")
