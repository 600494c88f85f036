"""Content of a log: its messages, and its label, i.e. its metadata and attachments."""

import re
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

from mcap.opcode import Opcode
from mcap.records import Channel, Metadata, Schema

from khep_twin.files.toml_files import NAME_RULE
from khep_twin.log.decoding import DecodeError, printable
from khep_twin.log.record_bytes import MESSAGE, iterate_records, parse_record

_ROBOT_NAMES = re.compile(r"[A-Za-z0-9_-]{1,64}(,[A-Za-z0-9_-]{1,64}){0,999}")


class Entry(NamedTuple):
    """One message; in MCAP, its channel has a topic, and a schema that defines the message type.

    Attributes:
        topic: Topic of its channel.
        schema: Name of its type, empty if it has none.
        definition: Definition of its type for ROS 2; None for others.
        time_ns: Log time [ns].
        data: Content as written.
    """

    topic: str
    schema: str
    definition: str | None
    time_ns: int
    data: bytes


class EntryReader:
    """Parser of messages, by the schemas and channels before them.

    Args:
        topic_filter: Function that returns whether to yield the messages of a topic; None for all.

    Attributes:
        n_skipped: Number of messages that were not yielded.

    Raises:
        DecodeError: In each method: a record is invalid; `offset` is its file offset in the error message.
    """

    def __init__(self, topic_filter: Callable[[str], bool] | None = None) -> None:
        self._topic_filter = topic_filter
        self._skipped_channels: set[int] = set()
        self.n_skipped = 0
        self._schemas: dict[int, Schema] = {}
        self._channels: dict[int, tuple[str, str, str | None]] = {}

    def define(self, opcode: int, content: bytes, offset: int) -> None:
        """Store a schema or a channel."""
        match parse_record(opcode, content):
            case Schema() as schema:
                self._schemas.setdefault(schema.id, schema)
            case Channel() as channel:
                schema = self._schemas.get(channel.schema_id)
                if channel.schema_id and schema is None:
                    actual = f"channel {channel.id} of schema {channel.schema_id} at byte {offset}"
                    raise DecodeError(actual, "a schema that is defined")
                name, definition = ("", None) if schema is None else (schema.name, _definition(schema))
                topic, *_ = self._channels.setdefault(channel.id, (channel.topic, name, definition))
                if self._topic_filter is not None and not self._topic_filter(topic):
                    self._skipped_channels.add(channel.id)
            case _:
                expected = "printable names, of the lengths that they say"
                raise DecodeError(f"definition at byte {offset}", expected)

    @property
    def n_channels(self) -> int:
        """Number of defined channels."""
        return len(self._channels)

    def has_channel(self, topic: str) -> bool:
        """Return whether a channel of a topic is defined."""
        return any(channel_topic == topic for channel_topic, _, _ in self._channels.values())

    def parse_entries(self, records: bytes, offset: int, start_ns: int = 0) -> Iterator[Entry]:
        """Yield the messages of a chunk; none may be earlier than `start_ns`, its start in the index."""
        last_end, message_opcode, skipped = 0, int(Opcode.MESSAGE), self._skipped_channels
        # Local names are faster, which matters for millions of messages.
        unpack, size, channels = MESSAGE.unpack_from, MESSAGE.size, self._channels
        for opcode, start, end in iterate_records(records):
            last_end = end
            if opcode == message_opcode:
                if end - start < size:
                    raise DecodeError(f"message of {end - start} bytes at byte {offset}", f"at least {size}")
                channel_id, _, time_ns, _ = unpack(records, start)
                if channel_id in skipped:
                    self.n_skipped += 1
                    continue
                if channel_id not in channels:
                    actual = f"message of channel {channel_id} at byte {offset}"
                    raise DecodeError(actual, "a channel that is defined")
                if time_ns < start_ns:
                    actual = f"message at {time_ns} ns in the chunk at byte {offset}"
                    raise DecodeError(actual, f"none before {start_ns} ns, as the index says")
                content = *channels[channel_id], time_ns, records[start + size : end]
                # Faster than Entry(...).
                yield tuple.__new__(Entry, content)  # pyright: ignore[reportUnknownMemberType]
            elif opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
                self.define(opcode, records[start:end], offset)
            else:
                actual = f"record {opcode} in the chunk at byte {offset}"
                raise DecodeError(actual, "schemas, channels and messages")
        if last_end != len(records):
            raise DecodeError(f"chunk at byte {offset} with half a record", "whole ones")


def _definition(schema: Schema) -> str | None:
    return schema.data.decode("ascii", "ignore") if schema.encoding == "ros2msg" else None


@dataclass(frozen=True, slots=True)
class Label:
    """Metadata and attachments of a log.

    Attributes:
        metadata: Seed, versions, settings.
        attachments: Texts playpen.toml, scene.xml, configuration.json, calibration/*.toml, controller/*.py or
            controller/*.json.
        robots: Names of the robots.
    """

    metadata: Mapping[str, str]
    attachments: Mapping[str, str]
    robots: tuple[str, ...]


def make_label(path: Path, metadata: Mapping[str, str], attachments: Mapping[str, str]) -> Label:
    """Return the label of a log; the metadata names the robots."""
    try:
        return Label(metadata, attachments, robot_names(metadata["robots"]))
    except DecodeError as error:
        raise error.to_log_error(path, "metadata") from None


def run_metadata(records: Iterable[Metadata]) -> dict[str, str]:
    """Return the metadata of the run."""
    return {key: text for record in records if record.name == "run" for key, text in record.metadata.items()}


def robot_names(text: str) -> tuple[str, ...]:
    """Return the names of a log's robots from their comma-separated list in its metadata."""
    if not _ROBOT_NAMES.fullmatch(text):
        raise DecodeError(f"robots = {printable(text)}", f"names with commas between, each {NAME_RULE}")
    names = tuple(text.split(","))
    if len(set(names)) < len(names):
        raise DecodeError(f"robots = {printable(text)}", "each name once")
    return names
