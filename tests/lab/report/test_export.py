"""Logs as tables: they read back, as the same bytes each time; errors are one line."""

import csv
from functools import partial
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from command_line import good, refusal
from mcap.writer import Writer
from pyarrow import parquet  # pyright: ignore[reportMissingTypeStubs]
from relay_logs import in_turn, relayed
from scipy.io import loadmat  # pyright: ignore[reportMissingTypeStubs, reportUnknownVariableType]

from khep_twin.lab.report.export import SUFFIXES
from khep_twin.log import reader
from khep_twin.log.channels import FLOATS, ArrayFrame
from khep_twin.log.message_types import SCHEMAS
from khep_twin.log.reader import read_log
from khep_twin.playpen import Playpen
from khep_twin.ports.twin import TwinOptions, open_twin

SECOND = 1_000_000_000


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A finished log of one second of two robots, the second of which turns, and an event."""
    path = tmp_path_factory.mktemp("export") / "run.mcap"
    one = Playpen.load("gripper")
    other = one.robots[0].model_copy(update={"x_mm": 80.0, "y_mm": 80.0, "turrets": ()})
    pair = one.model_copy(update={"robots": (*one.robots, other)})
    with open_twin(pair, TwinOptions(seed=3, robot=None, log=str(path))) as twin:
        twin.robots[0].send(b"D,8,5\nN\n")
        twin.robots[1].send(b"D,4,-4\n")
        twin.advance_to(SECOND)
        twin.world.log_event(0, "taken away")
    return path


@pytest.fixture(scope="module")
def long(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A finished log of four seconds, flushed every second, with several chunks."""
    path = tmp_path_factory.mktemp("export") / "long.mcap"
    with open_twin("two-lamps", TwinOptions(seed=3, log=str(path))) as twin:
        for second in range(1, 5):
            twin.robots[0].send(b"D,8,5\nN\n")
            twin.advance_to(second * SECOND)
            assert twin.recorder is not None
            twin.recorder.flush()
    return path


@pytest.fixture
def real(tmp_path: Path) -> Path:
    """A log of a real robot's serial line."""
    output = b"N\n", b"n,1,2,3,4,5,6,7,8\r\n", b"D,2,-3\n", b"d\r\n", b"E\n", b"e,1,-2\r\n"
    return relayed(tmp_path / "real.mcap", in_turn(*output))


export, refused = partial(good, "export"), partial(refusal, "export")


def test_a_csv_comes_back(run: Path, tmp_path: Path) -> None:
    output = export(run, "-o", tmp_path / "run.csv", "--robot", "khepera0")
    assert "khepera0: pose, proximity, ambient, speed, duty, leds, gripper; 51 rows" in output
    track = read_log(run).robots["khepera0"]
    table: Any = np.genfromtxt(tmp_path / "run.csv", delimiter=",", names=True)
    assert table["time_s"].tolist() == (track.times_ns / 1e9).tolist()
    assert np.column_stack([table[name] for name in ("x_m", "y_m", "heading_rad")]).tolist() == (
        track.pose.tolist()
    )
    assert table["proximity_left_90"].tolist() == track.proximity[:, 0].tolist()
    assert table["ambient_back_left"].tolist() == track.ambient[:, 7].tolist()
    assert table["speed_right"].tolist() == track.speed[:, 1].tolist()
    assert table["speed_setpoint_left"].tolist() == track.speed[:, 2].tolist()
    assert table["duty_right"].tolist() == track.duty[:, 1].tolist()
    assert {"led_lateral", "led_frontal", "gripper_arm_position"} < set(table.dtype.names)


def test_a_parquet_file_comes_back_with_units(run: Path, tmp_path: Path) -> None:
    export(run, "-o", tmp_path / "run.parquet", "--robot", "khepera1")
    track = read_log(run).robots["khepera1"]
    table: Any = parquet.read_table(tmp_path / "run.parquet")  # pyright: ignore[reportUnknownMemberType]
    assert table["x_m"].to_pylist() == track.pose[:, 0].tolist()
    assert table["speed_left"].to_pylist() == track.speed[:, 0].tolist()
    assert table.schema.field("speed_left").metadata == {b"unit": b"pulses/10 ms", b"channel": b"speed"}
    assert table.schema.field("time_s").metadata == {b"unit": b"s"}
    assert "gripper_arm_position" not in table.column_names


def test_a_mat_file_comes_back(run: Path, tmp_path: Path) -> None:
    export(run, "-o", tmp_path / "run.mat", "--robot", "khepera0")
    track = read_log(run).robots["khepera0"]
    values: dict[str, Any] = loadmat(tmp_path / "run.mat")
    assert values["proximity"].tolist() == track.proximity.tolist()
    assert values["proximity_time_s"][:, 0].tolist() == (track.times_ns / 1e9).tolist()
    assert [cell[0] for cell in values["pose_columns"][:, 0]] == ["x_m", "y_m", "heading_rad"]
    assert [cell[0] for cell in values["serial_text"][:, 0]] == [line.text for line in track.serial]
    assert [cell[0] for cell in values["serial_from"][:, 0]] == [line.name for line in track.serial]
    assert values["events_text"][0, 0][0] == "taken away"
    assert values["__header__"].startswith(b"MATLAB 5.0 MAT-file, log by khep_twin")


def test_several_robots_are_in_one_table_by_time_and_name(run: Path, tmp_path: Path) -> None:
    assert "khepera0, khepera1: pose" in export(run, "-o", tmp_path / "both.csv")
    rows = [*csv.DictReader((tmp_path / "both.csv").read_text().splitlines())]
    assert [(row["time_s"], row["robot"]) for row in rows[:3]] == [
        *(("0.0", "khepera0"), ("0.0", "khepera1"), ("0.02", "khepera0"))
    ]
    second_rows = [{key: value for key, value in row.items() if key != "robot"} for row in rows[1::2]]
    export(run, "-o", tmp_path / "one.csv", "--robot", "khepera1")
    single_rows = [*csv.DictReader((tmp_path / "one.csv").read_text().splitlines())]
    assert [{key: row[key] for key in single_rows[0]} for row in second_rows] == single_rows
    assert {row["gripper_arm_position"] for row in second_rows} == {""}
    export(run, "-o", tmp_path / "both.parquet")
    table: Any = parquet.read_table(tmp_path / "both.parquet")  # pyright: ignore[reportUnknownMemberType]
    assert table["robot"].to_pylist() == [row["robot"] for row in rows]
    columns = read_log(run).table()
    assert columns["robot"].tolist() == table["robot"].to_pylist()
    for name in ("x_m", "proximity_back_left", "ambient_left_90", "speed_right", "duty_left"):
        assert columns[name].tolist() == table[name].to_pylist()


def test_a_mat_file_of_several_robots_numbers_them_from_1(run: Path, tmp_path: Path) -> None:
    export(run, "-o", tmp_path / "both.mat")
    values: dict[str, Any] = loadmat(tmp_path / "both.mat")
    track = read_log(run).robots["khepera1"]
    assert [cell[0] for cell in values["robots"][:, 0]] == ["khepera0", "khepera1"]
    second = values["speed_robot"][:, 0] == 2
    assert values["speed"][second].tolist() == track.speed.tolist()
    assert values["speed_time_s"][second, 0].tolist() == (track.times_ns / 1e9).tolist()
    assert set(values["gripper_robot"][:, 0]) == {1}
    is_second = values["serial_robot"][:, 0] == 2
    assert [cell[0] for cell in values["serial_text"][is_second, 0]] == [line.text for line in track.serial]


def test_a_transcript_of_several_robots_names_them(run: Path, tmp_path: Path) -> None:
    export(run, "--transcript", tmp_path / "said.csv")
    head, *rows = csv.reader((tmp_path / "said.csv").read_text().splitlines())
    assert head == ["time_s", "robot", "from", "text"]
    assert rows == sorted(rows, key=lambda row: float(row[0]))
    lines = read_log(run).robots["khepera1"].serial
    assert [row[3] for row in rows if row[1] == "khepera1"] == [line.text for line in lines]


def test_registers_have_their_names(run: Path, tmp_path: Path) -> None:
    export(run, "-o", tmp_path / "run.csv", "--channels", "registers", "--robot", "khepera0")
    track = read_log(run).robots["khepera0"]
    table: Any = np.genfromtxt(tmp_path / "run.csv", delimiter=",", names=True)
    assert len(table.dtype.names) == 1 + track.registers.shape[1]
    assert table["register_right_speed_setpoint"].tolist() == track.speed[:, 3].tolist()
    assert table["register_proximity_back_left"].tolist() == track.proximity[:, 7].tolist()
    assert table["register_current"].tolist() == track.registers[:, -1].tolist()


def test_lamps_that_change_are_columns(tmp_path: Path) -> None:
    lamps = Playpen.load("two-lamps")
    blinking = lamps.lamps[0].model_copy(update={"blink_period_s": 0.4})
    changing = lamps.model_copy(update={"lamps": (blinking, *lamps.lamps[1:])})
    with open_twin(changing, TwinOptions(log=str(tmp_path / "run.mcap"))) as twin:
        twin.advance_to(SECOND)
    export(tmp_path / "run.mcap", "-o", tmp_path / "run.csv", "--channels", "lamps")
    table: Any = np.genfromtxt(tmp_path / "run.csv", delimiter=",", names=True)
    assert table.dtype.names[:2] == ("time_s", "lamp_0_w")
    assert set(table["lamp_0_w"].tolist()) == {0.0, lamps.lamps[0].power_w}


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_the_same_log_gives_the_same_bytes(suffix: str, run: Path, tmp_path: Path) -> None:
    files = [tmp_path / f"{name}{suffix}" for name in "ab"]
    for file in files:
        export(run, "-o", file)
    assert files[0].read_bytes() == files[1].read_bytes()


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_a_long_log_is_written_piece_by_piece(
    suffix: str, long: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    files = [tmp_path / f"{name}{suffix}" for name in ("whole", "pieces")]
    transcripts = [tmp_path / f"{name}-transcripts.csv" for name in ("whole", "pieces")]
    for file, transcript, size in zip(files, transcripts, (reader.BATCH_BYTES, 1), strict=True):
        monkeypatch.setattr(reader, "BATCH_BYTES", size)
        # The last batch has the snapshot of the end.
        assert len([*reader.read_batches(long)]) == (1 if size > 1 else 5)
        assert "201 rows" in export(long, "-o", file, "--transcript", transcript)
    assert transcripts[0].read_bytes() == transcripts[1].read_bytes()
    if suffix == ".parquet":
        one, other = map(parquet.read_table, files)  # pyright: ignore[reportUnknownMemberType, reportUnknownArgumentType, reportUnknownVariableType]
        assert one.equals(other)
    else:
        assert files[0].read_bytes() == files[1].read_bytes()


@pytest.mark.parametrize("suffix", [".csv", ".parquet"])
def test_a_count_that_is_no_whole_number_late_in_a_log_makes_its_channel_fractional(
    suffix: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    log, table = tmp_path / "run.mcap", tmp_path / f"table{suffix}"
    write_speeds(log, [[1.0, 2.0], [3.0, 4.5]])
    monkeypatch.setattr(reader, "BATCH_BYTES", 1)
    assert len([*reader.read_batches(log)]) == 2
    export(log, "-o", table)
    if suffix == ".csv":
        assert table.read_text().splitlines()[1:] == ["0.0,1.0,2.0", "1.0,3.0,4.5"]
    else:
        values: Any = parquet.read_table(table)  # pyright: ignore[reportUnknownMemberType]
        assert values["speed_1"].to_pylist() == [2.0, 4.5]


def test_rows_that_grow_within_a_log_are_reported(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    log, table = tmp_path / "run.mcap", tmp_path / "table.csv"
    write_speeds(log, [[1.0, 2.0], [3.0, 4.0, 5.0]])
    monkeypatch.setattr(reader, "BATCH_BYTES", 1)
    assert "/khepera0/speed has 3 values at 1.0 s, expected 2 as at its begin" in refused(log, "-o", table)
    assert [*tmp_path.iterdir()] == [log]


def test_more_than_a_mat_file_should_hold_is_refused(
    run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("khep_twin.lab.report.export.MAT_BYTES", 1000)
    assert "fewer --channels, or -o FILE.csv or .parquet" in refused(run, "-o", tmp_path / "run.mat")
    assert [*tmp_path.iterdir()] == []


def test_a_log_whose_index_leaves_messages_out_is_refused(tmp_path: Path) -> None:
    log = tmp_path / "run.mcap"
    write_speeds(log, [[1.0, 2.0], [3.0, 4.0]], stated_count=3)
    assert "no whole log" in refused(log, "-o", tmp_path / "table.csv")


def write_speeds(path: Path, rows: list[list[float]], stated_count: int | None = None) -> None:
    """Write a log of speeds, one per second and chunk, and optionally a wrong count of messages."""
    with path.open("wb") as file:
        writer = Writer(file, chunk_size=1)
        writer.start()
        writer.add_metadata("run", {"robots": "khepera0"})
        schema = writer.register_schema(FLOATS, "ros2msg", SCHEMAS[FLOATS].encode())
        channel = writer.register_channel("/khepera0/speed", "cdr", schema)
        for second, row in enumerate(rows):
            (message,) = ArrayFrame(len(row), "f8", "speed").messages(np.array([row]))
            writer.add_message(channel, second * SECOND, message.tobytes(), second * SECOND)
        if stated_count is not None:
            writer._Writer__statistics.message_count = stated_count  # pyright: ignore
        writer.finish()


def test_the_transcript_is_a_table(run: Path, tmp_path: Path) -> None:
    output = export(run, "--transcript", tmp_path / "output.csv", "--robot", "khepera0")
    lines = read_log(run).robots["khepera0"].serial
    assert f"{len(lines)} lines" in output
    head, *rows = csv.reader((tmp_path / "output.csv").read_text().splitlines())
    assert head == ["time_s", "from", "text"]
    assert rows == [[repr(line.time_ns / 1e9), line.name, line.text] for line in lines]


def test_a_real_robots_log_gives_what_it_has(real: Path, tmp_path: Path) -> None:
    assert "khepera0: proximity, speed; 2 rows" in export(real, "-o", tmp_path / "run.csv")
    rows = list(csv.reader((tmp_path / "run.csv").read_text().splitlines()))
    assert rows[1] == ["0.2", *"12345678", *[""] * 4]
    assert rows[2] == ["0.6", *[""] * 8, "1", "-2", "2", "-3"]
    export(real, "-o", tmp_path / "run.parquet")
    table: Any = parquet.read_table(BytesIO((tmp_path / "run.parquet").read_bytes()))  # pyright: ignore[reportUnknownMemberType]
    assert table["proximity_left_45"].to_pylist() == [2, None]
    export(real, "-o", tmp_path / "run.mat")
    values: dict[str, Any] = loadmat(tmp_path / "run.mat")
    assert values["speed"].tolist() == [[1, -2, 2, -3]]
    assert values["speed_time_s"].tolist() == [[0.6]]


def test_wrong_words_are_reported_with_the_choices(run: Path, tmp_path: Path) -> None:
    table = tmp_path / "x.csv"
    message = refused(run, "-o", table, "--channels", "speeds")
    assert "speeds: not in this log of khepera0, khepera1; did you mean 'speed'? (choices: pose, " in message
    assert "--robot khepera7: not in this log; did you mean" in refused(
        run, "-o", table, "--robot", "khepera7"
    )
    assert "expected a name that ends in .csv, .parquet or .mat" in refused(run, "-o", tmp_path / "x.txt")
    assert "nothing to write" in refused(run)
    assert "named twice" in refused(run, "-o", table, "--transcript", table)
    assert "there is no directory" in refused(run, "-o", tmp_path / "none" / "x.csv")
    assert list(tmp_path.iterdir()) == []


def test_the_log_is_never_overwritten(run: Path, tmp_path: Path) -> None:
    log = tmp_path / "log.csv"
    log.write_bytes(run.read_bytes())
    (tmp_path / "link.csv").hardlink_to(log)
    (tmp_path / "soft.csv").symlink_to(log)
    for name in ("log.csv", "link.csv", "soft.csv"):
        assert "this is the log" in refused(log, "-o", tmp_path / name)
        assert "this is the log" in refused(log, "--transcript", tmp_path / name)
    assert log.read_bytes() == run.read_bytes()


def test_a_torn_log_is_one_line(run: Path, tmp_path: Path) -> None:
    (tmp_path / "torn.mcap").write_bytes(run.read_bytes()[:-200])
    assert "no whole log" in refused(tmp_path / "torn.mcap", "-o", tmp_path / "x.csv")
    assert "cannot be read" in refused(tmp_path / "none.mcap", "-o", tmp_path / "x.csv")


def test_a_log_without_samples_has_its_transcript(tmp_path: Path) -> None:
    log = relayed(tmp_path / "real.mcap")
    assert "has no samples" in refused(log, "-o", tmp_path / "x.csv")
    assert "no samples" in export(log, "-o", tmp_path / "x.mat", "--transcript", tmp_path / "t.csv")
    assert (tmp_path / "t.csv").read_text() == "time_s,from,text\n"
