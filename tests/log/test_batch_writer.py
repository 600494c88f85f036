"""MCAP in batches, read back by the mcap package."""

from io import BytesIO

import numpy as np
import pytest
from mcap.exceptions import McapError
from mcap.reader import McapReader, NonSeekingReader, make_reader
from mcap.records import Message
from mcap.stream_reader import StreamReader

from khep_twin.log.batch_writer import BatchWriter

Written = tuple[BytesIO, list[tuple[str, int, bytes]]]
"""A file, and its topics, times and messages."""


def rows(count: int, size: int) -> np.ndarray:
    """Messages of one size that tell themselves apart."""
    return np.frombuffer(np.random.default_rng(size).bytes(count * size), f"V{size}")


@pytest.fixture
def written() -> Written:
    """Return a finished file, and its expected content as (topic, time, message)."""
    buffer = BytesIO()
    writer = BatchWriter(buffer, "ros2", "a library")
    writer.attach("note.txt", "hällo")
    writer.describe("run", {"seed": "7"})
    expected: list[tuple[str, int, bytes]] = []
    for chunk in range(3):
        times_ns = np.arange(5) * 20 + 100 * chunk
        for topic, size in (("/a", 12), ("/b", 301)):
            batch = rows(5, size)
            writer.add_rows(writer.channel(topic, f"type{size}", "int8 x"), times_ns, batch)
            expected += [(topic, int(t), row.tobytes()) for t, row in zip(times_ns, batch, strict=True)]
        lines = [b"x" * k for k in range(4)]
        writer.add_lines(
            writer.channel("/lines", "type12", "int8 x"), [100 * chunk + k for k in range(4)], lines
        )
        expected += [("/lines", 100 * chunk + k, line) for k, line in enumerate(lines)]
        writer.add_lines(writer.channel("/one", "type12", "int8 x"), [100 * chunk], [b"single"])
        expected.append(("/one", 100 * chunk, b"single"))
        writer.flush()
        writer.flush()
    writer.finish()
    buffer.seek(0)
    return buffer, expected


def found_by(reader: McapReader) -> list[tuple[str, int, bytes]]:
    return [(channel.topic, message.log_time, message.data) for _, channel, message in reader.iter_messages()]


def test_every_message_comes_back_with_and_without_the_index(written: Written) -> None:
    buffer, expected = written
    reader = make_reader(buffer, validate_crcs=True)
    messages = found_by(reader)
    assert sorted(messages) == sorted(expected)
    assert [time_ns for _, time_ns, _ in messages] == sorted(time_ns for _, time_ns, _ in expected)
    only = [message.data for _, _, message in reader.iter_messages(topics=["/b"])]
    assert only == [data for topic, _, data in expected if topic == "/b"]
    buffer.seek(0)
    assert sorted(found_by(NonSeekingReader(buffer, validate_crcs=True))) == sorted(expected)


def test_the_summary_counts_what_is_there(written: Written) -> None:
    buffer, expected = written
    reader = make_reader(buffer, validate_crcs=True)
    summary = reader.get_summary()
    assert summary is not None
    assert summary.statistics is not None
    statistics = summary.statistics
    assert (statistics.message_count, statistics.chunk_count) == (len(expected), 3)
    assert (statistics.channel_count, statistics.schema_count) == (4, 2)
    assert (statistics.message_start_time, statistics.message_end_time) == (0, 280)
    assert statistics.channel_message_counts == {1: 15, 2: 15, 3: 12, 4: 3}
    assert [(attachment.name, attachment.data.decode()) for attachment in reader.iter_attachments()] == [
        ("note.txt", "hällo")
    ]
    assert [(record.name, record.metadata) for record in reader.iter_metadata()] == [("run", {"seed": "7"})]
    assert reader.get_header().library == "a library"


def test_what_was_flushed_can_be_read_from_a_torn_file() -> None:
    buffer = BytesIO()
    writer = BatchWriter(buffer, "ros2", "a library")
    channel = writer.channel("/a", "type12", "int8 x")
    for chunk in range(3):
        writer.add_rows(channel, np.arange(10) + 10 * chunk, rows(10, 12))
        writer.flush()
    # Nothing was finished, and of the last chunk the end is missing.
    read: list[int] = []
    torn = StreamReader(BytesIO(buffer.getvalue()[:-200]))
    with pytest.raises(McapError):
        read.extend(record.log_time for record in torn.records if isinstance(record, Message))
    assert read == list(range(20))


def test_an_empty_file_is_whole() -> None:
    buffer = BytesIO()
    BatchWriter(buffer, "", "").finish()
    buffer.seek(0)
    assert list(make_reader(buffer, validate_crcs=True).iter_messages()) == []
