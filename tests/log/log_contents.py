"""Content of logs by the reader of mcap, and of recordings by that of rerun."""

from pathlib import Path

import numpy as np
from mcap.reader import make_reader
from mcap.records import Message
from rerun.chunk import Chunk, RrdReader


def messages_of(log: Path, *topics: str) -> list[tuple[str, Message]]:
    """Topics and messages of a log in order of time; all without topics."""
    with log.open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        return [(channel.topic, message) for _, channel, message in reader.iter_messages(topics or None)]


def chunks_of(recording: Path, blueprint: bool = False) -> list[Chunk]:
    """Chunks of a recording, or those of its layout."""
    reader = RrdReader(recording)
    (store,) = reader.blueprints() if blueprint else reader.recordings()
    return list(reader.stream(store=store))


def times_of(recording: Path) -> dict[str, list[int]]:
    """Times at which something is shown in a recording, by entity [ns]."""
    times_by_entity: dict[str, list[int]] = {}
    for chunk in chunks_of(recording):
        if not chunk.is_static:
            column = chunk.to_record_batch()["message_log_time"].to_numpy(zero_copy_only=False)
            times_by_entity.setdefault(chunk.entity_path, []).extend(column.astype(np.int64).tolist())
    return times_by_entity


def values_of(recording: Path, entity: str, component: str) -> list[tuple[int, list[float]]]:
    """Times [ns] and values of a component of an entity in a recording, in order of time."""
    rows: list[tuple[int, list[float]]] = []
    for chunk in chunks_of(recording):
        if chunk.entity_path == entity and not chunk.is_static:
            batch = chunk.to_record_batch()
            times = batch["message_log_time"].to_numpy(zero_copy_only=False).astype(np.int64)
            rows += zip(times.tolist(), batch[component].to_pylist(), strict=True)
    return sorted(rows)
