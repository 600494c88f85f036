"""Files that declare more than they hold: refused in a line, in little memory and without delay."""

import re
import struct
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import pytest
import zstandard
from driving import SECOND
from forked import run_python
from mcap.opcode import Opcode
from mcap.records import Footer
from mcap.writer import MCAP0_MAGIC

from checks.fuzz.log_mutations import HEAD, Record, assemble_log, bytes_of, parse_records, with_packed
from khep_twin.errors import LogError
from khep_twin.log.reader import read_end_ns, read_label, read_log, read_series
from khep_twin.log.record_bytes import LARGEST_CHUNK
from khep_twin.log.recover import recover
from khep_twin.ports.twin import TwinOptions, open_twin

SPARE = 400 << 20
"""Memory that a child may take besides what it has when it begins [bytes]."""

CHILD = f"""
import resource, sys
from pathlib import Path
from khep_twin.errors import LogError
from khep_twin.log.reader import read_log, read_label, read_series
from khep_twin.log.recover import recover
pages = int(Path("/proc/self/statm").read_text().split()[0])
limit = pages * resource.getpagesize() + {SPARE}
resource.setrlimit(resource.RLIMIT_AS, (limit, limit))
for use in (read_label, read_log, read_series, recover):
    try:
        use(Path(sys.argv[1]))
    except LogError as error:
        print(error)
"""
"""Uses a log in little memory; tells what is wrong with it."""


@pytest.fixture(scope="module")
def parts(tmp_path_factory: pytest.TempPathFactory) -> list[Record]:
    """The records of a log of a tenth of a second."""
    path = tmp_path_factory.mktemp("log") / "small.mcap"
    with open_twin("obstacles", TwinOptions(seed=3, log=str(path))) as twin:
        twin.advance_to(SECOND // 10)
    return parse_records(path.read_bytes())


@pytest.fixture(scope="module")
def bomb() -> bytes:
    """Zstandard of 2 GiB, in some 65 kB, that does not say how much it is."""
    packer = zstandard.ZstdCompressor(level=1).compressobj()
    zeros = bytes(1 << 24)
    return b"".join([*(packer.compress(zeros) for _ in range(128)), packer.flush()])


def printed_lines(path: Path) -> list[str]:
    """The lines that come of using a log in little memory."""
    process = run_python([sys.executable, "-c", CHILD, str(path)], timeout=300)
    assert (process.returncode, process.stderr) == (0, ""), process.stderr[-2000:]
    lines = process.stdout.splitlines()
    assert all(line.startswith(str(path.parent)) for line in lines), lines
    return lines


def test_a_log_put_together_again_is_the_log(parts: list[Record], tmp_path: Path) -> None:
    path = tmp_path / "again.mcap"
    path.write_bytes(assemble_log(parts))
    assert len(read_log(path).robots["khepera0"].times_ns) == 6
    assert read_end_ns(path) == SECOND // 10
    assert printed_lines(path) == []


def test_a_chunk_that_unpacks_to_gigabytes_is_refused_in_little_memory(
    parts: list[Record], bomb: bytes, tmp_path: Path
) -> None:
    assert len(bomb) < 200_000
    compressed = zstandard.ZstdCompressor(level=1).compress(bytes(1 << 27))
    lies = {
        "true": (bomb, 1 << 31),
        "small": (bomb, 1000),
        "vast": (bomb, 2**63),
        "known": (compressed, 1000),
    }
    for name, (packed, size) in lies.items():
        path = tmp_path / f"{name}.mcap"
        path.write_bytes(assemble_log(with_packed(parts, packed, size)))
        lines = printed_lines(path)
        assert len(lines) == 2, lines  # the label is whole, and so is what recover writes
        expected = f"at most {LARGEST_CHUNK}" if size > LARGEST_CHUNK else "what its size and checksum say"
        assert all(re.search(f"chunk at byte [0-9]+.*; expected .*{expected}", line) for line in lines)


@pytest.mark.long
def test_many_chunks_that_unpack_to_much_are_refused_in_time(parts: list[Record], tmp_path: Path) -> None:
    packed = zstandard.ZstdCompressor(level=1).compress(bytes(LARGEST_CHUNK))
    chunks = [Record(Opcode.CHUNK, b"", (), packed, LARGEST_CHUNK) for _ in range(200)]
    path = tmp_path / "many.mcap"
    path.write_bytes(assemble_log([*parts, *chunks]))
    began = time.process_time()
    with pytest.raises(LogError, match=r"chunks? .* expected"):
        read_log(path)
    assert time.process_time() - began < 20


def foot(data: bytes) -> tuple[int, int]:
    """Return the positions of the index and of the footer."""
    place = len(data) - len(bytes_of(Footer(0, 0, 0))) - len(MCAP0_MAGIC)
    (start,) = struct.unpack_from("<Q", data, place + HEAD.size)
    return start, place


def index(data: bytes, change: Callable[[list[tuple[int, bytes]]], Sequence[tuple[int, bytes]]]) -> bytes:
    """A log with another index."""
    start, end = foot(data)
    place, records = start, list[tuple[int, bytes]]()
    while place < end:
        opcode, size = HEAD.unpack_from(data, place)
        records.append((opcode, data[place + HEAD.size : place + HEAD.size + size]))
        place += HEAD.size + size
    changed = b"".join(HEAD.pack(opcode, len(content)) + content for opcode, content in change(records))
    return data[:start] + changed + data[end:]


def test_an_index_that_names_a_record_twice_is_refused(parts: list[Record], tmp_path: Path) -> None:
    path = tmp_path / "twice.mcap"
    path.write_bytes(index(assemble_log(parts), lambda records: [*records, *records]))
    with pytest.raises(LogError, match=r"record at byte \d+ named twice in the index; expected each once"):
        read_label(path)


@pytest.mark.parametrize("opcode", [Opcode.CHUNK_INDEX, Opcode.ATTACHMENT_INDEX, Opcode.METADATA_INDEX])
@pytest.mark.parametrize("shift", [-1, 1, 2**40])
def test_an_index_that_names_records_across_each_other_is_refused(
    parts: list[Record], tmp_path: Path, opcode: Opcode, shift: int
) -> None:
    at = 24 if opcode == Opcode.CHUNK_INDEX else 8

    def longer(records: list[tuple[int, bytes]]) -> list[tuple[int, bytes]]:
        return [
            (
                record,
                content[:at]
                + struct.pack("<Q", struct.unpack_from("<Q", content, at)[0] + shift)
                + content[at + 8 :],
            )
            if record == opcode
            else (record, content)
            for record, content in records
        ]

    path = tmp_path / "across.mcap"
    path.write_bytes(index(assemble_log(parts), longer))
    with pytest.raises(LogError, match=r"no whole log: record .* expected"):
        read_log(path)


@pytest.mark.parametrize("size", [2**20, 2**31, 2**62, 2**64 - 1])
def test_lengths_of_records_are_not_believed(parts: list[Record], tmp_path: Path, size: int) -> None:
    data = assemble_log(parts)
    start, end = foot(data)
    first = len(MCAP0_MAGIC)
    (header,) = struct.unpack_from("<Q", data, first + 1)
    attachment = first + HEAD.size + header
    for place in (start, end, attachment):
        path = tmp_path / f"{place}.mcap"
        path.write_bytes(data[: place + 1] + struct.pack("<Q", size) + data[place + 9 :])
        with pytest.raises(LogError, match=r"no whole log: .* expected"):
            read_log(path)


def test_lengths_of_texts_and_counts_are_not_believed(parts: list[Record], tmp_path: Path) -> None:
    for opcode in (Opcode.ATTACHMENT, Opcode.METADATA):
        for at in range(0, 40, 4):
            changed = [
                Record(part.opcode, part.content[:at] + b"\xff\xff\xff\x7f" + part.content[at + 4 :])
                if part.opcode == opcode
                else part
                for part in parts
            ]
            path = tmp_path / "x.mcap"
            path.write_bytes(assemble_log(changed))
            try:
                read_series(path)
            except LogError as error:
                assert len(str(error).splitlines()) == 1  # noqa: PT017


def test_what_is_recovered_of_a_bomb_can_be_read(parts: list[Record], bomb: bytes, tmp_path: Path) -> None:
    path = tmp_path / "bomb.mcap"
    path.write_bytes(assemble_log(with_packed(parts, bomb, 1 << 31)))
    recovery = recover(path)
    assert recovery.n_damaged == 1
    read_log(recovery.path)
