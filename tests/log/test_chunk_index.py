"""The index of chunks: mcap reads from it the content of the file, and its memory stays small."""

import tracemalloc
from io import BytesIO

import numpy as np
from mcap.opcode import Opcode
from mcap.reader import make_reader
from mcap.records import MessageIndex

from khep_twin.log.batch_writer import BatchWriter
from khep_twin.log.chunk_index import ChunkIndex
from khep_twin.log.record_bytes import HEAD, RecordBytes, iterate_records, parse_record

DAY = 172_800
"""Chunks of a day of `serve`, one each half second."""


def test_the_index_says_of_each_chunk_what_the_file_holds() -> None:
    buffer, rng = BytesIO(), np.random.default_rng(1)
    writer = BatchWriter(buffer, "ros2", "a library")
    channels = [writer.channel(f"/{number}", "type", "int8 x") for number in range(5)]
    for chunk in range(1100):
        for channel in channels:
            for number in range(rng.integers(0, 3)):
                time_ns = int(chunk * 10**9 + number + channel)
                writer.add_lines(channel, [time_ns], [rng.bytes(int(rng.integers(0, 40)))])
        writer.flush()
    writer.finish()
    data = buffer.getvalue()
    summary = make_reader(BytesIO(data)).get_summary()
    assert summary is not None
    chunk_indexes = {chunk_index.chunk_start_offset: chunk_index for chunk_index in summary.chunk_indexes}
    records = RecordBytes(data)
    chunks = 0
    for opcode, start, end in iterate_records(data[8:]):
        place = start + 8 - HEAD.size
        if opcode == Opcode.CHUNK:
            chunks += 1
            chunk = chunk_indexes[place]
            head, content = records.read_chunk_head(place), records.read_chunk(place)
            assert head is not None
            assert content is not None
            times = [
                int.from_bytes(content[a + 6 : a + 14], "little")
                for code, a, _ in iterate_records(content)
                if code == 5
            ]
            assert (chunk.message_start_time, chunk.message_end_time) == (min(times), max(times))
            assert chunk.chunk_length == end - start + HEAD.size
            assert (chunk.compression, chunk.uncompressed_size) == ("zstd", len(content))
            assert chunk.compressed_size == head[4] - head[3]
            position, offsets = end + 8, dict[int, int]()
            while (index := records.read_head(position))[0] == Opcode.MESSAGE_INDEX and index[1] is not None:
                record = parse_record(Opcode.MESSAGE_INDEX, data[position + HEAD.size : index[1]])
                assert isinstance(record, MessageIndex)
                offsets[record.channel_id], position = position, index[1]
            assert chunk.message_index_offsets == offsets
            assert chunk.message_index_length == position - end - 8
    assert chunks == len(chunk_indexes)
    assert chunks > 1024


def test_a_day_of_chunks_takes_little_memory() -> None:
    rng, share = np.random.default_rng(1), DAY // 10
    lengths = rng.integers(9000, 12000, share).tolist()
    times_ns = (rng.integers(0, 3, share) * 20_000_000).tolist()
    index, place = ChunkIndex(), 0
    tracemalloc.start()
    try:
        for number, length in enumerate(lengths):
            start_ns = number * 500_000_000
            counts = {channel: 25 for channel in range(1, 9)} | {9: 20 + number % 6, 10: 1}
            index.add(place, length, 2 * length, (start_ns, start_ns + times_ns[number]), counts)
            place += length + 3500
        size = tracemalloc.get_traced_memory()[0]
    finally:
        tracemalloc.stop()
    assert len(index) == share
    assert size < 3e6 * share / DAY + 1e5
