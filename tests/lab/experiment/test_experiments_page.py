"""What docs/experiments.md shows runs as it stands."""

import re
import shlex
import sys
from pathlib import Path
from typing import Any

import pytest

from khep_twin.cli.app import main
from khep_twin.host import Khepera
from khep_twin.lab.experiment.controllers import Controller
from khep_twin.lab.experiment.experiment import run
from khep_twin.lab.experiment.measures import UNITS

PAGE = (Path(__file__).parents[3] / "docs" / "experiments.md").read_text()
PROGRAMS = re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL)
COMMANDS = "".join(re.findall(r"```sh\n(.*?)```", PAGE, re.DOTALL)).splitlines()


@pytest.mark.parametrize("number", range(4))
def test_a_program_on_the_page_runs(number: int) -> None:
    names: dict[str, Any] = {"__name__": "page"}
    exec(compile(PROGRAMS[number], "docs/experiments.md", "exec"), names)
    for found in [*names.values()]:
        if isinstance(found, type) and issubclass(found, Controller) and found is not Controller:
            names["controller"] = found()
    if "controller" in names:
        with Khepera("khep://default") as robot:
            assert run(names["controller"], robot, cycles=2).complete


def test_there_are_as_many() -> None:
    assert len(PROGRAMS) == 4
    assert len(COMMANDS) == 10


def test_the_commands_on_the_page_run_in_their_order(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [*sys.path])
    for command in COMMANDS:
        if "/dev/ttyUSB0" in command:
            continue
        monkeypatch.setattr(sys, "argv", shlex.split(command))
        with pytest.raises(SystemExit) as end:
            main()
        assert end.value.code == 0, command
    assert capsys.readouterr().err == ""
    assert (tmp_path / "series.png").stat().st_size > 20_000
    assert len((tmp_path / "wander" / "runs.csv").read_text().splitlines()) == 9


def test_every_number_is_on_the_page_with_its_unit() -> None:
    for name, unit in UNITS.items():
        row = next(line for line in PAGE.splitlines() if line.startswith("|") and f"`{name}`" in line)
        assert unit in row.split("|")[2]
