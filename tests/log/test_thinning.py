"""Long logs are shown with fewer samples: the same times of every channel, and whole exchanges."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from driving import SECOND
from log_contents import times_of
from typer.testing import CliRunner

from khep_twin.cli.app import app
from khep_twin.log.reader import read_message_batches
from khep_twin.log.viewer import thinning
from khep_twin.log.viewer.collected import TIMELINE, Collector
from khep_twin.log.viewer.thinning import LogCopy, thinning_interval_ns
from khep_twin.ports.twin import TwinOptions, open_twin


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A log of six seconds in several chunks, with a host that asks ten times a second, and an event."""
    path = tmp_path_factory.mktemp("thinning") / "run.mcap"
    with open_twin("obstacles", TwinOptions(seed=3, log=str(path))) as twin:
        assert twin.recorder is not None
        for tenth in range(1, 61):
            twin.robot.send(b"N\n")
            twin.advance_to(tenth * SECOND // 10)
            if tenth % 13 == 0:
                twin.recorder.flush()
        twin.world.log_event(0, "taken away")
    return path


def collected(log: Path, step_ns: int, folder: Path) -> tuple[Collector, list[int], list[str]]:
    """Return the collector of a copy, and times [ns] and texts of the transcript."""
    collector, times_ns, texts = Collector(), list[int](), list[str]()
    copy = folder / f"{step_ns}.mcap"
    with copy.open("wb") as file:
        writer = LogCopy(file, step_ns, ["^/state$"])
        for recording, messages in read_message_batches(log):
            writer.add(messages)
            label = recording.label
        writer.finish(label)
    for chunk in collector.collect(copy, log):
        assert chunk.entity_path != "/state"
        if chunk.entity_path == "/khepera0/serial" and not chunk.is_static:
            batch: Any = chunk.to_record_batch()
            names = batch.schema.names
            times_ns += batch.column(names.index(TIMELINE)).to_numpy(zero_copy_only=False).tolist()
            texts += batch.column(names.index("TextLog:text")).flatten().to_pylist()
    return collector, [int(time_ns) for time_ns in times_ns], texts


def test_an_hour_is_shown_whole_and_a_day_is_thinned() -> None:
    assert thinning_interval_ns(3600 * SECOND) == thinning_interval_ns(3605 * SECOND) == 0
    assert thinning_interval_ns(2 * 3600 * SECOND) == 40_000_000
    assert thinning_interval_ns(24 * 3600 * SECOND) == 480_000_000


def test_of_each_interval_the_first_sample_is_kept_in_every_channel(log: Path, tmp_path: Path) -> None:
    full, thin = collected(log, 0, tmp_path)[0], collected(log, SECOND, tmp_path)[0]
    all_samples, samples, poses = full.samples("khepera0"), thin.samples("khepera0"), thin.poses()
    assert all_samples is not None
    assert samples is not None
    assert poses is not None
    assert len(all_samples.times_ns) == 301
    _, first = np.unique(all_samples.times_ns // SECOND, return_index=True)
    assert samples.times_ns.tolist() == all_samples.times_ns[first].tolist()
    assert samples.proximity.tolist() == all_samples.proximity[first].tolist()
    assert poses.rows_at(samples.times_ns) is not None
    assert thin.events()[1] == full.events()[1] == ["[khepera0] taken away"]


def test_of_the_transcript_a_command_and_its_reply_are_kept(log: Path, tmp_path: Path) -> None:
    _, times_ns, texts = collected(log, SECOND, tmp_path)
    assert len({time_ns // SECOND for time_ns in times_ns}) == 6
    assert texts[0] == "[host] N"
    assert texts[1].startswith("[robot] n,")
    assert len(texts) <= 14


def test_a_long_log_is_reported_and_saved_with_fewer_samples(
    log: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(thinning, "MAX_SAMPLES", 12)
    result = CliRunner().invoke(app, ["view", str(log), "--save", str(tmp_path / "run.rrd")])
    assert "one sample in 0.50 s is shown, as it lasts 0:00:06" in result.stderr
    assert len(times_of(tmp_path / "run.rrd")["/khepera0/proximity"]) == 13
