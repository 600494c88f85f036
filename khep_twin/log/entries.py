"""Messages of a log with topic and type, by the schemas and channels that its records define."""

from collections.abc import Iterator
from typing import NamedTuple

from mcap.opcode import Opcode
from mcap.records import Channel, Schema

from khep_twin.log.decoding import DecodeError
from khep_twin.log.record_bytes import MESSAGE, parsed, records_in


class Entry(NamedTuple):
    """One message.

    Attributes:
        topic: Topic of its channel.
        schema: Name of its type, empty if it has none.
        definition: Definition of its type: text for ROS 2, bytes for protobuf, None for others.
        time_ns: Log time [ns].
        data: Content as written.
    """

    topic: str
    schema: str
    definition: str | bytes | None
    time_ns: int
    data: bytes


class EntryReader:
    """Reader of messages, after the schemas and channels that define them.

    Raises:
        DecodeError: In each method: a record is invalid; `offset` is its place in the file, for the message.
    """

    def __init__(self) -> None:
        self._schemas: dict[int, Schema] = {}
        self._channels: dict[int, tuple[str, str, str | bytes | None]] = {}

    def define(self, opcode: int, content: bytes, offset: int) -> None:
        """Note a schema or a channel."""
        match parsed(opcode, content):
            case Schema() as schema:
                self._schemas.setdefault(schema.id, schema)
            case Channel() as channel:
                schema = self._schemas.get(channel.schema_id)
                if channel.schema_id and schema is None:
                    found = f"channel {channel.id} of schema {channel.schema_id} at byte {offset}"
                    raise DecodeError(found, "a schema that is defined")
                name, definition = ("", None) if schema is None else (schema.name, _definition(schema))
                self._channels.setdefault(channel.id, (channel.topic, name, definition))
            case _:
                raise DecodeError(
                    f"definition at byte {offset}", "printable names, of the lengths that they say"
                )

    def knows(self, topic: str) -> bool:
        """Return whether a channel of a topic is defined."""
        return any(known == topic for known, _, _ in self._channels.values())

    def entry(self, records: bytes, start: int, end: int, offset: int) -> Entry:
        """Return the message between two places of `records`."""
        if end - start < MESSAGE.size:
            raise DecodeError(f"message of {end - start} bytes at byte {offset}", f"at least {MESSAGE.size}")
        number, _, time_ns, _ = MESSAGE.unpack_from(records, start)
        known = self._channels.get(number)
        if known is None:
            raise DecodeError(f"message of channel {number} at byte {offset}", "a channel that is defined")
        return Entry(*known, time_ns, records[start + MESSAGE.size : end])

    def entries(self, records: bytes, offset: int, start_ns: int = 0) -> Iterator[Entry]:
        """Yield the messages of a chunk, none of which is earlier than the index says."""
        last = 0
        for opcode, start, end in records_in(records):
            last = end
            if opcode == Opcode.MESSAGE:
                entry = self.entry(records, start, end, offset)
                if entry.time_ns < start_ns:
                    found = f"message at {entry.time_ns} ns in the chunk at byte {offset}"
                    raise DecodeError(found, f"none before {start_ns} ns, as the index says")
                yield entry
            elif opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
                self.define(opcode, records[start:end], offset)
            else:
                found = f"record {opcode} in the chunk at byte {offset}"
                raise DecodeError(found, "schemas, channels and messages")
        if last != len(records):
            raise DecodeError(f"chunk at byte {offset} with half a record", "whole ones")


def _definition(schema: Schema) -> str | bytes | None:
    if schema.encoding == "ros2msg":
        return schema.data.decode("ascii", "ignore")
    return schema.data if schema.encoding == "protobuf" else None
