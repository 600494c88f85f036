"""A log read back: the same values as in the world, and one line for a file that is no log."""

import re
from itertools import chain
from pathlib import Path

import numpy as np
import pytest
from log_rewriting import rewritten
from mcap.writer import CompressionType, Writer

from khep_twin import playpen
from khep_twin.board.kernel import AMBIENT, PROXIMITY
from khep_twin.errors import LogError, PlaypenError
from khep_twin.log.attached import playpen_of
from khep_twin.log.channels import ArrayFrame
from khep_twin.log.content import Content
from khep_twin.log.decoding import read_line
from khep_twin.log.log_file import LogFile
from khep_twin.log.reader import (
    read_entry_batches,
    read_first_messages,
    read_label,
    read_log,
    read_raw,
    read_series,
    read_since,
)
from khep_twin.log.recover import recover
from khep_twin.ports.twin import TwinOptions, open_twin

SCAN_NS = 20_000_000


def test_a_run_comes_back_as_arrays(log: Path) -> None:
    track = read_log(log).robots["khepera0"]
    assert np.array_equal(track.times_ns, np.arange(101) * SCAN_NS)
    assert track.pose.shape == (101, 3)
    assert track.proximity.shape == track.ambient.shape == (101, 8)
    assert track.speed.shape == (101, 4)
    assert track.duty.shape == (101, 2)
    assert len(track.registers) == 101


def test_values_are_those_of_the_world(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    with open_twin("two-lamps", TwinOptions(log=str(path))) as twin:
        robot = twin.robot
        start = (*robot.pose, robot.registers[PROXIMITY].tolist(), robot.registers[AMBIENT].tolist())
        robot.send(b"D,10,6\n")
        twin.advance_to(500_000_000)
        end = (*robot.pose, robot.registers[PROXIMITY].tolist(), robot.registers[AMBIENT].tolist())
        registers = robot.registers.copy()
    track = read_log(path).robots["khepera0"]
    for row, (x, y, heading, proximity, ambient) in ((0, start), (-1, end)):
        assert track.pose[row] == pytest.approx([x, y, heading], abs=1e-8)  # the robot leans by 1e-5
        assert track.proximity[row].tolist() == proximity
        assert track.ambient[row].tolist() == ambient
    assert track.registers[-1].tolist() == registers.tolist()
    assert track.speed[-1, 2:].tolist() == [10, 6]


def test_each_channel_comes_back_at_its_own_times(log: Path) -> None:
    run, recording = read_log(log), read_series(log)
    track, series = run.robots["khepera0"], recording.series
    for name in ("pose", "proximity", "ambient", "speed", "duty", "registers"):
        rows = series[f"/khepera0/{name}"]
        assert rows.times_ns.tolist() == track.times_ns.tolist()
        assert rows.values.tolist() == getattr(track, name).tolist()
    assert series["/khepera0/registers"].values.dtype == np.int64
    assert recording.lines == {"/khepera0/serial": track.serial, "/events": run.events}
    assert recording.label.metadata == run.metadata


def test_the_transcript_has_both_sides_at_the_time_of_their_last_byte(log: Path) -> None:
    lines = read_log(log).robots["khepera0"].serial
    assert [line.text for line in lines[:3]] == ["D,8,5", "d", "N"]
    assert [line.name for line in lines[:3]] == ["host", "robot", "host"]
    # Six bytes of eleven bits at 9600 baud, then the three of "d\r\n" or its first two.
    assert lines[0].time_ns == 6 * 11 * 10**9 // 9600
    byte_ns = 11 * 10**9 / 9600
    assert lines[1].time_ns - lines[0].time_ns == pytest.approx(3 * byte_ns, abs=2)
    assert [line.time_ns for line in lines] == sorted(line.time_ns for line in lines)


def test_a_late_reply_alone_in_a_chunk_keeps_its_place(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    log = LogFile(path, lambda: 0)
    log.describe({}, {"robots": "khepera0"})
    for text, time_ns in (("asked", 1), ("late", 9), ("kept", 3), ("asked again", 4)):
        log.add_event(time_ns, "khepera0", text)
        log.flush()
    log.finish()
    events = [read_line(data).text for _, data in read_raw(path, lambda topic: True)[1]["/events"]]
    assert events == ["asked", "late", "kept", "asked again"]
    last, *rest = (
        [read_line(event.data).text for event in piece] for piece in read_since(path, "/events", 3)
    )
    assert (last, [*chain(*rest)]) == (["kept"], ["asked again"])
    with path.open("rb") as file:
        parts = [[entry.time_ns for entry in part] for _, part in Content(file).batches(1)]
    assert parts == [[1], [3], [4], [9]]


def test_events_carry_who_and_when(log: Path) -> None:
    (event,) = read_log(log).events
    assert (event.time_ns, event.name, event.text) == (2_000_000_000, "khepera0", "taken away")


def test_the_label_is_read_without_the_run(log: Path) -> None:
    label = read_label(log)
    assert label.robots == ("khepera0",)
    assert label.metadata["seed"] == "3"
    assert 'name = "obstacles"' in label.attachments["playpen.toml"]
    assert "<mujoco" in label.attachments["scene.xml"]
    assert {"configuration.json", "calibration/khepera0.toml"} < set(label.attachments)


@pytest.mark.parametrize("content", [b"", b"PNG", b"\x89MCAP0\r\n", b"\x00" * 1000])
def test_what_is_no_log_is_one_line(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "x.mcap"
    path.write_bytes(content)
    with pytest.raises(LogError) as caught:
        read_log(path)
    message = f"{path}: no whole log: no MCAP file; expected one that begins and ends as such"
    assert caught.value.plain == message
    remedy = " recover " if content.startswith(b"\x89MCAP0") else " run --log run.mcap"
    assert remedy in str(caught.value).removeprefix(message)


def test_a_missing_log_names_the_one_that_was_probably_meant(tmp_path: Path) -> None:
    (tmp_path / "run-001.mcap").touch()
    with pytest.raises(LogError, match=r"No such file or directory; did you mean '.*/run-001.mcap'\?"):
        read_log(tmp_path / "run-01.mcap")


def test_a_foreign_mcap_file_is_distinguished(tmp_path: Path) -> None:
    path = tmp_path / "foreign.mcap"
    writer = Writer(str(path))
    writer.start()
    writer.finish()
    with pytest.raises(LogError, match=r"foreign\.mcap: an MCAP file, but no log of khep_twin"):
        read_log(path)


def test_a_missing_log_and_a_directory_are_one_line(tmp_path: Path) -> None:
    with pytest.raises(LogError, match=r"none\.mcap: cannot be read: No such file"):
        read_log(tmp_path / "none.mcap")
    with pytest.raises(LogError, match="cannot be read: Is a directory"):
        read_log(tmp_path)


def reading(path: Path) -> str | None:
    """Return the message about a log, None for a sound one."""
    try:
        read_log(path)
        read_series(path)
    except LogError as error:
        return str(error)
    return None


def test_damage_anywhere_is_one_line_or_harmless(log: Path, tmp_path: Path) -> None:
    data, path = log.read_bytes(), tmp_path / "torn.mcap"
    for place in np.random.default_rng(1).integers(0, len(data), 40).tolist():
        path.write_bytes(data[:place])
        assert len((reading(path) or "").splitlines()) == 1
        path.write_bytes(data[:place] + bytes([data[place] ^ 0xFF]) + data[place + 1 :])
        assert len((reading(path) or "").splitlines()) <= 1


def test_a_log_packed_with_lz4_is_read_and_recovered(log: Path, tmp_path: Path) -> None:
    copy = rewritten(log, tmp_path / "lz4.mcap", compression=CompressionType.LZ4)
    assert read_series(copy).lines == read_series(log).lines
    (tmp_path / "torn.mcap").write_bytes(copy.read_bytes()[:-9])
    recovery = recover(tmp_path / "torn.mcap")
    assert recovery.n_messages == recover(copy).n_messages > 300
    assert (
        read_log(recovery.path).robots["khepera0"].pose.tolist()
        == read_log(log).robots["khepera0"].pose.tolist()
    )


def test_channels_of_others_may_have_names_like_a_robots(log: Path, tmp_path: Path) -> None:
    one = ArrayFrame(1, "f8", "").messages(np.array([[1.5]]))[0].tobytes()
    copy = rewritten(
        log,
        tmp_path / "foreign.mcap",
        message=lambda topic, _, data: one if topic.endswith(("/duty", "/serial")) else data,
        rename=lambda topic: topic.replace("/khepera0/duty", "/lidar/speed").replace(
            "khepera0/serial", "gps/serial"
        ),
    )
    assert len(read_log(copy).robots["khepera0"].speed) == len(read_log(log).robots["khepera0"].speed)
    assert read_series(copy).series["/lidar/speed"].values[0] == 1.5


def test_walls_that_are_too_low_now_do_not_matter_in_a_log(log: Path, tmp_path: Path) -> None:
    low = rewritten(
        log,
        tmp_path / "low.mcap",
        attachment=lambda name, data: re.sub(rb"(wall_height_mm = )\S+", rb"\g<1>9.0", data),
    )
    assert playpen_of(read_label(low).attachments, low).arena.wall_height_mm == 9.0
    with pytest.raises(PlaypenError, match="expected at least 15"):
        playpen.parse(read_label(low).attachments["playpen.toml"], "now")


def test_the_first_messages_unpack_each_chunk_once(log: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    places: list[int] = []
    unpack = Content._read_chunk

    def noted(content: Content, place: int, length: int) -> bytes:
        places.append(place)
        return unpack(content, place, length)

    monkeypatch.setattr(Content, "_read_chunk", noted)
    assert "/khepera0/proximity" in read_first_messages(log).series
    assert len(places) == len(set(places))


def test_batches_of_some_topics_have_all_their_messages_and_no_others(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    with open_twin("obstacles", TwinOptions(seed=3, log=str(path))) as twin:
        twin.advance_to(200_000_000)
    _, by_topic, _ = read_raw(path, lambda topic: topic.endswith("/speed"))
    batches = read_entry_batches(path, topic_filter=lambda topic: topic.endswith("/speed"))
    entries = [entry for _, batch in batches for entry in batch]
    assert {entry.topic for entry in entries} == {"/khepera0/speed"}
    assert [(entry.time_ns, entry.data) for entry in entries] == by_topic["/khepera0/speed"]
