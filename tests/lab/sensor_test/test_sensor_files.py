"""Files of sensor tests: they read back; errors of damaged or foreign files are one line."""

import random
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.io import loadmat, savemat  # pyright: ignore[reportMissingTypeStubs, reportUnknownVariableType]

from khep_twin.errors import LogError, SensorTestError
from khep_twin.files.mat_file import read_variables
from khep_twin.lab.sensor_test.sensor_files import SUFFIXES, load, save
from khep_twin.lab.sensor_test.sensor_test import SensorRun, SensorTest
from khep_twin.log.reader import read_label

LINEAR = SensorTest("light", linear_cm=-12.5, speed=7, acceleration=30, return_to_zero=True)
TURN = SensorTest(rotate_deg=360)
IMAGES = SensorTest("vision", rotate_deg=-90, speed=2)


def made_up(test: SensorTest, text: str = "a wall, 5 $\n  Bäume ") -> SensorRun:
    rng = np.random.default_rng(1)
    dv = rng.integers(0, test.quantity.limit + 1, (20, 2 + len(test.quantity.names)))
    dv[:, :2] = np.linspace(0, 1, 20)[:, None] * test.target
    return SensorRun(test, dv, np.round(np.sort(rng.uniform(0, 5, 20)), 9), text)


def toolbox_dv(left: int, right: int) -> Any:
    dv = np.zeros((4, 10))
    dv[:, 0], dv[:, 1] = np.linspace(0, left, 4).round(), np.linspace(0, right, 4).round()
    return dv


@pytest.mark.parametrize("suffix", SUFFIXES)
@pytest.mark.parametrize("test", [LINEAR, TURN, IMAGES], ids=["linear", "turn", "images"])
@pytest.mark.parametrize("text", ["", "a wall, 5 $\n  Bäume "])
def test_what_is_written_comes_back(suffix: str, test: SensorTest, text: str, tmp_path: Path) -> None:
    run, path = made_up(test, text), tmp_path / f"run{suffix}"
    save(path, run)
    loaded = load(path)
    assert loaded.test == test
    assert loaded.text == text
    assert loaded.dv.dtype == np.int64
    np.testing.assert_array_equal(loaded.dv, run.dv)
    np.testing.assert_array_equal(loaded.times, run.times)
    assert [file.name for file in tmp_path.iterdir()] == [path.name]


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_the_same_run_gives_the_same_bytes(suffix: str, tmp_path: Path) -> None:
    for name in ("a", "b"):
        save(tmp_path / f"{name}{suffix}", made_up(TURN))
    assert (tmp_path / f"a{suffix}").read_bytes() == (tmp_path / f"b{suffix}").read_bytes()


def test_a_mat_file_has_the_toolboxs_variables_and_no_date(tmp_path: Path) -> None:
    run = made_up(LINEAR, "white wall")
    save(tmp_path / "run.mat", run)
    values: dict[str, Any] = loadmat(tmp_path / "run.mat")
    assert values["dv"].dtype == np.float64
    np.testing.assert_array_equal(values["dv"], run.dv)
    assert values["dlgstr"].tolist() == ["white wall"]
    assert b"Created" not in (tmp_path / "run.mat").read_bytes()[:116]


@pytest.mark.parametrize(
    ("left", "right", "test"),
    [
        (6875, 6873, SensorTest(linear_cm=54.99, speed=None, acceleration=None)),
        (-1250, -1250, SensorTest(linear_cm=-10, speed=None, acceleration=None)),
        (-2042, 2042, SensorTest(rotate_deg=359.99, speed=None, acceleration=None)),
        (511, -511, SensorTest(rotate_deg=-90.09, speed=None, acceleration=None)),
    ],
)
@pytest.mark.parametrize("version", ["4", "5"])
def test_the_test_of_a_toolbox_file_is_derived_from_its_counters(
    left: int, right: int, test: SensorTest, version: str, tmp_path: Path
) -> None:
    path = tmp_path / "old.mat"
    values = {"dv": toolbox_dv(left, right), "dlgstr": ["first", "2nd"], "other": np.array([1 + 2j])}
    savemat(path, values, format=version)
    run = load(path)
    assert run.test == test
    assert run.text == "first\n2nd"
    assert load(path, "light").test.what == "light"
    with pytest.raises(SensorTestError, match="the rows have no times, which a log needs"):
        save(tmp_path / "old.mcap", run)


def test_a_packed_mat_file_is_read(tmp_path: Path) -> None:
    savemat(tmp_path / "x.mat", {"dv": toolbox_dv(1250, 1250)}, do_compression=True)
    assert load(tmp_path / "x.mat").test == SensorTest(linear_cm=10, speed=None, acceleration=None)


def test_a_table_that_a_spreadsheet_has_rewritten_says_how(tmp_path: Path) -> None:
    path = tmp_path / "run.csv"
    save(path, made_up(LINEAR, ""))
    title, *rest = path.read_text().splitlines()
    rows = [line if line.startswith("#") else line.replace(",", ";").replace(".", ",") for line in rest]
    for text, encoding, message in (
        (
            [f"{title};;;", *rows, ""],
            "utf-8",
            "fields with ';' between them.*expected ',', and '.' in numbers",
        ),
        ([title, *rest, ""], "utf-16", "this is text in UTF-16; expected UTF-8"),
    ):
        path.write_bytes("\n".join(text).encode(encoding))
        with pytest.raises(SensorTestError, match=rf"run.csv: .*{message}"):
            load(path)


def test_a_log_has_positions_and_counts_under_our_names(tmp_path: Path) -> None:
    save(tmp_path / "run.mcap", made_up(LINEAR))
    assert read_label(tmp_path / "run.mcap").metadata["linear_cm"] == "-12.5"


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_a_damaged_file_is_refused_in_one_line_or_read(suffix: str, tmp_path: Path) -> None:
    path, rng = tmp_path / f"run{suffix}", random.Random(1)
    refused: list[str] = []
    save(path, made_up(TURN))
    intact = path.read_bytes()
    for number in range(300):
        data = bytearray(intact[: rng.randrange(1, len(intact))] if number % 3 == 0 else intact)
        if number % 3:
            data[rng.randrange(min(len(data), 400 if number % 2 else len(data)))] = rng.randrange(256)
        path.write_bytes(data)
        try:
            load(path)
        except SensorTestError as error:
            refused.append(str(error))
    assert len(refused) > 100
    assert [line for line in refused if not line.startswith(f"{path}: ") or "\n" in line] == []


@pytest.mark.parametrize(
    ("before", "after", "line"),
    [
        ("# khep-twin: sensor test", "a,b", "line 1: 'a,b'; expected '# khep-twin: sensor test'"),
        ("# speed: 20", "# speed: fast", "speed = 'fast'; expected an integer"),
        ("# speed: 20\n", "", "speed: missing; expected an integer"),
        ("# speed: 20", "# speed: 0", "speed = 0; expected an integer from 1 to 127"),
        ("# what: proximity", "# what: sound", "what = sound; expected proximity, light or vision"),
        ("# motion: rotational", "# motion: linear", "motion = linear; expected rotational here"),
        (",left_90", ",left", "line 9: 'time_s,left_pulses,right_pulses,left,lef'; expected"),
        ("\n0.", "\n0x", "line 10: time_s = '0x"),
        ("\n0.", "\n7,0.", "line 10: 12 fields; expected 11"),
    ],
)
def test_a_mistake_in_a_table_is_reported_by_line_and_field(
    before: str, after: str, line: str, tmp_path: Path
) -> None:
    path = tmp_path / "run.csv"
    save(path, made_up(TURN, ""))
    path.write_text(path.read_text().replace(before, after, 1))
    with pytest.raises(SensorTestError) as caught:
        load(path)
    assert str(caught.value).startswith(f"{path}: {line}")


@pytest.mark.parametrize(
    ("values", "line"),
    [
        ({"x": 1.0}, "dv: missing or not real numbers"),
        ({"dv": "text"}, "dv: missing or not real numbers"),
        ({"dv": np.zeros((3, 9))}, "dv: is 3 x 9; expected rows of 10"),
        ({"dv": np.zeros((3, 10))}, "dv: the counters end at 0"),
        ({"dv": np.full((3, 10), 0.5)}, r"dv\(1,1\) = 0.5; expected an integer"),
        ({"dv": np.full((3, 10), np.nan)}, r"dv\(1,1\) = nan; expected an integer"),
        ({"dv": np.ones((3, 10)), "what": "sound"}, "what = sound; expected proximity, light or vision"),
        ({"dv": np.ones((3, 10)), "times": np.ones(2)}, "times: 2 values; expected 3"),
    ],
)
def test_a_foreign_mat_file_is_reported_by_variable(
    values: dict[str, Any], line: str, tmp_path: Path
) -> None:
    savemat(tmp_path / "x.mat", values)
    with pytest.raises(SensorTestError, match=line):
        load(tmp_path / "x.mat")


def test_numbers_in_small_types_and_the_other_byte_order_are_read() -> None:
    # As Matlab writes it: integral doubles are small integers, four bytes are in the tag of their element.
    def element(kind: int, content: bytes) -> bytes:
        head = kind.to_bytes(4, "big") + len(content).to_bytes(4, "big")
        return head + content + bytes(-len(content) % 8)

    flags, shape = element(6, bytes([0, 0, 0, 6, 0, 0, 0, 0])), element(5, bytes([0, 0, 0, 2, 0, 0, 0, 2]))
    name, numbers = b"\0\2\0\1dv\0\0", b"\0\4\0\1" + bytes([1, 2, 3, 255])
    data = b"MATLAB".ljust(124) + b"\x01\x00MI" + element(14, flags + shape + name + numbers)
    values = read_variables(data)["dv"]
    assert isinstance(values, np.ndarray)
    assert values.tolist() == [[1, 3], [2, -1]]


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_missing_and_empty_files_and_runs_are_refused(suffix: str, tmp_path: Path) -> None:
    path = tmp_path / f"run{suffix}"
    with pytest.raises(SensorTestError, match="cannot be read: No such file"):
        load(path)
    path.write_bytes(b"")
    with pytest.raises(SensorTestError, match="is empty; expected a file with a sensor test"):
        load(path)
    nothing = SensorRun(TURN, np.zeros((0, 10), np.int64), np.zeros(0))
    with pytest.raises(SensorTestError, match="the test has no rows"):
        save(path, nothing)


def test_another_suffix_is_refused_and_a_file_that_is_no_log_is_not_replaced(tmp_path: Path) -> None:
    with pytest.raises(SensorTestError, match=r"x\.txt; expected a name that ends in \.csv, \.mat or \.mcap"):
        save(tmp_path / "x.txt", made_up(TURN))
    (tmp_path / "x.mcap").write_text("letters")
    with pytest.raises(LogError, match="this file is no log"):
        save(tmp_path / "x.mcap", made_up(TURN))
