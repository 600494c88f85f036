"""Live view of a run in rerun's viewer, by following the log that the run writes.

The run is not slowed down. The view is therefore as old as the last write of the log: half a second for
`serve`, five simulated seconds for a run in lock-step. Each batch of messages is shown over the time since
the previous batch, in steps of 40 ms, so that the picture moves smoothly.
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
from khep_twin.files.text import escape_surrogates
from khep_twin.log.batch_writer import BatchWriter
from khep_twin.log.channels import LINES, STRING
from khep_twin.log.entries import Entry
from khep_twin.log.reader import Label
from khep_twin.log.tail import GrowingLog
from khep_twin.log.viewer.collected import Collector, times_of
from khep_twin.log.viewer.layout import ShownLog, layout
from khep_twin.log.viewer.process import Web, open_viewer
from khep_twin.log.viewer.replay import HIDDEN_TOPICS, Additions, static_chunks
from khep_twin.process.invocation import command

SAMPLE_NS = NS_PER_S // 25
"""Simulated time per shown sample of each channel [ns]; transcripts and events are complete."""

UPDATE_INTERVAL_S = 0.04
"""Shortest time between updates of the viewer [s of wall time]."""

MAX_SPREAD_S = 0.5
"""Maximum wall time over which a batch of the log is shown [s]."""

CPU_SHARE = 0.25
"""Maximum average load on one processor core; with many robots the steps become longer."""

CURVE_LENGTH_S = 60.0
"""Length of the curves of an unfinished run [s]."""

_TEXT_SCHEMAS = LINES, STRING
_HIDDEN = re.compile("|".join(HIDDEN_TOPICS))
_LOG_TIMEOUT_S = 10.0
"""Longest wait for the log of a run that is started together with the viewer (assumed) [s]."""

_CHUNK_ID = b"rerun:id"


def view_live(path: Path, web: Web | None, stop: Callable[[], bool], notify: Callable[[str], None]) -> None:
    """Show an unfinished run until the viewer is closed or `stop` returns True.

    Args:
        path: Path of the log that the run writes, NAME.mcap or NAME.mcap.part.
        web: Settings of the viewer in a browser; None opens a window.
        stop: Function called repeatedly that returns whether to stop.
        notify: Function that takes messages for the user, e.g. at the end of the run.

    Raises:
        LogError: The log is missing, finished or invalid, or the viewer fails.
    """
    growing_log = _wait_for_log(path, stop)
    if growing_log is None:
        return
    with growing_log as log:
        first_entries: list[Entry] = []
        while log.label() is None and not stop():
            first_entries = log.read_new()
            time.sleep(UPDATE_INTERVAL_S)
        if stop():
            return
        with open_viewer(str(log.path), web, stop=stop) as viewer:
            recording = rr.RecordingStream(
                "khep_twin", recording_id=f"{escape_surrogates(log.path.stem)} live"
            )
            recording.connect_grpc(viewer.address)
            try:
                follow(log, recording, lambda: stop() or viewer.is_closed(), first_entries)
                if log.is_finished:
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
    first_entries: Sequence[Entry] = (),
) -> None:
    """Pass a log to rerun while it grows, until it is finished or `stop` returns True.

    `first_entries` are messages already read from it.

    Raises:
        LogError: The file is no log of khep_twin, or its run ended without finishing it.
    """
    label: Label | None = None
    queue = _SmoothingQueue()
    with tempfile.TemporaryDirectory(prefix="khep-twin-") as folder:
        translator = Translator(Path(folder), log.path)
        while not stop() and not (log.is_finished and queue.is_empty()):
            start_s, cpu_s = time.monotonic(), time.process_time()
            messages, first_entries = first_entries or log.read_new(), ()
            if label is None and (label := log.label()) is not None:
                recording.send_blueprint(layout([ShownLog(label, last_s=CURVE_LENGTH_S)]))
                recording.send_recording_name(f"{escape_surrogates(log.path.stem)}, live")
                rr.send_chunks(static_chunks(label), recording=recording)
            if messages and label is not None:
                static, timed = translator.translate(messages, label)
                rr.send_chunks(static, recording=recording)
                queue.add(timed, start_s, is_immediate=log.is_behind)
            rr.send_chunks(queue.release(start_s), recording=recording)
            if not log.is_behind:
                cpu_s = time.process_time() - cpu_s
                elapsed_s = time.monotonic() - start_s
                time.sleep(max(UPDATE_INTERVAL_S - elapsed_s, cpu_s * (1 / CPU_SHARE - 1), 0.0))


def _wait_for_log(path: Path, stop: Callable[[], bool]) -> GrowingLog | None:
    """Open the log as soon as its run creates it, since both may start together; None if stopped."""
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
    """Translator of messages of the log `source` to rerun's chunks, by a file in `folder` for rerun."""

    def __init__(self, folder: Path, source: Path) -> None:
        self._source = source
        self._batch_path = folder / "piece.mcap"
        self._last_intervals: dict[str, int] = {}
        self._sent_paths: set[str] = set()
        self._additions: Additions | None = None

    def translate(self, messages: Sequence[Entry], label: Label) -> tuple[list[Chunk], list[Chunk]]:
        """Return the chunks of messages of the log with this label: static ones, and ones with times."""
        by_topic = self._thin(messages)
        if not by_topic:
            return [], []
        batch = BytesIO()
        writer = BatchWriter(batch, "ros2", "khep_twin")
        for topic, entries in by_topic.items():
            channel = writer.channel(topic, entries[0].schema, entries[0].definition or "")
            writer.add_lines(channel, [entry.time_ns for entry in entries], [entry.data for entry in entries])
        writer.finish()
        self._batch_path.write_bytes(batch.getvalue())
        collector = Collector()
        chunks = list(collector.collect(self._batch_path, self._source))
        timed = [chunk for chunk in chunks if not chunk.is_static]
        # Each batch describes its channels; the first description is enough.
        static = [chunk for chunk in chunks if chunk.is_static and chunk.entity_path not in self._sent_paths]
        self._sent_paths |= {chunk.entity_path for chunk in static}
        if self._additions is None:
            self._additions = Additions(label, self._source)
        additions = list(self._additions.chunks(collector, thin=lambda samples: samples))
        static += [chunk for chunk in additions if chunk.is_static]
        timed += [chunk for chunk in additions if not chunk.is_static]
        return static, timed

    def _thin(self, messages: Sequence[Entry]) -> dict[str, list[Entry]]:
        """Return the shown messages by topic: of samples, the first in each interval of `SAMPLE_NS`."""
        by_topic: defaultdict[str, list[Entry]] = defaultdict(list)
        for message in messages:
            if _HIDDEN.search(message.topic):
                continue
            if message.schema not in _TEXT_SCHEMAS:
                interval_index = message.time_ns // SAMPLE_NS
                if self._last_intervals.get(message.topic) == interval_index:
                    continue
                self._last_intervals[message.topic] = interval_index
            by_topic[message.topic].append(message)
        return by_topic


class _SmoothingQueue:
    """Queue that spreads the data of a batch over the time until the next one."""

    def __init__(self) -> None:
        self._pending: list[tuple[Any, NDArray[np.int64]]] = []
        self._released_ns = -1
        self._last_ns = -1
        self._last_batch_s: float | None = None
        self._spread_end_s = 0.0
        self._last_release_s = 0.0

    def add(self, chunks: Sequence[Chunk], now: float, is_immediate: bool) -> None:
        """Add a batch received at `now` [s]; `is_immediate` releases all of it with the next call."""
        elapsed_s = 0.0 if is_immediate or self._last_batch_s is None else now - self._last_batch_s
        spread_s = min(elapsed_s, MAX_SPREAD_S)
        self._last_batch_s = now
        self._spread_end_s = now + spread_s
        for chunk in chunks:
            batch: Any = chunk.to_record_batch()
            metadata = {key: text for key, text in batch.schema.metadata.items() if key != _CHUNK_ID}
            times_ns = times_of(batch)
            self._last_ns = max(self._last_ns, int(times_ns.max()))
            self._pending.append((batch.replace_schema_metadata(metadata), times_ns))

    def release(self, now: float) -> list[Chunk]:
        """Return the chunks to show at `now` [s]."""
        # The fraction of the rest that corresponds to the time since the last call.
        remaining_s = self._spread_end_s - self._last_release_s
        fraction = 1.0 if now >= self._spread_end_s else (now - self._last_release_s) / remaining_s
        self._last_release_s = now
        self._released_ns += int((self._last_ns - self._released_ns) * fraction)
        chunks: list[Chunk] = []
        pending: list[tuple[Any, NDArray[np.int64]]] = []
        for batch, times_ns in self._pending:
            count = int(np.searchsorted(times_ns, self._released_ns, side="right"))
            if count:
                chunks += Chunk.from_record_batch(batch.slice(0, count))
            if count < len(times_ns):
                pending.append((batch.slice(count), times_ns[count:]))
        self._pending = pending
        return chunks

    def is_empty(self) -> bool:
        """Return whether all chunks were released."""
        return not self._pending
