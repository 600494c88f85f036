"""Following a log that still grows, and its data for rerun."""

import os
import shutil
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Generator
from pathlib import Path
from urllib.parse import parse_qs, urlsplit

import numpy as np
import pytest
import rerun as rr
from driving import SECOND, drive
from forked import Forked
from log_contents import times_of
from mcap.opcode import Opcode
from mcap.writer import MCAP0_MAGIC
from rerun.chunk import Chunk

from khep_twin.errors import LogError
from khep_twin.log.entries import Entry
from khep_twin.log.tail import GrowingLog
from khep_twin.log.viewer.live import SAMPLE_NS, _SmoothingQueue, follow
from khep_twin.ports.twin import Twin


def all_of(log: GrowingLog) -> list[Entry]:
    """Return all entries that can be read now."""
    entries: list[Entry] = []
    while block := log.read_new():
        entries += block
    return entries


def test_what_a_run_writes_is_read_while_it_goes_on(start: Callable[[Path], Twin], tmp_path: Path) -> None:
    with start(tmp_path / "run.mcap") as twin, GrowingLog(tmp_path / "run.mcap") as log:
        drive(twin)
        assert twin.recorder is not None
        twin.recorder.flush()
        early = all_of(log)
        label = log.label()
        assert label is not None
        assert label.robots == ("khepera0",)
        assert not log.is_finished
        twin.advance_to(3 * SECOND)
        twin.recorder.flush()
        late = all_of(log)
    assert max(entry.time_ns for entry in early if entry.topic == "/tf") == 2_000_000_000
    assert min(entry.time_ns for entry in late if entry.topic == "/tf") == 2_020_000_000


def test_the_end_is_seen_through_the_renaming(start: Callable[[Path], Twin], tmp_path: Path) -> None:
    with start(tmp_path / "run.mcap") as twin:
        log = GrowingLog(tmp_path / "run.mcap.part")
        drive(twin)
    with log:
        entries = all_of(log)
    assert log.is_finished
    assert sum(entry.topic == "/khepera0/proximity" for entry in entries) == 101


def test_a_record_of_which_a_part_is_written_waits_for_its_rest(log: Path, tmp_path: Path) -> None:
    data = log.read_bytes()
    with _growing(tmp_path / "part", data[:5]) as growing:
        entries = all_of(growing)
        for start in range(5, len(data), 997):
            with growing.part.open("ab") as file:
                file.write(data[start : start + 997])
            entries += growing.read_new()
        with _growing(tmp_path / "whole", data) as complete:
            assert entries == all_of(complete)


def _growing(folder: Path, data: bytes) -> GrowingLog:
    folder.mkdir(exist_ok=True)
    (folder / "some.mcap.part").write_bytes(data)
    return GrowingLog(folder / "some.mcap")


def test_a_finished_log_is_viewed_without_live(log: Path) -> None:
    with pytest.raises(LogError, match=r"run\.mcap: this log is finished; to view it, leave out --live"):
        GrowingLog(log)


def test_what_is_no_log_is_one_line(tmp_path: Path) -> None:
    with _growing(tmp_path, b"hello, world") as growing, pytest.raises(LogError, match="no MCAP file"):
        growing.read_new()


def test_a_damaged_chunk_is_one_line(log: Path, tmp_path: Path) -> None:
    data = bytearray(log.read_bytes())
    place = data.index(b"zstd") + 200
    data[place] ^= 0xFF
    with _growing(tmp_path, bytes(data)) as growing, pytest.raises(LogError, match="khep-twin recover"):
        all_of(growing)


def _end_of_data(data: bytes) -> int:
    """Return the position of the first record that the end of a run writes."""
    place = len(MCAP0_MAGIC)
    while data[place] != Opcode.DATA_END:
        place += 9 + int.from_bytes(data[place + 1 : place + 9], "little")
    return place


def test_a_run_that_was_killed_is_noticed(log: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("khep_twin.log.tail._SILENCE_S", 0.0)
    data = log.read_bytes()
    # All but what the end of a run writes.
    with _growing(tmp_path, data[: _end_of_data(data)]) as growing:
        assert growing.read_new()
        with pytest.raises(LogError, match=r"ended without finishing it; to recover it: .*khep-twin recover"):
            growing.read_new()


def test_a_run_that_only_pauses_is_waited_for(
    start: Callable[[Path], Twin], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("khep_twin.log.tail._SILENCE_S", 0.0)
    with start(tmp_path / "run.mcap"), GrowingLog(tmp_path / "run.mcap") as log:
        all_of(log)
        assert log.read_new() == []


def test_a_run_is_shown_as_its_replay_is_but_25_times_a_second(
    start: Callable[[Path], Twin], tmp_path: Path
) -> None:
    with rr.RecordingStream("khep_twin", recording_id="live") as recording:
        recording.save(tmp_path / "live.rrd")
        with start(tmp_path / "run.mcap") as twin:
            log = GrowingLog(tmp_path / "run.mcap")
            follower = threading.Thread(target=follow, args=(log, recording, lambda: False))
            follower.start()
            drive(twin)
        follower.join(timeout=20)
        assert not follower.is_alive()
    with log:
        assert log.is_finished
    times = times_of(tmp_path / "live.rrd")
    once = sorted(set(times["/tf"]))
    assert once[-1] == 2_000_000_000
    assert (np.diff(once) == SAMPLE_NS).sum() >= len(once) - 2
    for topic in ("proximity", "ambient", "speed", "khepbase/proximity"):
        assert times[f"/khepera0/{topic}"] == once
    assert len(times["/khepera0/serial"]) > 30
    assert not {"/state", "/khepera0/host_events", "/khepera0/registers"} & set(times)


def test_a_piece_is_dealt_out_over_the_time_that_it_took_to_come() -> None:
    def piece(start: int) -> list[Chunk]:
        times = rr.TimeColumn(
            "message_log_time", duration=np.arange(start, start + 10, dtype="timedelta64[ns]")
        )
        return [Chunk.from_columns("/x", [times], rr.Scalars.columns(scalars=np.arange(10.0)))]

    dealer = _SmoothingQueue()
    dealer.add(piece(0), 1.0, is_immediate=False)
    assert sum(chunk.num_rows for chunk in dealer.release(1.0)) == 10
    dealer.add(piece(10), 1.4, is_immediate=False)
    dealt = [sum(chunk.num_rows for chunk in dealer.release(1.4 + 0.1 * step)) for step in range(5)]
    assert sum(dealt) == 10
    assert dealt[-1] > 0
    assert max(dealt) < 8
    assert dealer.is_empty()


@pytest.fixture
def page(log: Path, tmp_path: Path) -> "Generator[subprocess.Popen[str], None, None]":
    """`khep-twin view --web` of a log."""
    shutil.copy(log, tmp_path / "run.mcap")
    command = [sys.executable, "-m", "khep_twin", "view", "--web", "--no-browser", str(tmp_path / "run.mcap")]
    process = Forked(command, stdout=subprocess.PIPE, text=True)
    yield process
    process.kill()
    process.communicate()


def listening(port: int) -> set[str]:
    """The addresses at which somebody listens on a port, as Linux lists them."""
    lines = [
        line.split()
        for name in ("tcp", "tcp6")
        for line in Path(f"/proc/net/{name}").read_text().splitlines()
    ]
    places = [line[1].split(":") for line in lines if line[3] == "0A"]
    return {address for address, number in places if int(number, 16) == port}


@pytest.mark.skipif(sys.platform != "linux", reason="asks Linux who listens")
def test_the_page_is_for_this_machine_only_and_ends_by_ctrl_c(page: "subprocess.Popen[str]") -> None:
    assert page.stdout is not None
    address = urlsplit(page.stdout.readline().strip())
    (source,) = parse_qs(address.query)["url"]
    ports = [address.port, urlsplit(source.removeprefix("rerun+")).port]
    assert source == f"rerun+http://127.0.0.1:{ports[1]}/proxy"
    for port in ports:
        assert port is not None
        assert listening(port) == {"0100007F"}
    with socket.create_connection(("127.0.0.1", ports[0] or 0)) as client:
        client.sendall(b"GET / HTTP/1.0\r\n\r\n")
        assert client.recv(100).startswith(b"HTTP/1.0 200")
    page.send_signal(signal.SIGINT)
    assert page.wait(timeout=60) == 0
    deadline = time.monotonic() + 60
    while any(listening(port or 0) for port in ports) and time.monotonic() < deadline:
        time.sleep(0.05)
    assert not any(listening(port or 0) for port in ports)
    assert os.listdir(Path(page.args[-1]).parent) == ["run.mcap"]
