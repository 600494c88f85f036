"""Live view of a run: the log that it writes is followed and passed to rerun's viewer.

The run has no work with it and is not slowed. The view is therefore as old as the log's last write: half a
second for `serve`, five simulated seconds for a run in lock-step. Each piece is shown over the time that it
took to arrive, in steps of 40 ms, so that the picture moves smoothly.
"""

# rerun's types are partly unknown.
# pyright: reportUnknownMemberType=false, reportUnknownVariableType=false, reportUnknownArgumentType=false

import re
import tempfile
import time
from collections import defaultdict
from collections.abc import Callable, Sequence
from contextlib import suppress
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import rerun as rr
from numpy.typing import NDArray
from rerun.chunk import Chunk

from khep_twin.clock import NS_PER_S
from khep_twin.errors import LogError
from khep_twin.files.text import encodable
from khep_twin.invocation import command
from khep_twin.log.batch_writer import BatchWriter
from khep_twin.log.entries import Entry
from khep_twin.log.reader import Label
from khep_twin.log.tail import GrowingLog
from khep_twin.log.viewer.collected import Collector, times_of
from khep_twin.log.viewer.layout import Shown, layout
from khep_twin.log.viewer.process import Web, open_viewer
from khep_twin.log.viewer.replay import UNSEEN, Additions, standing_chunks

SAMPLE_NS = NS_PER_S // 25
"""Simulated time for which one sample of each channel is shown [ns]; transcripts and events are complete."""

STEP = 0.04
"""Shortest time between updates of the viewer [s of wall time]."""

LONGEST_STRETCH = 0.5
"""Longest wall time over which a piece of the log is shown [s]."""

SHARE = 0.25
"""Largest share of one processor core that is used, on average; with many robots the steps become longer."""

LAST_S = 60.0
"""Length of the curves of an unfinished run [s]."""

_TEXTS = ("rcl_interfaces/msg/Log", "std_msgs/msg/String")
_UNSEEN = re.compile("|".join(UNSEEN))
_LOG_TIMEOUT_S = 10.0
"""Longest wait for the log of a run that is started together with the viewer (assumed) [s]."""

_CHUNK_ID = b"rerun:id"


def view_live(path: Path, web: Web | None, stop: Callable[[], bool], notify: Callable[[str], None]) -> None:
    """Show an unfinished run until the viewer is closed or `stop` returns True.

    Args:
        path: Path of the log that the run writes, NAME.mcap or NAME.mcap.part.
        web: Settings of the viewer in a browser; None opens a window.
        stop: Function called now and then that returns whether to end.
        notify: Function that takes messages for the user, such as that the run has ended.

    Raises:
        LogError: There is no such log, it is finished or no log, or the viewer fails.
    """
    found = _opened(path, stop)
    if found is None:
        return
    with found as log:
        first: list[Entry] = []
        while log.label() is None and not stop():
            first = log.new()
            time.sleep(STEP)
        if stop():
            return
        with open_viewer(str(log.path), web, stop=stop) as viewer:
            recording = rr.RecordingStream("khep_twin", recording_id=f"{encodable(log.path.stem)} live")
            recording.connect_grpc(viewer.address)
            try:
                follow(log, recording, lambda: stop() or viewer.closed(), first)
                if log.finished:
                    notify(f"the run has ended; look at the whole of it: {command('view', log.path)}")
            except LogError as error:
                notify(str(error))  # the data so far can still be viewed
            try:
                viewer.wait(stop)
            finally:
                with suppress(RuntimeError):  # the connection is cut if the window was closed
                    recording.disconnect()


def follow(
    log: GrowingLog,
    recording: rr.RecordingStream,
    stop: Callable[[], bool],
    first: Sequence[Entry] = (),
) -> None:
    """Pass a log to rerun while it grows, until it is finished or `stop` returns True.

    It begins with messages that were read of it already.

    Raises:
        LogError: It turns out to be no log of khep_twin, or its run has ended without finishing it.
    """
    label: Label | None = None
    dealer = _Dealer()
    with tempfile.TemporaryDirectory(prefix="khep-twin-") as folder:
        translator = Translator(Path(folder), log.path)
        while not stop() and not (log.finished and dealer.empty()):
            began, busy = time.monotonic(), time.process_time()
            messages, first = first or log.new(), ()
            if label is None and (label := log.label()) is not None:
                recording.send_blueprint(layout([Shown(label, last_s=LAST_S)]))
                recording.send_recording_name(f"{encodable(log.path.stem)}, live")
                rr.send_chunks(standing_chunks(label), recording=recording)
            if messages and label is not None:
                standing, passing = translator.translate(messages, label)
                rr.send_chunks(standing, recording=recording)
                dealer.take(passing, began, at_once=log.behind)
            rr.send_chunks(dealer.due(began), recording=recording)
            if not log.behind:
                busy = time.process_time() - busy
                time.sleep(max(STEP - (time.monotonic() - began), busy * (1 / SHARE - 1), 0.0))


def _opened(path: Path, stop: Callable[[], bool]) -> GrowingLog | None:
    """Open the log as soon as its run has begun it, as both may be started together; None if stopped."""
    deadline = time.monotonic() + _LOG_TIMEOUT_S
    while not stop():
        try:
            return GrowingLog(path)
        except FileNotFoundError as error:
            part = path if path.suffix == ".part" else f"{path}.part"
            if not path.parent.is_dir() or time.monotonic() > deadline:
                raise LogError(
                    f"{path}: no run writes this log, there is no {part}; "
                    f"expected the --log of a run or serve that goes on"
                ) from error
            time.sleep(0.1)
    return None


class Translator:
    """Translator of a log's messages to rerun's chunks by rerun's own reader, the same as for a replay.

    The reader takes files: pieces of the log are written to a folder.
    """

    def __init__(self, folder: Path, source: Path) -> None:
        self._source = source
        self._piece = folder / "piece.mcap"
        self._slots: dict[str, int] = {}
        self._described: set[str] = set()
        self._additions: Additions | None = None

    def translate(self, messages: Sequence[Entry], label: Label) -> tuple[list[Chunk], list[Chunk]]:
        """Return the static chunks, and those with times."""
        by_topic = self._thinned(messages)
        if not by_topic:
            return [], []
        piece = BytesIO()
        writer = BatchWriter(piece, "ros2", "khep_twin")
        for topic, found in by_topic.items():
            channel = writer.channel(topic, found[0].schema, found[0].definition or "")
            writer.add_lines(channel, [each.time_ns for each in found], [each.data for each in found])
        writer.finish()
        self._piece.write_bytes(piece.getvalue())
        collector = Collector()
        chunks = list(collector.passing(self._piece, self._source))
        passing = [chunk for chunk in chunks if not chunk.is_static]
        # Each piece describes its channels; once is enough.
        standing = [chunk for chunk in chunks if chunk.is_static and chunk.entity_path not in self._described]
        self._described |= {chunk.entity_path for chunk in standing}
        if self._additions is None:
            self._additions = Additions(label, self._source)
        added = list(self._additions.chunks(collector, lambda samples: samples))
        standing += [chunk for chunk in added if chunk.is_static]
        passing += [chunk for chunk in added if not chunk.is_static]
        return standing, passing

    def _thinned(self, messages: Sequence[Entry]) -> dict[str, list[Entry]]:
        """Return the shown messages by topic: of samples the first in each SAMPLE_NS."""
        kept: defaultdict[str, list[Entry]] = defaultdict(list)
        for message in messages:
            if _UNSEEN.search(message.topic):
                continue
            if message.schema not in _TEXTS:
                slot = message.time_ns // SAMPLE_NS
                if self._slots.get(message.topic) == slot:
                    continue
                self._slots[message.topic] = slot
            kept[message.topic].append(message)
        return kept


class _Dealer:
    """Queue that spreads the data of a piece over the time until the next one."""

    def __init__(self) -> None:
        self._pending: list[tuple[Any, NDArray[np.int64]]] = []
        self._dealt_ns = -1
        self._last_ns = -1
        self._taken: float | None = None
        self._until = 0.0
        self._looked = 0.0

    def take(self, chunks: Sequence[Chunk], now: float, at_once: bool) -> None:
        """Add a piece that came now [s]; `at_once` if there is too much of it to spread it."""
        waited = 0.0 if at_once or self._taken is None else now - self._taken
        stretch = min(waited, LONGEST_STRETCH)
        self._taken, self._until = now, now + stretch
        for chunk in chunks:
            batch: Any = chunk.to_record_batch()
            facts = {key: text for key, text in batch.schema.metadata.items() if key != _CHUNK_ID}
            times_ns = times_of(batch)
            self._last_ns = max(self._last_ns, int(times_ns.max()))
            self._pending.append((batch.replace_schema_metadata(facts), times_ns))

    def due(self, now: float) -> list[Chunk]:
        """Return the chunks to be shown by now [s]."""
        # The part of the rest that corresponds to the time since the last call.
        left = self._until - self._looked
        part = 1.0 if now >= self._until else (now - self._looked) / left
        self._looked = now
        self._dealt_ns += int((self._last_ns - self._dealt_ns) * part)
        due: list[Chunk] = []
        pending: list[tuple[Any, NDArray[np.int64]]] = []
        for batch, times_ns in self._pending:
            count = int(np.searchsorted(times_ns, self._dealt_ns, side="right"))
            if count:
                due += Chunk.from_record_batch(batch.slice(0, count))
            if count < len(times_ns):
                pending.append((batch.slice(count), times_ns[count:]))
        self._pending = pending
        return due

    def empty(self) -> bool:
        """True if everything is passed on."""
        return not self._pending
