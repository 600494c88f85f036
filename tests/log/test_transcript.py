"""Transcripts: the lines of a log are in the order of their ends, also across its flushes and branches."""

from itertools import pairwise
from pathlib import Path

import pytest
from log_rewriting import REWRITINGS, rewritten

from khep_twin.lab.experiment.branch import BranchPlan, branch
from khep_twin.lab.experiment.repeat import repeat
from khep_twin.log.reader import read_log, read_raw
from khep_twin.log.recorded import BranchPoint, read_recorded_run
from khep_twin.log.recover import recover
from khep_twin.log.snapshots import SNAPSHOT_NS, SNAPSHOT_TOPIC, read_snapshot
from khep_twin.log.transcript import Transcript
from khep_twin.ports.resume import run_end_ns
from khep_twin.ports.twin import TwinOptions, open_twin
from khep_twin.robots.framing import LINES

MS = 1_000_000


class Lines:
    """Sink of lines."""

    def __init__(self) -> None:
        self.times_ns: list[int] = []

    def add_lines(self, topic: str, times_ns: list[int], messages: list[bytes]) -> None:
        """Keep the times."""
        assert len(messages) == len(times_ns)
        self.times_ns += times_ns


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Log whose host sends before the reply is complete, also at the snapshot and at the end."""
    path = tmp_path_factory.mktemp("log") / "run.mcap"
    with open_twin("default", TwinOptions(log=str(path))) as twin:
        for start_ns in (0, SNAPSHOT_NS - 10 * MS, SNAPSHOT_NS + 300 * MS):
            twin.advance_to(start_ns)
            twin.robot.send(b"N\nB\n")
            twin.advance_to(start_ns + 8 * MS)
            twin.robot.send(b"D,1,1\n")
            twin.advance_to(start_ns + 12 * MS)
            twin.robot.send(b"G,")
            twin.advance_to(start_ns + 14 * MS)
    return path


def serial_messages(path: Path) -> list[tuple[int, bytes]]:
    """Return times [ns] and bytes of the transcript in the order of the file."""
    return read_raw(path, lambda topic: topic.endswith("/serial"))[1]["/khepera0/serial"]


def test_lines_are_written_at_the_first_write_after_their_end() -> None:
    lines = Lines()
    transcript = Transcript(lines, {"khepera0": LINES})
    transcript.on_bytes(5, 0, False, b"n,1\r\nb,1\r\n")
    transcript.on_bytes(3, 0, True, b"N\nG")
    transcript.write(4)
    assert (lines.times_ns, [line[0] for line in transcript.early_lines]) == ([3], [5, 5])
    transcript.on_bytes(4, 0, True, b",1\nD")
    transcript.finish(4)
    assert lines.times_ns == [3, 4, 4, 5, 5]


def test_a_host_that_sends_before_the_reply_is_complete_leaves_a_log_in_order_of_time(log: Path) -> None:
    times_ns = [time_ns for time_ns, _ in serial_messages(log)]
    assert all(first <= second for first, second in pairwise(times_ns))
    # A reply is on the line at the snapshot, and at the end.
    snapshot = read_raw(log, lambda topic: topic == SNAPSHOT_TOPIC)[1][SNAPSHOT_TOPIC][0][1]
    assert len(read_snapshot(snapshot, None).recorder.early_lines) == 2
    assert times_ns[-1] > run_end_ns(log)
    assert [line.time_ns for line in read_log(log).robots["khepera0"].serial] == times_ns
    assert repeat(read_recorded_run(log)) is None


def test_a_branch_has_the_lines_that_were_on_their_way_at_its_snapshot(log: Path, tmp_path: Path) -> None:
    path = tmp_path / "branch.mcap"
    branch(BranchPlan(log, BranchPoint(SNAPSHOT_NS + 100 * MS)), path)
    assert serial_messages(path) == serial_messages(log)
    assert repeat(read_recorded_run(path)) is None


@pytest.mark.parametrize("order", ["in order of time", "shuffled"])
def test_a_log_in_another_order_has_the_same_transcript(log: Path, tmp_path: Path, order: str) -> None:
    path = rewritten(log, tmp_path / "run.mcap", **REWRITINGS[order])
    assert read_log(path).robots["khepera0"].serial == read_log(log).robots["khepera0"].serial
    assert repeat(read_recorded_run(path)) is None


def test_a_log_that_is_cut_off_is_recovered_in_order_of_time_and_repeated(log: Path, tmp_path: Path) -> None:
    part = tmp_path / "run.mcap.part"
    part.write_bytes(log.read_bytes()[: log.stat().st_size // 2])
    path = recover(part).path
    times_ns = [time_ns for time_ns, _ in serial_messages(path)]
    assert times_ns == sorted(times_ns)
    assert len(times_ns) < len(serial_messages(log))
    assert repeat(read_recorded_run(path)) is None
