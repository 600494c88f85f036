"""Recovery of an interrupted log: its intact records become a valid log."""

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
from khep_twin.files.atomic import free_name, open_regular, rename_into_place, unusable
from khep_twin.log.channels import INTEGERS
from khep_twin.log.decoding import LATEST_NS, DecodeError, read_errors, read_line, read_transforms
from khep_twin.log.entries import robot_names, run_metadata
from khep_twin.log.host_events import read_events
from khep_twin.log.mcap_recovery import IntactRecords, Progress
from khep_twin.log.messages import NUMERIC_DECODERS, REPEAT_CHANNELS, line_topics, read_samples
from khep_twin.log.record_bytes import HEAD, LARGEST_CHUNK, LARGEST_RATIO, MESSAGE
from khep_twin.log.robot_models import SAMPLED_CHANNELS
from khep_twin.log.snapshots import read_states
from khep_twin.process.machine import lock

_PART_SUFFIX = re.compile(r"\.part(\.[0-9]+)?$")
_RECOVERED_SUFFIX = "recovered"

_MAX_SIZE = LARGEST_CHUNK // 4
"""Maximum size of a message, of an attachment and of all definitions [bytes]; larger ones are omitted."""

_MAX_RATIO = LARGEST_RATIO // 4
"""Maximum compression ratio; content above it is written uncompressed, or the reader rejects it as a bomb."""


@dataclass(frozen=True, slots=True)
class Recovery:
    """Result of a recovery.

    Attributes:
        path: Path of the new log.
        n_messages: Number of recovered messages.
        end_ns: Time of the last message [ns].
        n_attachments: Number of recovered attachments.
        n_damaged: Number of parts in the middle that could not be read.
        is_truncated: True if the end cut off a record with content.
        n_refused: Number of messages and attachments omitted because the reader does not accept them.
    """

    path: Path
    n_messages: int
    end_ns: int
    n_attachments: int
    n_damaged: int
    is_truncated: bool
    n_refused: int

    @property
    def is_complete(self) -> bool:
        """True if no data is known to be missing."""
        return not (self.n_damaged or self.is_truncated or self.n_refused)


def recover(path: Path, progress: Progress = None) -> Recovery:
    """Write all intact records of a log to NAME.mcap or, if that exists, NAME.recovered.mcap, in its folder.

    Args:
        path: Path of an interrupted log, NAME.mcap.part, or of a damaged one; the file is not changed.
        progress: Function that takes the completed fraction, 0 to 1.

    Raises:
        LogError: There is no record to recover, or the new log cannot be written.
    """
    # Searching a file takes about as long as writing the new one.
    records = IntactRecords(_map_file(path), progress and (lambda share: progress(share / 2)))
    if not (records.attachments or records.metadata or any(True for _ in records.messages())):
        raise LogError(f"{path}: nothing to rescue: no record of an MCAP file is whole")
    preferred_path = path.with_name(_PART_SUFFIX.sub("", path.name))
    target = free_name(preferred_path, _RECOVERED_SUFFIX)
    if reason := unusable(target):
        raise LogError(f"{target}: cannot be written: {reason}")
    try:
        # It is renamed only when it is complete.
        with tempfile.TemporaryDirectory(prefix=f".{target.name}.", dir=target.parent) as folder:
            temporary = Path(folder) / target.name
            size, recovery = _write_recovered(records, temporary, CompressionType.ZSTD, progress)
            if size > temporary.stat().st_size * _MAX_RATIO:
                temporary.unlink()
                _, recovery = _write_recovered(records, temporary, CompressionType.NONE, progress)
            target = rename_into_place(temporary, preferred_path, None, _RECOVERED_SUFFIX)
    except OSError as error:
        raise LogError(f"{target}: cannot be written: {error.strerror}") from error
    return replace(recovery, path=target)


def _map_file(path: Path) -> bytes | mmap:
    """Map a file into memory."""
    with read_errors(path), open_regular(path) as file:
        try:
            lock(file, shared=True)
        except BlockingIOError:
            raise LogError(f"{path}: a run is writing it; expected a log whose run has ended") from None
        except OSError:
            pass  # some network file systems have no locks
        return mmap(file.fileno(), 0, access=ACCESS_READ) if os.fstat(file.fileno()).st_size else b""


def _write_recovered(
    records: IntactRecords, path: Path, compression: CompressionType, progress: Progress
) -> tuple[int, Recovery]:
    """Write a file that the reader accepts; return the size of its content [bytes] and the counts."""
    n_messages = end_ns = 0
    message_filter = _message_filter(records)
    with path.open("xb") as file:
        writer = Writer(file, compression=compression)
        writer.start(records.header.profile, records.header.library)
        attachments = [item for item in records.attachments if len(item.data) <= _MAX_SIZE and _is_text(item)]
        n_refused = len(records.attachments) - len(attachments)
        for item in attachments:
            writer.add_attachment(item.create_time, item.log_time, item.name, item.media_type, item.data)
        for record in records.metadata:
            writer.add_metadata(record.name, record.metadata)
        damage_facts = {"damaged": str(records.n_damaged), "torn": str(records.is_truncated).lower()}
        writer.add_metadata("recovered", {"khep_twin": __version__, **damage_facts})
        schemas, channels, size = _copy_definitions(records, writer)
        for message in records.messages(progress and (lambda share: progress((1 + share) / 2))):
            if message.channel_id not in channels:
                continue
            channel = records.channels[message.channel_id]
            schema = schemas.get(channel.schema_id, "")
            if len(message.data) > _MAX_SIZE or not (
                message_filter is None
                or message_filter.accepts(channel.topic, schema, message.log_time, message.data)
            ):
                n_refused += 1
                continue
            new_id = channels[message.channel_id]
            writer.add_message(new_id, message.log_time, message.data, message.publish_time, message.sequence)
            n_messages += 1
            end_ns = max(end_ns, message.log_time)
            size += HEAD.size + MESSAGE.size + len(message.data)
        writer.finish()
        file.flush()
        os.fsync(file.fileno())
    counts = len(attachments), records.n_damaged, records.is_truncated, n_refused
    return size, Recovery(path, n_messages, end_ns, *counts)


def _message_filter(records: IntactRecords) -> "MessageFilter | None":
    """Return the filter of messages that the reader accepts; None if this is no log of khep_twin."""
    try:
        return MessageFilter(robot_names(run_metadata(records.metadata)["robots"]))
    except (KeyError, DecodeError):
        return None


def _is_text(attachment: Attachment) -> bool:
    try:
        attachment.data.decode("utf-8")
    except UnicodeDecodeError:
        return attachment.name.startswith("damaged/")
    return True


def _copy_definitions(records: IntactRecords, writer: Writer) -> tuple[dict[int, str], dict[int, int], int]:
    """Define schemas and channels in `writer`; return names, new channel IDs by old ID, and size."""
    schema_ids, schema_names, channel_ids, size = {0: 0}, {0: ""}, dict[int, int](), 0
    for old_id, schema in records.schemas.items():
        size += len(schema.data)
        if old_id and size <= _MAX_SIZE:
            schema_ids[old_id] = writer.register_schema(schema.name, schema.encoding, schema.data)
            schema_names[old_id] = schema.name
    for old_id, channel in records.channels.items():
        size += len(channel.topic) + sum(map(len, chain.from_iterable(channel.metadata.items())))
        if channel.schema_id in schema_ids and size <= _MAX_SIZE:
            channel_ids[old_id] = writer.register_channel(
                channel.topic, channel.message_encoding, schema_ids[channel.schema_id], channel.metadata
            )
    return schema_names, channel_ids, size


def summary(path: Path, recovery: Recovery) -> str:
    """Summarize a recovery in one line."""
    content = f"{recovery.n_messages} messages until {recovery.end_ns / NS_PER_S:.2f} s"
    reasons = [f"{recovery.n_damaged} damaged places skipped"] * bool(recovery.n_damaged)
    reasons += ["the end is torn off"] * recovery.is_truncated
    reasons += [f"{recovery.n_refused} left out that no log has"] * bool(recovery.n_refused)
    state = f"part: {', '.join(reasons)}" if reasons else "all that was written"
    return f"{path}: {content}, {recovery.n_attachments} attachments ({state})"


class MessageFilter:
    """Filter of messages that the reader accepts."""

    def __init__(self, robots: Sequence[str]) -> None:
        self._base_frames = {f"{robot}/base" for robot in robots}
        self._line_topics = line_topics(robots)
        self._sampled_topics = {f"/{robot}/{name}" for robot in robots for name in SAMPLED_CHANNELS}
        self._widths: dict[tuple[str, str], int] = {}

    def accepts(self, topic: str, schema: str, time_ns: int, message: bytes) -> bool:
        """Return whether the reader accepts a message, of the width of the channel's first one."""
        try:
            return time_ns <= LATEST_NS and self._is_accepted(topic, schema, message)
        except DecodeError:
            return False

    def _is_accepted(self, topic: str, schema: str, message: bytes) -> bool:
        channel_name = topic.rpartition("/")[2]
        if channel_name == "host_events":
            for _ in read_events(message):
                pass
        if topic == "/state":
            read_states(message)
        if topic in self._line_topics:
            read_line(message)
        if topic == "/tf" and not self._base_frames <= read_transforms(message).keys():
            return False
        widths: dict[str, int] = {}
        if topic in self._sampled_topics:
            widths[channel_name] = read_samples([message], channel_name).shape[1]
        if schema in NUMERIC_DECODERS and not (channel_name in REPEAT_CHANNELS and schema == INTEGERS):
            widths[schema] = NUMERIC_DECODERS[schema]([message]).shape[1]
        # The first message of a channel defines the width of the later ones.
        return all(self._widths.setdefault((topic, key), width) == width for key, width in widths.items())
