"""Rescuing an interrupted log: all that is whole in it becomes a log that opens everywhere."""

import fcntl
import re
import tempfile
from dataclasses import dataclass
from pathlib import Path

from mcap.writer import Writer

from khep_twin import __version__
from khep_twin.clock import NS_PER_S
from khep_twin.errors import LogError
from khep_twin.files import open_regular, unusable
from khep_twin.log.salvage import Salvage

_PART = re.compile(r"\.part(\.[0-9]+)?$")


@dataclass(frozen=True, slots=True)
class Rescue:
    """What was rescued.

    Attributes:
        path: of the new log.
        messages: how many it holds.
        until_ns: time of the last one [ns].
        attachments: how many it holds.
        damaged: how many places in the middle could not be read.
        torn: whether the end cut off something that carried content.
    """

    path: Path
    messages: int
    until_ns: int
    attachments: int
    damaged: int
    torn: bool

    @property
    def whole(self) -> bool:
        """Whether nothing is known to be missing."""
        return not (self.damaged or self.torn)


def recover(path: Path) -> Rescue:
    """Writes what is whole in a log beside it, as NAME.mcap or, where that is taken, NAME.recovered.mcap.

    Args:
        path: of an interrupted log, NAME.mcap.part, or of a damaged one. It is left as it is.

    Raises:
        LogError: there is nothing to rescue, or the new log cannot be written.
    """
    salvage = Salvage(_content(path))
    if not (salvage.attachments or salvage.metadata or any(True for _ in salvage.messages())):
        raise LogError(f"{path}: nothing to rescue: no record of an MCAP file is whole")
    target = _target(path)
    if reason := unusable(target):
        raise LogError(f"{target}: cannot be written: {reason}")
    try:
        # Its own name comes only when it is whole, and a name that was taken meanwhile is an error.
        with tempfile.TemporaryDirectory(prefix=f".{target.name}.", dir=target.parent) as folder:
            whole = Path(folder) / target.name
            messages, until_ns = _write(salvage, whole)
            target.hardlink_to(whole)
    except OSError as error:
        raise LogError(f"{target}: cannot be written: {error.strerror}") from error
    return Rescue(target, messages, until_ns, len(salvage.attachments), salvage.damaged, salvage.torn)


def _content(path: Path) -> bytes:
    try:
        with open_regular(path) as file:
            try:
                fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
            except BlockingIOError:
                raise LogError(f"{path}: a run is writing it; right is to wait for its end") from None
            except OSError:
                pass  # some network file systems know no locks
            return file.read()
    except OSError as error:
        raise LogError(f"{path}: cannot be read: {error.strerror}") from error


def _target(path: Path) -> Path:
    """The finished log's own name, or the first one like it that is free."""
    wish = path.with_name(_PART.sub("", path.name))
    found, number = wish, 1
    while found.exists() or found.is_symlink():
        count = "" if number == 1 else f".{number}"
        found, number = wish.with_name(f"{wish.stem}.recovered{count}{wish.suffix}"), number + 1
    return found


def _write(salvage: Salvage, path: Path) -> tuple[int, int]:
    """Writes a whole file; returns how many messages it has and the time of the last [ns]."""
    count, until_ns = 0, 0
    with path.open("xb") as file:
        writer = Writer(file)
        writer.start(salvage.header.profile, salvage.header.library)
        for each in salvage.attachments:
            writer.add_attachment(each.create_time, each.log_time, each.name, each.media_type, each.data)
        for record in salvage.metadata:
            writer.add_metadata(record.name, record.metadata)
        lost = {"damaged": str(salvage.damaged), "torn": str(salvage.torn).lower()}
        writer.add_metadata("recovered", {"khep_twin": __version__, **lost})
        schemas = {0: 0} | {
            number: writer.register_schema(each.name, each.encoding, each.data)
            for number, each in salvage.schemas.items()
        }
        channels = {
            number: writer.register_channel(
                each.topic, each.message_encoding, schemas[each.schema_id], each.metadata
            )
            for number, each in salvage.channels.items()
            if each.schema_id in schemas
        }
        for message in salvage.messages():
            if message.channel_id in channels:
                channel = channels[message.channel_id]
                writer.add_message(
                    channel, message.log_time, message.data, message.publish_time, message.sequence
                )
                count, until_ns = count + 1, max(until_ns, message.log_time)
        writer.finish()
    return count, until_ns


def summary(path: Path, rescue: Rescue) -> str:
    """What was rescued from a log, in one line."""
    kept = f"{rescue.messages} messages until {rescue.until_ns / NS_PER_S:.2f} s"
    reasons = [f"{rescue.damaged} damaged places skipped"] * bool(rescue.damaged)
    reasons += ["the end is torn off"] * rescue.torn
    how = f"part: {', '.join(reasons)}" if reasons else "all that was written"
    return f"{path}: {kept}, {rescue.attachments} attachments ({how})"
