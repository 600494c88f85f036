"""Changed copies of a log, for tests of their readers."""

import random
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from mcap.reader import make_reader
from mcap.writer import CompressionType, IndexType, Writer

Change = Callable[[str, int, bytes], bytes]
"""What a message of a topic at a time [ns] becomes."""


def rewritten(
    path: Path,
    target: Path,
    message: Change = lambda topic, time_ns, data: data,
    attachment: Callable[[str, bytes], bytes | None] = lambda name, data: data,
    facts: Mapping[str, str] | None = None,
    metadata: Callable[[str], bool] = lambda name: True,
    time: Callable[[str, int], int] = lambda topic, time_ns: time_ns,
    rename: Callable[[str], str] = lambda topic: topic,
    order: Callable[[list[Any]], Sequence[Any]] = lambda messages: messages,
    **written: Any,
) -> Path:
    """Write a copy of a log with other messages, attachments, metadata, times or topics; return its path.

    `order` puts schemas, channels and messages in another order; others are arguments of the writer.
    """
    with path.open("rb") as file, target.open("wb") as copy:
        reader, writer = make_reader(file), Writer(copy, **written)
        writer.start()
        for original in reader.iter_attachments():
            if (data := attachment(original.name, original.data)) is not None:
                writer.add_attachment(0, 0, original.name, original.media_type, data)
        for record in filter(lambda metadata_record: metadata(metadata_record.name), reader.iter_metadata()):
            writer.add_metadata(record.name, {**record.metadata, **(facts or {})})
        channels: dict[str, int] = {}
        for schema, channel, original in order([*reader.iter_messages(log_time_order=False)]):
            assert schema is not None
            if channel.topic not in channels:
                number = writer.register_schema(schema.name, schema.encoding, schema.data)
                channels[channel.topic] = writer.register_channel(rename(channel.topic), "cdr", number)
            data = message(channel.topic, original.log_time, original.data)
            time_ns = time(channel.topic, original.log_time)
            writer.add_message(channels[channel.topic], time_ns, data, time_ns)
        writer.finish()
    return target


def _by_time(messages: list[Any]) -> list[Any]:
    return sorted(messages, key=lambda message: message[2].log_time)


def _shuffled(messages: list[Any]) -> list[Any]:
    return random.Random(1).sample(messages, len(messages))


BARE = {
    "index_types": IndexType.NONE,
    "repeat_channels": False,
    "repeat_schemas": False,
    "use_statistics": False,
    "use_summary_offsets": False,
}
"""Arguments of a writer that leaves out all that MCAP does not require."""

REWRITINGS: dict[str, dict[str, Any]] = {
    "no chunks": {"use_chunking": False},
    "no statistics": {"use_statistics": False},
    "no metadata index": {"index_types": IndexType.ALL ^ IndexType.METADATA},
    "no attachment index": {"index_types": IndexType.ALL ^ IndexType.ATTACHMENT},
    "no chunk index": {"index_types": IndexType.ALL ^ IndexType.CHUNK},
    "no message index": {"index_types": IndexType.ALL ^ IndexType.MESSAGE},
    "no schemas in the summary": {"repeat_schemas": False},
    "no channels in the summary": {"repeat_channels": False},
    "no summary": BARE,
    "no chunks and no summary": {**BARE, "use_chunking": False},
    "lz4": {"compression": CompressionType.LZ4},
    "not compressed": {"compression": CompressionType.NONE, "enable_crcs": False},
    "tiny chunks": {"chunk_size": 500},
    "one chunk": {"chunk_size": 1 << 25},
    "in order of time": {"order": _by_time},
    "in order of time and tiny chunks": {"order": _by_time, "chunk_size": 500, **BARE},
    "shuffled": {"order": _shuffled, "chunk_size": 5000},
    "shuffled without chunks or summary": {**BARE, "order": _shuffled, "use_chunking": False},
}
"""What other tools may make of a log, by arguments of `rewritten`."""
