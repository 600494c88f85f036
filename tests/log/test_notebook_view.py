"""The live view in a notebook: the data for rerun while a twin runs."""

from contextlib import closing
from pathlib import Path

import pytest
import rerun as rr
from driving import SECOND, drive
from log_contents import chunks_of

from khep_twin.errors import KhepTwinError
from khep_twin.log.recorder import LiveRecorder
from khep_twin.log.viewer.notebook import RerunWriter
from khep_twin.log.viewer.replay import view
from khep_twin.ports.twin import TwinOptions, open_twin


def entities(recording: Path) -> set[str]:
    return {chunk.entity_path for chunk in chunks_of(recording)}


def test_it_is_handed_what_a_replay_shows(tmp_path: Path) -> None:
    with rr.RecordingStream("khep_twin") as recording, open_twin("obstacles", TwinOptions(seed=3)) as twin:
        recording.save(tmp_path / "live.rrd")
        twin.record(tmp_path / "run.mcap")
        shown_live = LiveRecorder(RerunWriter(recording), twin.world, {}, flush_interval_wall_ns=SECOND // 5)
        twin.watch(shown_live)
        drive(twin)
        shown_live.flush()  # the event comes in a piece without a pose
        twin.world.log_event(0, "taken away")
    view([tmp_path / "run.mcap"], tmp_path / "replay.rrd")
    live_entities = entities(tmp_path / "live.rrd")
    assert {"/tf", "/khepera0/serial", "/khepera0/proximity"} <= live_entities
    assert live_entities >= {
        entity for entity in entities(tmp_path / "replay.rrd") if not entity.startswith("/__")
    }


def test_without_a_notebook_it_is_one_line() -> None:
    with closing(open_twin("default", TwinOptions())) as twin:
        with pytest.raises(KhepTwinError, match=r"^show\(\) draws below a cell of a notebook; expected .*$"):
            twin.show()
        assert not twin.views


class Broken(RerunWriter):
    """A view that cannot take the rest."""

    def finish(self) -> None:
        super().finish()
        raise OSError("no space left")


def test_a_log_is_completed_even_if_a_view_fails_at_the_end(tmp_path: Path) -> None:
    with rr.RecordingStream("khep_twin") as recording:
        twin = open_twin("default", TwinOptions(log=str(tmp_path / "run.mcap")))
        twin.watch(LiveRecorder(Broken(recording), twin.world, {}, flush_interval_wall_ns=SECOND))
        drive(twin)
        with pytest.raises(OSError, match="no space left"):
            twin.close()
    assert [path.name for path in tmp_path.iterdir()] == ["run.mcap"]
