"""docs/toolbox.md: it lists all of the toolbox, its tests exist, its programs run."""

import ast
import math
import re
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from khep_twin import playpen as playpens
from khep_twin import toolbox
from khep_twin.cli.app import app
from khep_twin.toolbox import figures, roborunner, robot_view
from khep_twin.toolbox import serial_commands as host

TESTS = Path(__file__).parents[1]
PAGE = (TESTS.parent / "docs" / "toolbox.md").read_text()

FUNCTIONS = (
    "con skp sms rms cpid spc rpc rad cspc rmc cls rps rls "
    "sim_skp sim_sms sim_rms sim_spc sim_rpc sim_rmc sim_rps sim_rls "
    "khepbase play_pen roborun2 simsense tstsense template "
    "datameta dataprnt ddl ddlg ddr ddrg disonel "
    "checkobj kheprom movekhep putkhep rotkhep upsv ulsv cvrtang "
    "user1 getstat plotrun"
).split()
"""The manual's complete quick reference."""

ROWS = [
    [cell.strip() for cell in line.strip("| ").split(" | ")]
    for line in PAGE.split("## Toolbox reference")[1].splitlines()
    if line.startswith("| ") and not line.startswith("| toolbox")
]


def test_every_row_says_what_replaces_it_and_what_shows_it() -> None:
    assert len(ROWS) > 80
    for row in ROWS:
        assert len(row) == 3, row
        assert all(row), row
        assert "::test_" in row[2], row
        assert ("the designer page" not in row[1]) or "`khep-twin playpen " in row[2], row


def test_no_function_of_the_toolbox_is_left_out() -> None:
    names = set(re.findall(r"\w+", " ".join(" ".join(re.findall("`(.*?)`", row[0])) for row in ROWS)))
    assert not [name for name in FUNCTIONS if name not in names]


def test_every_test_that_the_page_names_is_there() -> None:
    for file, name in re.findall(r"`([\w/]+\.py)::(\w+)`", PAGE):
        tree = ast.parse((TESTS / file).read_text())
        assert name in {node.name for node in tree.body if isinstance(node, ast.FunctionDef)}, (file, name)


def test_every_command_that_the_page_names_is_there() -> None:
    runner = CliRunner()
    for words in {
        tuple(command.split()) for command in re.findall(r"`khep-twin ((?:playpen )?[a-z]+)", PAGE)
    }:
        assert runner.invoke(app, [*words, "--help"]).exit_code == 0, words


def test_the_names_of_the_toolbox_are_all_importable() -> None:
    assert not [name for name in FUNCTIONS if not callable(getattr(toolbox, name, None))]
    assert not [name for name in FUNCTIONS[:13] if getattr(host, name) is not getattr(toolbox, name)]


@pytest.mark.share(2)
@pytest.mark.parametrize("number", range(6))
def test_the_programs_on_the_page_run(
    number: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    for module in (robot_view, figures, roborunner):
        monkeypatch.setattr(module, "show", lambda figure, title: False)
    program = re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL)[number]
    names: dict[str, Any] = {"__name__": "__main__"}
    exec(compile(program, "docs/toolbox.md", "exec"), names)
    if number == 1:
        # The robot has reached the upper wall, 250 mm ahead, and turned.
        assert abs(toolbox.cvrtang(math.degrees(names["btmap1"].twin.robot.pose[2]) - 90)) > 10
    output = capsys.readouterr().out
    assert output.startswith("[") == (number in (1, 2))
    assert output.count("last speeds") == 3 * (number == 3)


def test_the_playpens_of_the_page_ship() -> None:
    assert {"default", "obstacles"} <= set(playpens.names())
