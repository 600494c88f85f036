"""Recovery of an interrupted log: all whole records of it become a log that opens everywhere."""

import os
import re
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import chain
from mmap import ACCESS_READ, mmap
from pathlib import Path

from mcap.records import Attachment
from mcap.writer import CompressionType, Writer

from khep_twin import __version__
from khep_twin.clock import NS_PER_S
from khep_twin.errors import LogError
from khep_twin.files.atomic import free_name, open_regular, put, unusable
from khep_twin.log.channels import INTEGERS
from khep_twin.log.decoding import LATEST_NS, DecodeError, read_line, read_transforms, readable
from khep_twin.log.entries import robot_names, run_facts
from khep_twin.log.host_events import read_events
from khep_twin.log.mcap_recovery import Progress, WholeRecords
from khep_twin.log.messages import FOR_REPEAT, READERS, WIDTHS, line_topics, read_samples
from khep_twin.log.record_bytes import HEAD, LARGEST_CHUNK, LARGEST_RATIO, MESSAGE
from khep_twin.log.snapshots import read_states
from khep_twin.machine import lock

_PART = re.compile(r"\.part(\.[0-9]+)?$")
_WORD = "recovered"


@dataclass(frozen=True, slots=True)
class Recovery:
    """Result of a recovery.

    Attributes:
        path: Path of the new log.
        messages: Number of messages in it.
        until_ns: Time of the last one [ns].
        attachments: Number of attachments in it.
        damaged: Number of parts in the middle that could not be read.
        torn: True if the end cut off a record with content.
        refused: Number of messages and attachments left out, as no reader of logs accepts them.
    """

    path: Path
    messages: int
    until_ns: int
    attachments: int
    damaged: int
    torn: bool
    refused: int

    @property
    def whole(self) -> bool:
        """True if nothing is known to be missing."""
        return not (self.damaged or self.torn or self.refused)


def recover(path: Path, progress: Progress = None) -> Recovery:
    """Write all whole records of a log beside it, as NAME.mcap or, if that exists, NAME.recovered.mcap.

    Args:
        path: Path of an interrupted log, NAME.mcap.part, or of a damaged one. It is not changed.
        progress: Function that takes the share that is done, 0 to 1.

    Raises:
        LogError: There is nothing to recover, or the new log cannot be written.
    """
    # Searching a file takes about as long as writing the new one.
    records = WholeRecords(_content(path), progress and (lambda share: progress(share / 2)))
    if not (records.attachments or records.metadata or any(True for _ in records.messages())):
        raise LogError(f"{path}: nothing to rescue: no record of an MCAP file is whole")
    wanted = path.with_name(_PART.sub("", path.name))
    target = free_name(wanted, _WORD)
    if reason := unusable(target):
        raise LogError(f"{target}: cannot be written: {reason}")
    try:
        # It is renamed only when it is whole.
        with tempfile.TemporaryDirectory(prefix=f".{target.name}.", dir=target.parent) as folder:
            whole = Path(folder) / target.name
            size, recovery = _write(records, whole, CompressionType.ZSTD, progress)
            if size > whole.stat().st_size * _RATIO:
                whole.unlink()
                _, recovery = _write(records, whole, CompressionType.NONE, progress)
            target = put(whole, wanted, None, _WORD)
    except OSError as error:
        raise LogError(f"{target}: cannot be written: {error.strerror}") from error
    return replace(recovery, path=target)


def _content(path: Path) -> bytes | mmap:
    """Return a file as a memory map."""
    with readable(path), open_regular(path) as file:
        try:
            lock(file, shared=True)
        except BlockingIOError:
            raise LogError(f"{path}: a run is writing it; expected a log whose run has ended") from None
        except OSError:
            pass  # some network file systems have no locks
        return mmap(file.fileno(), 0, access=ACCESS_READ) if os.fstat(file.fileno()).st_size else b""


def _write(
    records: WholeRecords, path: Path, compression: CompressionType, progress: Progress
) -> tuple[int, Recovery]:
    """Write a file that our reader accepts; return the size of its content [bytes] and what is in it."""
    messages = until_ns = 0
    message_filter = _message_filter(records)
    with path.open("xb") as file:
        writer = Writer(file, compression=compression)
        writer.start(records.header.profile, records.header.library)
        attachments = [each for each in records.attachments if len(each.data) <= _LARGEST and _is_text(each)]
        refused = len(records.attachments) - len(attachments)
        for each in attachments:
            writer.add_attachment(each.create_time, each.log_time, each.name, each.media_type, each.data)
        for record in records.metadata:
            writer.add_metadata(record.name, record.metadata)
        lost = {"damaged": str(records.damaged), "torn": str(records.torn).lower()}
        writer.add_metadata("recovered", {"khep_twin": __version__, **lost})
        schemas, channels, size = _defined(records, writer)
        for message in records.messages(progress and (lambda share: progress((1 + share) / 2))):
            if message.channel_id not in channels:
                continue
            channel = records.channels[message.channel_id]
            schema = schemas.get(channel.schema_id, "")
            if len(message.data) > _LARGEST or not (
                message_filter is None
                or message_filter.accepts(channel.topic, schema, message.log_time, message.data)
            ):
                refused += 1
                continue
            number = channels[message.channel_id]
            writer.add_message(number, message.log_time, message.data, message.publish_time, message.sequence)
            messages += 1
            until_ns = max(until_ns, message.log_time)
            size += HEAD.size + MESSAGE.size + len(message.data)
        writer.finish()
        file.flush()
        os.fsync(file.fileno())
    counts = len(attachments), records.damaged, records.torn, refused
    return size, Recovery(path, messages, until_ns, *counts)


_LARGEST = LARGEST_CHUNK // 4
"""Most bytes of a message, of an attachment and of all definitions that are kept."""

_RATIO = LARGEST_RATIO // 4
"""Highest compression ratio; content above it is kept unpacked, as the reader takes it for a bomb."""


def _message_filter(records: WholeRecords) -> "MessageFilter | None":
    """Return the filter of messages that our reader accepts; None if this is no log of khep_twin."""
    try:
        return MessageFilter(robot_names(run_facts(records.metadata)["robots"]))
    except (KeyError, DecodeError):
        return None


def _is_text(attachment: Attachment) -> bool:
    try:
        attachment.data.decode("utf-8")
    except UnicodeDecodeError:
        return attachment.name.startswith("damaged/")
    return True


def _defined(records: WholeRecords, writer: Writer) -> tuple[dict[int, str], dict[int, int], int]:
    """Define schemas and channels; return names of schemas, channels by their old numbers, and a size."""
    numbers, names, channels, size = {0: 0}, {0: ""}, dict[int, int](), 0
    for number, schema in records.schemas.items():
        size += len(schema.data)
        if number and size <= _LARGEST:
            numbers[number] = writer.register_schema(schema.name, schema.encoding, schema.data)
            names[number] = schema.name
    for number, each in records.channels.items():
        size += len(each.topic) + sum(map(len, chain.from_iterable(each.metadata.items())))
        if each.schema_id in numbers and size <= _LARGEST:
            channels[number] = writer.register_channel(
                each.topic, each.message_encoding, numbers[each.schema_id], each.metadata
            )
    return names, channels, size


def summary(path: Path, recovery: Recovery) -> str:
    """Return the result of a recovery in one line."""
    kept = f"{recovery.messages} messages until {recovery.until_ns / NS_PER_S:.2f} s"
    reasons = [f"{recovery.damaged} damaged places skipped"] * bool(recovery.damaged)
    reasons += ["the end is torn off"] * recovery.torn
    reasons += [f"{recovery.refused} left out that no log has"] * bool(recovery.refused)
    how = f"part: {', '.join(reasons)}" if reasons else "all that was written"
    return f"{path}: {kept}, {recovery.attachments} attachments ({how})"


class MessageFilter:
    """Filter of messages that the reader accepts."""

    def __init__(self, robots: Sequence[str]) -> None:
        self._bases = {f"{robot}/base" for robot in robots}
        self._line_topics = line_topics(robots)
        self._sampled = {f"/{robot}/{name}" for robot in robots for name in WIDTHS}
        self._widths: dict[tuple[str, str], int] = {}

    def accepts(self, topic: str, schema: str, time_ns: int, message: bytes) -> bool:
        """Return whether the reader accepts a message after those passed before."""
        try:
            return time_ns <= LATEST_NS and self._fits(topic, schema, message)
        except DecodeError:
            return False

    def _fits(self, topic: str, schema: str, message: bytes) -> bool:
        name = topic.rpartition("/")[2]
        if name == "host_events":
            for _ in read_events(message):
                pass
        if topic == "/state":
            read_states(message)
        if topic in self._line_topics:
            read_line(message)
        if topic == "/tf" and not self._bases <= read_transforms(message).keys():
            return False
        widths: dict[str, int] = {}
        if topic in self._sampled:
            widths[name] = read_samples([message], name).shape[1]
        if schema in READERS and not (name in FOR_REPEAT and schema == INTEGERS):
            widths[schema] = READERS[schema]([message]).shape[1]
        # The first message of a channel defines the width of the others.
        return all(self._widths.setdefault((topic, of), width) == width for of, width in widths.items())
