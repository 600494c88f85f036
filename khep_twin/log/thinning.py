"""Samples of a long log, thinned while rerun reads it: three hours in full took 4 GB of memory (measured)."""

# rerun's types are partly unknown.
# pyright: reportUnknownMemberType=false, reportUnknownVariableType=false, reportUnknownArgumentType=false

from collections.abc import Iterable, Iterator
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from rerun.chunk import Chunk

SAMPLES = 180_000
"""Most samples of a channel that are shown: an hour at 50 a second, which take 1 GB of memory (measured)."""

_LINES = 2
"""Lines of the transcript that are shown where others are left out: a command and its reply."""


def interval_ns(end_ns: int) -> int:
    """Return the interval of the samples that are shown of a log that ends at a time [ns]; 0 for all."""
    return 0 if end_ns <= SAMPLES * _SAMPLE_NS else end_ns // SAMPLES


_SAMPLE_NS = 20_000_000
"""Interval of a run's samples in its log [ns]."""


class Thinner:
    """Chunks of a log with fewer rows: of each channel the first time in each interval.

    Args:
        interval_ns: Interval [ns]; 0 to leave all as it is.
        timeline: Name of the column of times.
    """

    def __init__(self, interval_ns: int, timeline: str) -> None:
        self._interval_ns, self._timeline = interval_ns, timeline
        self._last: dict[str, tuple[int, int, int]] = {}

    def passing(self, chunks: "Iterable[Chunk]") -> "Iterator[Chunk]":
        """Yield the chunks with the rows that are kept; events and what has no time are kept whole."""
        from rerun.chunk import Chunk

        for chunk in chunks:
            if chunk.is_static or not self._interval_ns or chunk.entity_path == "/events":
                yield chunk
                continue
            batch, times_ns = _times_ns(chunk, self._timeline)
            is_text = "TextLog:text" in batch.schema.names
            kept = self._kept(chunk.entity_path, times_ns, _LINES if is_text else 1)
            if len(kept) == len(times_ns):
                yield chunk
            elif len(kept):
                yield from Chunk.from_record_batch(batch.take(kept))

    def _kept(self, path: str, times_ns: NDArray[np.int64], n_times: int) -> NDArray[np.intp]:
        """Return the rows at the first `n_times` distinct times of each interval, in their order."""
        order = np.argsort(times_ns, kind="stable")
        rising = times_ns[order]
        slots = rising // self._interval_ns
        number = np.cumsum(np.diff(rising, prepend=rising[0]) > 0)
        first = np.maximum.accumulate(np.where(np.diff(slots, prepend=slots[0] - 1) > 0, number, 0))
        rank = number - first + 1
        # The first interval may have begun in an earlier chunk.
        slot, time_ns, n_before = self._last.get(path, (-1, -1, 0))
        if slots[0] == slot:
            rank[slots == slot] += n_before - (rising[0] == time_ns)
        self._last[path] = int(slots[-1]), int(rising[-1]), int(rank[-1])
        return np.sort(order[rank <= n_times])


def last_ns(chunk: "Chunk", timeline: str) -> int:
    """Return the latest time of a chunk [ns]."""
    return int(_times_ns(chunk, timeline)[1].max(initial=0))


def _times_ns(chunk: "Chunk", timeline: str) -> tuple[Any, NDArray[np.int64]]:
    batch: Any = chunk.to_record_batch()
    column = batch.column(batch.schema.get_field_index(timeline))
    return batch, column.to_numpy(zero_copy_only=False).astype(np.int64)
