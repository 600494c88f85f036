"""Recovery: all complete records are kept, losses are reported, no file is half-written."""

import os
import random
import re
import signal
import struct
import subprocess
import sys
import time
from pathlib import Path

import pytest
import zstandard
from command_line import khep_twin
from driving import COMMANDS, SECOND
from forked import Forked
from log_contents import messages_of
from log_rewriting import rewritten
from mcap.reader import make_reader
from mcap.writer import MCAP0_MAGIC, Writer

from khep_twin.errors import LogError
from khep_twin.log.cdr import CDR_HEADER
from khep_twin.log.log_file import PartFile
from khep_twin.log.mcap_recovery import IntactRecords
from khep_twin.log.reader import read_log, read_series
from khep_twin.log.recover import Recovery, recover, summary
from khep_twin.ports.twin import TwinOptions, open_twin

ATTACHMENTS = ["playpen.toml", "scene.xml", "configuration.json", "calibration/khepera0.toml"]


@pytest.fixture(scope="module")
def long_log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A log of several chunks."""
    path = tmp_path_factory.mktemp("logs") / "run.mcap"
    with open_twin("obstacles", TwinOptions(seed=3, log=str(path))) as twin:
        for _ in range(3):
            for command in COMMANDS:
                twin.robot.send(command)
                twin.advance_to(twin.world.time_ns + SECOND)
            twin.world.log_event(None, "so far")
            twin.advance_to(twin.world.time_ns + SECOND)
    return path


def rescued(folder: Path, data: bytes) -> Recovery | None:
    """Return the recovery of these bytes, after its file was read."""
    part = folder / "torn.mcap.part"
    part.write_bytes(data)
    target = folder / "torn.mcap"
    target.unlink(missing_ok=True)
    try:
        recovery = recover(part)
    except LogError:
        assert os.listdir(folder) == [part.name]
        return None
    assert sorted(os.listdir(folder)) == [target.name, part.name]
    assert part.read_bytes() == data
    assert len(messages_of(target)) == recovery.n_messages
    return recovery


def test_a_finished_log_is_copied_message_by_message(tmp_path: Path, long_log: Path) -> None:
    path = tmp_path / "run.mcap"
    path.write_bytes(long_log.read_bytes())
    recovery = recover(path)
    assert recovery.path == tmp_path / "run.recovered.mcap"
    assert recovery.is_complete
    assert recovery.end_ns == 12 * SECOND
    before, after = messages_of(path), messages_of(recovery.path)
    assert [(topic, message.log_time, message.data) for topic, message in before] == [
        (topic, message.log_time, message.data) for topic, message in after
    ]
    assert read_log(recovery.path).attachments == read_log(path).attachments
    assert read_log(recovery.path).metadata == read_log(path).metadata
    assert recover(path).path == tmp_path / "run.recovered.2.mcap"


@pytest.mark.share(2)
@pytest.mark.parametrize("cuts", [20, 300])
def test_more_bytes_never_give_fewer_messages(cuts: int, tmp_path: Path, long_log: Path) -> None:
    data = long_log.read_bytes()
    points = [*sorted(random.Random(1).sample(range(len(data)), cuts)), len(data)]
    before, opened = (0, 0), 0
    for point in points:
        records = IntactRecords(data[:point])
        now = sum(1 for _ in records.messages()), len(records.attachments)
        assert now >= before, point
        assert now[1] >= before[1], point
        before = now
    # Opening each takes its time: every third, and what is in it is what was there.
    originals = [(topic, message.log_time, message.data) for topic, message in messages_of(long_log)]
    original_set = set(originals)
    for point in points[::3]:
        if (recovery := rescued(tmp_path, data[:point])) is None:
            continue
        opened += 1
        recovered = messages_of(recovery.path)
        assert {(topic, message.log_time, message.data) for topic, message in recovered} <= original_set
        if recovery.n_messages:
            run = read_log(recovery.path)
            assert list(run.attachments) == ATTACHMENTS
            assert run.metadata["playpen"] == "obstacles"
    assert opened > cuts // 5
    assert before[0] == len(originals)


@pytest.mark.share(2)
@pytest.mark.parametrize("flips", [40, 300])
def test_flipped_bytes_lose_what_they_hit_and_nothing_false_is_kept(flips: int, long_log: Path) -> None:
    data = long_log.read_bytes()
    originals = {(topic, message.log_time, message.data) for topic, message in messages_of(long_log)}
    time_data = {original[1:] for original in originals}
    rng = random.Random(2)
    for _ in range(flips):
        place = rng.randrange(8, len(data))
        damaged = bytearray(data)
        damaged[place] ^= 1 << rng.randrange(8)
        records = IntactRecords(bytes(damaged))
        # Channels are named in the summary, too: only the chunk that was hit is lost.
        recovered = {
            (records.channels[message.channel_id].topic, message.log_time, message.data)
            for message in records.messages()
        }
        assert len(recovered) >= len(originals) * 0.4, place
        assert sum(not name.name.startswith("damaged/") for name in records.attachments) >= 3, place
        if records.n_damaged == 0 and not records.is_truncated:
            assert len(recovered) == len(originals), place
        assert {message[1:] for message in recovered} <= time_data, place


def test_damage_in_the_middle_is_skipped_and_said(tmp_path: Path, long_log: Path) -> None:
    data = bytearray(long_log.read_bytes())
    place = len(data) * 2 // 5  # in a chunk
    data[place : place + 40] = bytes(40)
    recovery = rescued(tmp_path, bytes(data))
    assert recovery is not None
    assert (recovery.n_damaged, recovery.is_truncated) == (1, False)
    assert recovery.end_ns == 12 * SECOND
    assert 0 < recovery.n_messages < len(messages_of(long_log))


def test_a_damaged_attachment_does_not_pass_for_a_good_one(tmp_path: Path, long_log: Path) -> None:
    data = long_log.read_bytes()
    place = data.index(b"obstacles")
    recovery = rescued(tmp_path, data[:place] + b"0bstacles" + data[place + 9 :])
    assert recovery is not None
    assert recovery.n_damaged == 1
    assert list(read_log(recovery.path).attachments) == ["damaged/playpen.toml", *ATTACHMENTS[1:]]


def test_messages_outside_of_chunks_are_kept(tmp_path: Path) -> None:
    folder = tmp_path / "folder"
    folder.mkdir()
    path = tmp_path / "other.mcap"
    with path.open("wb") as file:
        writer = Writer(file, use_chunking=False)
        writer.start("", "another program")
        channel = writer.register_channel("/a", "json", 0)
        for number in range(100):
            writer.add_message(channel, number, b'{"a": 1}', number)
        writer.finish()
    data = path.read_bytes()
    counts = [sum(1 for _ in IntactRecords(data[:size]).messages()) for size in range(0, len(data), 7)]
    assert counts == sorted(counts)
    assert counts[-1] == 100
    recovery = rescued(folder, data[: len(data) // 2])
    assert recovery is not None
    assert (recovery.n_messages, recovery.is_truncated) == (counts[len(data) // 14], True)


def test_exit_codes_tell_all_part_and_nothing(tmp_path: Path, long_log: Path) -> None:
    data = long_log.read_bytes()
    folder = tmp_path / "a folder.mcap.part"
    folder.mkdir()
    cases: dict[str, tuple[bytes, int]] = {
        "whole": (data, 0),
        "no summary": (data[: data.rindex(b"\x0f\x04\0\0\0\0\0\0\0")], 0),
        "torn": (data[: len(data) * 2 // 5], 3),
        "empty": (b"", 1),
        "text": (b"no log at all\n" * 100, 1),
        "start": (data[:30], 1),
    }
    for name, (content, code) in cases.items():
        part = tmp_path / f"{name}.mcap.part"
        part.write_bytes(content)
        process = khep_twin("recover", part)
        assert process.returncode == code, (name, process)
        assert len((process.stdout + process.stderr).splitlines()) == (1 if code == 1 else 2), (name, process)
        assert (tmp_path / f"{name}.mcap").exists() == (code != 1)
    for path in (folder, tmp_path / "not there.mcap.part"):
        process = khep_twin("recover", path)
        assert (process.returncode, process.stdout, len(process.stderr.splitlines())) == (1, "", 1)


def test_a_log_that_a_run_is_writing_is_left_alone(tmp_path: Path) -> None:
    file = PartFile(tmp_path / "run.mcap.part")
    with pytest.raises(LogError, match="a run is writing it"):
        recover(tmp_path / "run.mcap.part")
    file.close()


def test_a_full_disk_leaves_nothing_behind(
    tmp_path: Path, long_log: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    part = tmp_path / "run.mcap.part"
    part.write_bytes(long_log.read_bytes())

    def full(self: Writer) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Writer, "finish", full)
    with pytest.raises(LogError, match=r"run\.mcap: cannot be written: No space left on device"):
        recover(part)
    assert os.listdir(tmp_path) == ["run.mcap.part"]


def test_a_killed_run_is_rescued_and_the_next_one_says_how(tmp_path: Path) -> None:
    log = tmp_path / "run.mcap"
    command = [sys.executable, "-m", "khep_twin", "run", "--seconds", "900", "--log", str(log)]
    part = tmp_path / "run.mcap.part"
    child = Forked(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    try:
        deadline = time.monotonic() + 120
        while (not part.exists() or part.stat().st_size < 60_000) and time.monotonic() < deadline:
            time.sleep(0.02)
    finally:
        child.send_signal(signal.SIGKILL)
        child.wait()
    process = khep_twin("run", "--seconds", "1", "--log", log)
    (warning,) = [line for line in process.stderr.splitlines() if "unfinished" in line]
    remedy = re.search(r"recover (\S+)$", warning)
    assert remedy is not None
    assert remedy[1] == f"{log}.part.1"
    process = khep_twin("recover", remedy[1])
    assert (process.returncode, process.stderr) == (0, "")
    run = read_log(tmp_path / "run.recovered.mcap")
    assert list(run.attachments) == [*ATTACHMENTS, "controller/controllers.py"]
    # In lock-step what was written up to every fifth simulated second is there.
    assert run.robots["khepera0"].times_ns[-1] >= 4 * SECOND


def test_a_file_of_fake_chunks_takes_time_by_its_size_alone(tmp_path: Path) -> None:
    packed = zstandard.ZstdCompressor(level=1).compress(bytes(range(256)) * 4096)
    fakes = {
        "no checksum": struct.pack("<BQQQQII4sQ", 6, 2**40, 0, 0, 1 << 20, 1, 4, b"zstd", 2**20)
        + packed[:18],
        "not packed": struct.pack("<BQQQQIIQ", 6, 3_000_000, 0, 0, 1_000_000, 1, 0, 1_000_000),
        "texts": struct.pack("<BQI", 12, 1_000_000, 900_000),
        "zeros": b"\x06" + bytes(8),
    }
    for name, fake in fakes.items():
        data = MCAP0_MAGIC + fake * (3_000_000 // len(fake))
        began = time.process_time()
        assert rescued(tmp_path, data) is None
        assert time.process_time() - began < 8, name


def test_what_reads_no_log_is_left_out_and_said(tmp_path: Path, long_log: Path) -> None:
    proximity = CDR_HEADER + bytes(3)

    def change(topic: str, time_ns: int, data: bytes) -> bytes:
        return proximity if topic == "/khepera0/proximity" and time_ns == SECOND else data

    path = rewritten(long_log, tmp_path / "wrong.mcap", change)
    with pytest.raises(LogError, match=r"/khepera0/proximity at 1\.0000 s"):
        read_log(path)
    recovery = recover(path)
    assert (recovery.n_refused, recovery.n_damaged, recovery.is_complete) == (1, 0, False)
    assert "1 left out" in summary(path, recovery)
    assert (
        len(read_log(recovery.path).robots["khepera0"].proximity)
        == len(read_log(long_log).robots["khepera0"].proximity) - 1
    )


def test_what_is_rescued_of_random_damage_can_be_read(tmp_path: Path, long_log: Path) -> None:
    data, rng = long_log.read_bytes(), random.Random(5)
    opened = 0
    for _ in range(12):
        damaged = bytearray(data)
        for _ in range(rng.randrange(1, 30)):
            place, size = rng.randrange(len(data)), rng.choice((1, 1, 8, 100, 5000))
            damaged[place : place + size] = rng.choice((rng.randbytes(size), bytes(size), b""))
        if (recovery := rescued(tmp_path, bytes(damaged))) is None:
            continue
        try:
            read_log(recovery.path)
            read_series(recovery.path)
            opened += 1
        except LogError as error:
            assert "no log of khep_twin" in str(error)  # noqa: PT017
    assert opened > 5


def test_bytes_that_are_no_text_are_kept_only_of_a_damaged_attachment(tmp_path: Path) -> None:
    content = b"\xff\xfe is no text"
    folder = tmp_path / "folder"
    folder.mkdir()
    path = tmp_path / "picture.mcap"
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start("", "another program")
        writer.add_attachment(0, 0, "picture", "image/x", content)
        writer.finish()
    log = path.read_bytes()
    for data, names in ((log, []), (log.replace(content, content[:-1] + b"T"), ["damaged/picture"])):
        recovery = rescued(folder, data)
        assert recovery is not None
        assert recovery.n_attachments == len(names)
        assert recovery.n_refused == (not names)
        with recovery.path.open("rb") as file:
            assert [attachment.name for attachment in make_reader(file).iter_attachments()] == names
