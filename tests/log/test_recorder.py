"""Recording: the same run gives the same bytes, and nothing that was written is lost."""

import os
import signal
import sys
import threading
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from types import FrameType

import mujoco
import numpy as np
import pytest
from driving import SECOND, drive
from forked import run_python
from log_contents import messages_of
from mcap.reader import make_reader
from mcap.records import Attachment, Header, Message, Metadata
from mcap.stream_reader import StreamReader
from mcap.writer import MCAP0_MAGIC
from scenes import arena, robot, table

from khep_twin import playpen
from khep_twin.errors import LogError
from khep_twin.interventions.switching import set_lamps, switch
from khep_twin.log.decoding import read_array
from khep_twin.log.reader import read_log
from khep_twin.log.recorder import Recorder
from khep_twin.log.run_description import RunDescription
from khep_twin.observers import SAMPLE_NS
from khep_twin.playpen import Playpen
from khep_twin.ports.twin import Twin, TwinOptions, open_twin
from khep_twin.world import World

Start = Callable[[Path], Twin]


def records(path: Path) -> list[object]:
    """Every record of a log as it stands in the file; a torn end is left out."""
    records: list[object] = []
    with path.open("rb") as file, suppress(Exception):
        records += StreamReader(file).records
    return records


def messages_in(path: Path) -> list[Message]:
    return [record for record in records(path) if isinstance(record, Message)]


def test_the_same_run_gives_the_same_bytes_under_any_name(tmp_path: Path, start: Start) -> None:
    paths = [tmp_path / "run.mcap", tmp_path / "elsewhere" / "other name.log"]
    paths[1].parent.mkdir()
    for path in paths:
        with start(path) as twin:
            drive(twin)
            twin.world.log_event(None, "the end")
    assert paths[0].read_bytes() == paths[1].read_bytes()


@pytest.mark.parametrize("line", range(12))
def test_a_log_can_be_completed_by_another_thread_at_any_line_of_a_sample(line: int, tmp_path: Path) -> None:
    world = World(Playpen.load("two-lamps"))
    recorder = Recorder(tmp_path / "run.mcap", world, RunDescription({}))
    switch(world, 0, on=False)
    for _ in range(3):
        world.advance_to(world.time_ns + SAMPLE_NS)
        recorder.sample(world)
    lines = iter(range(line + 1))

    def complete(frame: FrameType, event: str, argument: object) -> object:
        if frame.f_code is not Recorder.sample.__code__:
            return None
        if event == "line" and next(lines, None) == line:
            sys.settrace(None)
            recorder.close()
        return complete

    world.advance_to(world.time_ns + SAMPLE_NS)
    sys.settrace(complete)
    try:
        recorder.sample(world)
    finally:
        sys.settrace(None)
    recorder.close()
    assert len(read_log(tmp_path / "run.mcap").robots["khepera0"].times_ns) in (3, 4)


def test_lamps_that_change_are_recorded_and_others_are_not(tmp_path: Path) -> None:
    text = playpen.dump(Playpen.load("two-lamps"))
    for name, mode in (("turns", "sequenced"), ("still", "all")):
        playpen_with_mode = playpen.parse(text.replace('mode = "all"', f'mode = "{mode}"'), name)
        with open_twin(playpen_with_mode, TwinOptions(log=str(tmp_path / f"{name}.mcap"))) as twin:
            twin.advance_to(SECOND)
            # Back to the lower wall, where the lamps are switched.
            twin.robot.send(b"D,-20,-20\n")
            twin.advance_to(4 * SECOND)
    powers = [read_array(message.data, "d") for _, message in messages_of(tmp_path / "turns.mcap", "/lamps")]
    assert powers[0] == (7, 0)
    assert len(powers) == 201
    assert powers[-1] == (0, 2)
    assert [event.text for event in read_log(tmp_path / "turns.mcap").events] == ["in-the-open is on"]
    assert not messages_of(tmp_path / "still.mcap", "/lamps")


def test_a_lamp_that_a_hand_switches_is_recorded_from_then_on(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    with open_twin("two-lamps", TwinOptions(log=str(path))) as twin:
        twin.advance_to(SECOND)
        switch(twin.world, 1, False)
        twin.advance_to(2 * SECOND)
    powers = [(message.log_time, read_array(message.data, "d")) for _, message in messages_of(path, "/lamps")]
    assert powers == [(SECOND + sample * SAMPLE_NS, (7, 0)) for sample in range(1, 51)]


def test_what_describes_the_run_comes_before_its_first_message(log: Path) -> None:
    log_records = records(log)
    kinds = [type(record) for record in log_records]
    first = kinds.index(Message)
    assert isinstance(log_records[0], Header)
    assert log_records[0].library.startswith("khep_twin ")
    assert [record.name for record in log_records if isinstance(record, Attachment)] == [
        "playpen.toml",
        "scene.xml",
        "configuration.json",
        "calibration/khepera0.toml",
    ]
    for kind in (Attachment, Metadata):
        assert all(place < first for place, other in enumerate(kinds) if other is kind)
    assert all(
        record.create_time == record.log_time == 0 for record in log_records if isinstance(record, Attachment)
    )


def test_the_attached_scene_compiles_to_the_recorded_one(log: Path) -> None:
    model = mujoco.MjModel.from_xml_string(read_log(log).attachments["scene.xml"])
    assert model.body("khepera0/base").id > 0


def test_every_channel_has_its_messages_at_simulated_times(log: Path) -> None:
    times: dict[str, list[int]] = {}
    with log.open("rb") as file:
        for schema, channel, message in make_reader(file).iter_messages():
            assert schema is not None
            assert (schema.encoding, channel.message_encoding) == ("ros2msg", "cdr")
            assert message.log_time == message.publish_time
            times.setdefault(channel.topic, []).append(message.log_time)
    samples = list(range(0, 2 * SECOND + 1, 20_000_000))
    for topic in (
        "tf",
        *(f"khepera0/{name}" for name in ("proximity", "ambient", "speed", "duty", "leds", "registers")),
    ):
        assert times.pop(f"/{topic}") == samples
    assert times.pop("/robot_description") == [0]
    assert times.pop("/channel_names") == [0]
    assert times.pop("/scene") == [0]
    assert times.pop("/tf_static") == [0]
    assert times.pop("/events") == [2 * SECOND]
    assert len(times.pop("/khepera0/serial")) == 40
    assert times.pop("/state") == [0]
    assert times.pop("/snapshot") == [2 * SECOND]
    assert times.pop("/khepera0/host_events") == [0]
    assert not times


def test_lines_are_whole_however_their_bytes_arrive(tmp_path: Path, start: Start) -> None:
    with start(tmp_path / "run.mcap") as twin:
        assert twin.recorder is not None
        for time_ns, data in ((1, b"D,"), (2, b"5,"), (3, b"5\r"), (4, b"\nN\nO"), (5, b"\n\n")):
            twin.recorder.on_bytes(time_ns, 0, True, data)
        twin.recorder.on_bytes(6, 0, True, b"E")
    lines = read_log(tmp_path / "run.mcap").robots["khepera0"].serial
    assert [(line.time_ns, line.text) for line in lines] == [(0, "E"), (3, "D,5,5"), (4, "N"), (5, "O")]


def test_noise_on_the_line_is_written_as_escapes(tmp_path: Path, start: Start) -> None:
    with start(tmp_path / "run.mcap") as twin:
        assert twin.recorder is not None
        twin.recorder.on_bytes(1, 0, True, b"N\x00\xff\x1b\\\n")
        twin.recorder.on_bytes(2, 0, True, b"\xaa" * 5000)
    first, *rest = read_log(tmp_path / "run.mcap").robots["khepera0"].serial
    assert first.time_ns in (0, 1)
    assert r"N\x00\xff\x1b\\" in {first.text, *(line.text for line in rest)}


def test_a_run_ended_by_an_error_is_a_whole_log(tmp_path: Path, start: Start) -> None:
    def interrupted() -> None:
        with start(tmp_path / "run.mcap") as twin:
            drive(twin)
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    assert len(read_log(tmp_path / "run.mcap").robots["khepera0"].times_ns) == 101
    assert os.listdir(tmp_path) == ["run.mcap"]


def test_ctrl_c_in_the_middle_of_a_write_waits_for_its_end(
    tmp_path: Path, start: Start, monkeypatch: pytest.MonkeyPatch
) -> None:
    write, after = os.write, []

    def interrupted(descriptor: int, data: bytes) -> int:
        if threading.current_thread() is not threading.main_thread():
            return write(descriptor, data)  # of those who run the tests
        monkeypatch.undo()
        signal.raise_signal(signal.SIGINT)
        after.append("still here")
        return write(descriptor, data)

    def run() -> None:
        with start(tmp_path / "run.mcap") as twin:
            drive(twin)
            monkeypatch.setattr(os, "write", interrupted)
            twin.world.log_event(None, "halfway")
            after.append("never")

    # What runs in the background of a shell has Ctrl-C switched off.
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        with pytest.raises(KeyboardInterrupt):
            run()
        assert after == ["still here"]
        assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
    finally:
        signal.signal(signal.SIGINT, before)
    assert [event.text for event in read_log(tmp_path / "run.mcap").events] == ["halfway"]


def test_a_finished_log_is_replaced_only_by_a_finished_one(tmp_path: Path, start: Start) -> None:
    path = tmp_path / "run.mcap"
    path.write_bytes(MCAP0_MAGIC + b"an older log")
    with start(path) as twin:
        drive(twin)
        assert path.read_bytes() == MCAP0_MAGIC + b"an older log"
    assert len(read_log(path).events) == 0


@pytest.mark.parametrize("kind", ["source", "pipe", "directory"])
def test_what_is_no_log_is_left_alone(tmp_path: Path, start: Start, kind: str) -> None:
    path = tmp_path / "precious.py"
    if kind == "source":
        path.write_text("print('mine')\n")
    elif kind == "pipe":
        os.mkfifo(path)
    else:
        path.mkdir()
    before = path.stat().st_mode
    with pytest.raises(LogError, match=r"precious.py: cannot write a log here: this (file is no log|is )"):
        start(path).__enter__()
    assert path.stat().st_mode == before
    assert [path.name for path in tmp_path.iterdir()] == ["precious.py"]


def test_what_a_crash_left_behind_is_kept(tmp_path: Path, start: Start) -> None:
    path = tmp_path / "run.mcap"
    (tmp_path / "run.mcap.part").write_bytes(MCAP0_MAGIC + b"crashed")
    (tmp_path / "run.mcap.part.1").write_text("crashed before")
    with start(path) as twin:
        assert twin.recorder is not None
        assert twin.recorder.previous_part == tmp_path / "run.mcap.part.2"
    assert (tmp_path / "run.mcap.part.1").read_text() == "crashed before"
    assert (tmp_path / "run.mcap.part.2").read_bytes() == MCAP0_MAGIC + b"crashed"
    read_log(path)


def test_a_log_that_another_run_is_writing_is_left_alone(tmp_path: Path, start: Start) -> None:
    path = tmp_path / "run.mcap"
    with start(path) as twin:
        with pytest.raises(LogError, match=r"run\.mcap\.part: another run is writing it"):
            start(path)
        drive(twin)
    assert len(read_log(path).robots["khepera0"].times_ns) == 101


def test_places_where_no_log_can_be_are_one_line_before_anything_is_written(tmp_path: Path) -> None:
    twin = open_twin("default", TwinOptions())
    for path, reason in (
        (tmp_path, "this is a directory"),
        (tmp_path / "no" / "run.mcap", "there is no directory"),
    ):
        with pytest.raises(LogError, match=reason):
            Recorder(path, twin.world, RunDescription({}))
    assert os.listdir(tmp_path) == []


def fill_disk_after(size: int, monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """Let files accept `size` more bytes; return the list of the sizes that later writes try."""
    write, room, tried = os.write, [size], []

    def limited(descriptor: int, data: bytes) -> int:
        tried.append(len(data))
        if not room[0]:
            raise OSError(28, "No space left on device")
        n_written = write(descriptor, data[: room[0]])
        room[0] -= n_written
        return n_written

    monkeypatch.setattr(os, "write", limited)
    return tried


@pytest.mark.parametrize("size", [0, 10, 5000, 40_000])
def test_a_full_disk_is_reported_once_and_what_was_saved_stays(
    tmp_path: Path, start: Start, monkeypatch: pytest.MonkeyPatch, size: int
) -> None:
    path = tmp_path / "run.mcap"
    twin = start(path)
    drive(twin, 1)
    twin.world.log_event(None, "still good")
    saved = len(messages_in(twin.recorder.part))
    tried = fill_disk_after(size, monkeypatch)
    with pytest.raises(
        LogError, match=r"run\.mcap: .* at \d+\.\d\d s: No space left on device; .*run\.mcap\.part"
    ):
        drive_on(twin)
    calls = len(tried)
    twin.world.log_event(None, "too late")
    twin.advance_to(twin.world.time_ns + SECOND)
    twin.close()
    assert len(tried) == calls
    assert os.listdir(tmp_path) == ["run.mcap.part"]
    assert len(messages_in(tmp_path / "run.mcap.part")) >= saved


def drive_on(twin: Twin) -> None:
    """Until the disk is full."""
    for _ in range(100):
        twin.advance_to(twin.world.time_ns + SECOND)
        twin.world.log_event(None, "another second")


def test_a_disk_that_is_full_at_the_end_leaves_the_unfinished_file(
    tmp_path: Path, start: Start, monkeypatch: pytest.MonkeyPatch
) -> None:
    twin = start(tmp_path / "run.mcap")
    drive(twin)
    fill_disk_after(100, monkeypatch)
    with pytest.raises(LogError, match="No space left"):
        twin.close()
    twin.close()
    assert os.listdir(tmp_path) == ["run.mcap.part"]


def test_a_limit_on_file_sizes_is_a_full_disk_too(tmp_path: Path) -> None:
    program = (
        "import resource, sys; from khep_twin.ports.twin import *\n"
        "resource.setrlimit(resource.RLIMIT_FSIZE, (200_000, 200_000))\n"
        "with open_twin('default', TwinOptions(log=sys.argv[1])) as twin:\n"
        "    twin.advance_to(60 * 10**9)\n"
    )
    process = run_python([sys.executable, "-c", program, tmp_path / "run.mcap"])
    assert "LogError: " in process.stderr.splitlines()[-1]
    assert "File too large" in process.stderr.splitlines()[-1]
    (part,) = tmp_path.iterdir()
    assert part.stat().st_size <= 200_000
    assert len(messages_in(part)) > 1000


def test_a_killed_run_keeps_what_was_flushed(tmp_path: Path) -> None:
    program = (
        "import os, sys; from khep_twin.ports.twin import *\n"
        "twin = open_twin('default', TwinOptions(log=sys.argv[1]))\n"
        "twin.advance_to(2 * 10**9); twin.recorder.flush(); twin.advance_to(3 * 10**9)\n"
        "os.kill(os.getpid(), 9)\n"
    )
    run_python([sys.executable, "-c", program, tmp_path / "run.mcap"])
    assert max(message.log_time for message in messages_in(tmp_path / "run.mcap.part")) == 2 * SECOND


def test_several_robots_and_movable_objects_are_all_recorded(tmp_path: Path) -> None:
    post = table("cylinder", x_mm=300, y_mm=400, radius_mm=12.5, height_mm=50, movable=True, mass_g=20)
    crowd = arena() + post + robot(150, 250) + robot(450, 250, 180)
    path = tmp_path / "run.mcap"
    with open_twin(playpen.parse(crowd, "crowd"), TwinOptions(robot=1, log=str(path))) as twin:
        twin.robot.send(b"D,5,5\n")
        twin.advance_to(SECOND)
    run = read_log(path)
    assert list(run.robots) == ["khepera0", "khepera1"]
    still, driven = run.robots["khepera0"].pose, run.robots["khepera1"].pose
    assert np.ptp(still[:, 0]) < 0.001 < 0.02 < np.ptp(driven[:, 0])
    assert [line.text for line in run.robots["khepera1"].serial] == ["D,5,5", "d"]
    assert run.robots["khepera0"].serial == []


def test_a_world_whose_last_lamp_is_taken_away_is_recorded_further(tmp_path: Path) -> None:
    with open_twin("two-lamps", TwinOptions(seed=1, log=str(tmp_path / "x.mcap"))) as twin:
        twin.world.advance_to(SECOND // 10)
        set_lamps(twin.world, (), twin.world.playpen.lighting)
        twin.world.advance_to(SECOND // 5)
    times = [message.log_time for _, message in messages_of(tmp_path / "x.mcap", "/tf")]
    assert times == list(range(0, SECOND // 5 + 1, SAMPLE_NS))
