"""Copies of a log with some of it changed, for tests of what comes of it."""

from collections.abc import Callable, Mapping
from pathlib import Path

from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer

Change = Callable[[str, int, bytes], bytes]
"""What a message of a topic at a time [ns] becomes."""


def rewritten(
    path: Path,
    target: Path,
    message: Change = lambda topic, time_ns, data: data,
    attachment: Callable[[str, bytes], bytes | None] = lambda name, data: data,
    facts: Mapping[str, str] | None = None,
    time: Callable[[str, int], int] = lambda topic, time_ns: time_ns,
    rename: Callable[[str], str] = lambda topic: topic,
    compression: CompressionType = CompressionType.ZSTD,
) -> Path:
    """Write a copy of a log with other messages, attachments, metadata, times or topics; return its path."""
    with path.open("rb") as file, target.open("wb") as copy:
        reader, writer = make_reader(file), Writer(copy, compression=compression)
        writer.start()
        for each in reader.iter_attachments():
            if (data := attachment(each.name, each.data)) is not None:
                writer.add_attachment(0, 0, each.name, each.media_type, data)
        for record in reader.iter_metadata():
            writer.add_metadata(record.name, {**record.metadata, **(facts or {})})
        channels: dict[str, int] = {}
        for schema, channel, each in reader.iter_messages(log_time_order=False):
            assert schema is not None
            if channel.topic not in channels:
                number = writer.register_schema(schema.name, schema.encoding, schema.data)
                channels[channel.topic] = writer.register_channel(rename(channel.topic), "cdr", number)
            data = message(channel.topic, each.log_time, each.data)
            time_ns = time(channel.topic, each.log_time)
            writer.add_message(channels[channel.topic], time_ns, data, time_ns)
        writer.finish()
    return target
