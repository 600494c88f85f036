"""Programs of docs/experiments.md run unchanged."""

import re
from pathlib import Path
from typing import Any

import pytest

from khep_twin.host import Khepera
from khep_twin.lab.experiment.controllers import Controller
from khep_twin.lab.experiment.experiment import run
from khep_twin.lab.experiment.measures import UNITS

PAGE = (Path(__file__).parents[3] / "docs" / "experiments.md").read_text()
PROGRAMS = re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL)


@pytest.mark.parametrize("number", range(5))
def test_a_program_on_the_page_runs(number: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    names: dict[str, Any] = {"__name__": "page"}
    exec(compile(PROGRAMS[number], "docs/experiments.md", "exec"), names)
    for value in [*names.values()]:
        if isinstance(value, type) and issubclass(value, Controller) and value is not Controller:
            names["controller"] = value()
    if "controller" in names:
        with Khepera("khep://default") as robot:
            assert run(names["controller"], robot, cycles=2).complete


def test_there_are_as_many() -> None:
    assert len(PROGRAMS) == 5


def test_every_number_is_on_the_page_with_its_unit() -> None:
    for name, unit in UNITS.items():
        row = next(line for line in PAGE.splitlines() if line.startswith("|") and f"`{name}`" in line)
        assert unit in row.split("|")[2]
