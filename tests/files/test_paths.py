"""Paths: every public function takes them as strings and as `pathlib.Path`."""

import inspect
import re
from collections.abc import Callable, Iterator
from importlib import import_module
from pathlib import Path

import pytest

import khep_twin
from khep_twin.drawing import draw, save
from khep_twin.drawing.map import blank_figure
from khep_twin.lab import sensor_test
from khep_twin.lab.conformance import conform_recording
from khep_twin.lab.experiment import SeriesFolder, read_series
from khep_twin.log import read_arrays, read_label, read_log
from khep_twin.log import read_series as read_channels
from khep_twin.ports.twin import TwinOptions, open_twin

PACKAGE = Path(khep_twin.__file__).parent
RESULTS = {"ChallengeFile", "LoggedRun"}
"""Classes that functions return, which users do not create."""


def public_functions() -> Iterator[tuple[str, Callable[..., object]]]:
    """Yield the functions, classes and methods that the packages export."""
    for path in PACKAGE.rglob("__init__.py"):
        if "lazy.names" not in path.read_text():
            continue
        root = import_module(".".join(("khep_twin", *path.parent.relative_to(PACKAGE).parts)))
        for name in set(root.__all__) - RESULTS:
            value = getattr(root, name)
            yield name, value
            for key in vars(value) if inspect.isclass(value) else ():
                if not key.startswith("_"):
                    yield f"{name}.{key}", getattr(value, key)


def test_no_public_function_takes_a_path_alone() -> None:
    path_only: list[str] = []
    with_paths: list[str] = []
    for name, function in public_functions():
        try:
            parameters = inspect.signature(function).parameters.values()
        except (TypeError, ValueError):  # of a module, a number or a class of C
            continue
        for parameter in parameters:
            kinds = inspect.formatannotation(parameter.annotation)
            with_paths += [name] * ("PathLike" in kinds)
            path_only += [f"{name}({parameter.name}: {kinds})"] * bool(re.search(r"\bPath\b", kinds))
    assert not path_only
    assert len(with_paths) > 30


def test_a_path_may_be_a_string(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    with open_twin("default", TwinOptions(log="run.mcap")) as twin:
        twin.robots[0].send(b"N\n")
        twin.advance_to(200_000_000)
    for read in (read_log, read_label, read_channels, read_arrays, conform_recording):
        assert read("run.mcap"), read
        assert read(Path("run.mcap")), read
    save(draw(khep_twin.Playpen.load("default")), "map.png")
    save(blank_figure(1, 1), "sheet.svg")
    SeriesFolder("series", {})
    assert read_series("series") == ({}, [])
    with pytest.raises(khep_twin.KhepTwinError, match=r"none\.csv: cannot be read"):
        sensor_test.load("none.csv")
    assert {"map.png", "sheet.svg"} < {path.name for path in tmp_path.iterdir()}
