"""The folder of a series."""

import csv
import json
from enum import IntEnum
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pyarrow import parquet
from scipy.io import loadmat

from khep_twin.errors import ControllerError
from khep_twin.host import Khepera
from khep_twin.lab.experiment.controllers import Controller, as_controller, copy_variables
from khep_twin.lab.experiment.series_files import SeriesFolder, read_series
from khep_twin.lab.experiment.series_run import SeriesRun
from khep_twin.lab.experiment.start_poses import StartPose

SETTINGS: dict[str, Any] = {"seed": 1, "playpen": "a\nb\nc", "cycles": None}


class Mood(IntEnum):
    """A number with a name."""

    GOOD = 3


class Held(Controller):
    """Controller with variables of many types."""

    def __init__(self) -> None:
        self.width, self.half, self.text, self.true = 7, 0.5, "a,b\n\ud800", True
        self.mood, self.huge, self.far = Mood.GOOD, 2**70, np.float64(0.1)
        self.map = np.arange(6).reshape(2, 3)
        self.way = [(1, 2.5), (3, 4)]
        self._hidden, self.robot, self.ragged = 1, object(), [[1], [2, 3]]


def run(number: int, **variables: Any) -> SeriesRun:
    return SeriesRun(number, StartPose(100, 200, 90), 5, 0.25 * number, {"fitness": 0.1 * number}, variables)


def test_what_a_controller_holds_is_kept_as_plain_values() -> None:
    copies = copy_variables(Held())
    assert sorted(copies) == ["far", "half", "huge", "map", "mood", "text", "true", "way", "width"]
    assert {name: type(copies[name]) for name in ("mood", "huge", "far")} == {
        "mood": int,
        "huge": float,
        "far": float,
    }
    assert copies["text"] == "a,b\n\\ud800"
    assert copies["way"].tolist() == [[1, 2.5], [3, 4]]


def test_what_a_function_returns_is_its_variables() -> None:
    def steer(robot: Khepera) -> dict[str, int]:
        return {"near": max(robot.proximity())}

    controller = as_controller(steer)
    with Khepera("khep://default?noise=off") as robot:
        controller.start(robot)
        assert copy_variables(controller) == {}
        controller.cycle(robot)
    assert copy_variables(controller) == {"near": 0}


def test_single_variables_are_in_the_tables_and_arrays_in_mat_files(tmp_path: Path) -> None:
    folder = SeriesFolder(tmp_path / "deep" / "series", SETTINGS)
    copies = copy_variables(Held())
    assert folder.save(run(1, **copies))
    assert folder.save(run(2, cycles=9, late=1.5))
    with (folder.path / "runs.csv").open(newline="") as file:
        one, two = csv.DictReader(file)
    assert one["start_heading_deg"] == "90"
    assert (one["width"], one["text"], one["true"], one["mood"]) == ("7", "a,b\n\\ud800", "True", "3")
    assert (two["cycles"], two["controller_cycles"], two["late"], two["width"]) == ("5", "9", "1.5", "")
    table: Any = parquet.read_table(folder.path / "runs.parquet")
    assert table.column("late").to_pylist() == [None, 1.5]
    assert table.schema.field("duration_s").metadata == {b"unit": b"s"}
    columns = loadmat(folder.path / "runs.mat")
    assert columns["fitness"].tolist() == [[0.1], [0.2]]
    mat = loadmat(folder.path / "run-001.mat")
    assert mat["map"].tolist() == [[0, 1, 2], [3, 4, 5]]
    assert mat["way"].tolist() == [[1, 2.5], [3, 4]]
    assert read_series(folder.path)[1] == folder.rows


def test_long_names_stay_apart_in_mat_files(tmp_path: Path) -> None:
    folder = SeriesFolder(tmp_path, SETTINGS)
    folder.save(run(1, **{"n" * 70 + "a": 1, "n" * 70 + "b": 2, "ä": 3, "_": 4}))
    arrays = {
        name: value.item() for name, value in loadmat(tmp_path / "run-001.mat").items() if name[0] != "_"
    }
    assert arrays == {"n" * 63: 1, "n" * 55 + "_2": 2, "v_": 3, "v__2": 4}


def test_a_mixed_column_becomes_text_in_parquet(tmp_path: Path) -> None:
    folder = SeriesFolder(tmp_path, SETTINGS)
    folder.save(run(1, mixed=1, width=1))
    folder.save(run(2, mixed="a", width=1.5))
    table: Any = parquet.read_table(tmp_path / "runs.parquet")
    assert table.column("mixed").to_pylist() == ["1", "a"]
    assert table.column("width").to_pylist() == [1.0, 1.5]


def test_the_same_series_gives_the_same_bytes(tmp_path: Path) -> None:
    for name in ("one", "other"):
        SeriesFolder(tmp_path / name, SETTINGS).save(run(1, **copy_variables(Held())))
    files = sorted(path.name for path in (tmp_path / "one").iterdir())
    assert files == ["run-001.mat", "runs.csv", "runs.mat", "runs.parquet", "series.json"]
    for file in files:
        assert (tmp_path / "one" / file).read_bytes() == (tmp_path / "other" / file).read_bytes()


def test_a_run_that_is_there_has_to_come_out_the_same(tmp_path: Path) -> None:
    SeriesFolder(tmp_path, SETTINGS).save(run(1, luck=3))
    (tmp_path / "runs.csv").unlink()  # killed just before it was written
    folder = SeriesFolder(tmp_path, SETTINGS, resume=True)
    assert (tmp_path / "runs.csv").exists()
    assert not folder.save(run(1, luck=3))
    with pytest.raises(ControllerError, match="run 1, repeated, has luck 4, before 3; expected the same"):
        folder.save(run(1, luck=4))


@pytest.mark.parametrize(
    ("change", "line"),
    [
        ({"seed": 2}, "another seed: 1, now 2; expected the same, or another folder"),
        ({"playpen": "a\nx\nc"}, "another playpen: b, now x;"),
        ({"playpen": "a\nb\nc\nd"}, "another playpen: nothing, now d;"),
        ({"cycles": 5}, "another cycles: none, now 5;"),
        ({"port": "/dev/ttyUSB0"}, "another port: none, now /dev/ttyUSB0;"),
    ],
)
def test_another_series_does_not_go_on_in_its_place(
    change: dict[str, Any], line: str, tmp_path: Path
) -> None:
    SeriesFolder(tmp_path, SETTINGS).save(run(1))
    before = {path: path.read_bytes() for path in tmp_path.iterdir()}
    with pytest.raises(ControllerError) as caught:
        SeriesFolder(tmp_path, SETTINGS | change, resume=True)
    assert line in str(caught.value)
    assert "\n" not in str(caught.value)
    with pytest.raises(ControllerError, match="has a series of 1 runs already; expected --resume"):
        SeriesFolder(tmp_path, SETTINGS)
    assert before == {path: path.read_bytes() for path in tmp_path.iterdir()}


def test_a_series_of_no_runs_is_begun_anew(tmp_path: Path) -> None:
    SeriesFolder(tmp_path, SETTINGS)
    SeriesFolder(tmp_path, SETTINGS | {"seed": 2})
    assert SeriesFolder(tmp_path, SETTINGS | {"seed": 2}, resume=True).rows == []


@pytest.mark.parametrize(
    "text",
    [
        "",
        "[]",
        "{",
        '{"settings": 1, "runs": []}',
        '{"settings": {}, "runs": [1]}',
        '{"settings": {}, "runs": [{"run": 2}]}',
        '{"settings": {}, "runs": [{"run": 1, "fitness": [1]}]}',
        '{"settings": {}, "runs": [{"run": 1, "fitness": null}]}',
        "[" * 100_000,
    ],
)
def test_what_is_no_series_is_one_line_and_stays(text: str, tmp_path: Path) -> None:
    (tmp_path / "series.json").write_text(text)
    for resume in (False, True):
        with pytest.raises(ControllerError, match=r"series.json: not a series of khep_twin: ") as caught:
            SeriesFolder(tmp_path, SETTINGS, resume=resume)
        assert "\n" not in str(caught.value)
    assert (tmp_path / "series.json").read_text() == text


def test_a_folder_that_cannot_be_is_reported(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(ControllerError, match="file: no folder can be made here: File exists"):
        SeriesFolder(tmp_path / "file", SETTINGS)
    with pytest.raises(ControllerError, match="no series to resume"):
        SeriesFolder(tmp_path, SETTINGS, resume=True)
    assert json.loads((SeriesFolder(tmp_path, SETTINGS).path / "series.json").read_text())["runs"] == []


@pytest.mark.parametrize("name", ["runs.csv", "run-007.mat"])
def test_a_new_series_keeps_files_of_the_names_that_it_would_write(name: str, tmp_path: Path) -> None:
    (tmp_path / name).write_text("a year's work")
    with pytest.raises(ControllerError, match=rf"holds {name} and no series.json; expected another folder"):
        SeriesFolder(tmp_path, SETTINGS)
    assert [path.name for path in tmp_path.iterdir()] == [name]
