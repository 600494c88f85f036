"""docs/security.md: its tests exist, and only the listed parts listen."""

import ast
import re
from functools import cache
from pathlib import Path

import pytest

from khep_twin.cli.design import design
from khep_twin.errors import PortError
from khep_twin.log.viewer.process import LOCALHOST
from khep_twin.ports.endpoints import open_endpoints
from khep_twin.ports.network import is_loopback, parse_address
from khep_twin.sweep.ray_workers import LOOPBACK

ROOT = Path(__file__).parents[1]
PAGE = (ROOT / "docs" / "security.md").read_text()
SOURCES = sorted((ROOT / "khep_twin").rglob("*.py"))

LISTENERS, STATEMENTS = (
    [
        [cell.strip() for cell in line.strip("| ").split(" | ")]
        for line in part.splitlines()[4:]
        if "|" in line
    ]
    for part in (
        PAGE.split("## What listens where")[1].split("\n## ")[0],
        PAGE.split("## A web page in your browser")[1].split("\n## Not protected")[0],
    )
)


@cache
def calls(path: Path) -> set[str]:
    """Names of the functions and methods that a file calls, or gives to one that may call them."""
    calls = [node for node in ast.walk(ast.parse(path.read_text())) if isinstance(node, ast.Call)]
    called = [name for call in calls for name in (call.func, *call.args)]
    return {
        name_node.attr if isinstance(name_node, ast.Attribute) else name_node.id
        for name_node in called
        if isinstance(name_node, ast.Attribute | ast.Name)
    }


def users(*names: str) -> set[str]:
    """Files of the package that call one of these functions."""
    return {str(path.relative_to(ROOT)) for path in SOURCES if calls(path) & set(names)}


def test_every_test_that_the_page_names_is_there() -> None:
    named = re.findall(r"`(tests/[\w/]+\.py)::(\w+)`", PAGE)
    assert len(named) > 40
    for file, name in named:
        tree = ast.parse((ROOT / file).read_text())
        assert name in {
            statement.name for statement in tree.body if isinstance(statement, ast.FunctionDef)
        }, (file, name)


def test_every_statement_has_a_test() -> None:
    rows = [row for row in STATEMENTS if len(row) > 1 and row[-1] != "test" and set(row[0]) - {"-"}]
    assert len(rows) > 25
    for row in rows:
        assert "::test_" in row[-1], row


def test_nothing_listens_but_what_the_page_lists() -> None:
    listeners = users("create_server", "bind", "openpty", "start_server", "serve_web", "serve_grpc")
    listeners |= {str(path.relative_to(ROOT)) for path in SOURCES if '"--bind"' in path.read_text()}
    listeners |= {str(path.relative_to(ROOT)) for path in SOURCES if "ray.init(" in path.read_text()}
    assert listeners == set(re.findall(r"`(khep_twin/[\w/]+\.py)`", "".join(map(str, LISTENERS))))


def test_code_comes_from_where_the_page_says_alone() -> None:
    executors = users("exec", "eval", "exec_module", "import_module", "entry_points")
    part = PAGE.split("## Trusted")[1].split("\n## ")[0]
    assert executors == set(re.findall(r"`(khep_twin/[\w/]+\.py)`", part))


def test_nothing_is_unpickled() -> None:
    imports = r"^\s*(?:import|from) (?:pickle|cPickle|marshal|shelve|dill|joblib|cloudpickle|yaml)\b"
    for path in SOURCES:
        text = path.read_text()
        assert not re.search(imports, text, re.MULTILINE), path
        assert "allow_pickle=True" not in text, path


def test_every_address_that_is_given_by_default_is_of_this_machine_alone() -> None:
    assert is_loopback(LOCALHOST)
    assert is_loopback(LOOPBACK)
    assert design.__defaults__ is not None
    listen = [default for default in design.__defaults__ if isinstance(default, str) and ":" in default]
    assert listen == ["127.0.0.1:0"]
    assert is_loopback(parse_address(":5000")[0])


@pytest.mark.parametrize("option", ["tcp", "rfc2217"])
@pytest.mark.parametrize("address", ["0.0.0.0:0", "[::]:0", "10.0.0.1:5000", "robot.example:5000"])
def test_a_served_robot_is_for_other_machines_only_where_that_is_asked_for(option: str, address: str) -> None:
    addresses: dict[str, str | None] = {"tcp": None, "rfc2217": None, option: address}
    endpoints = open_endpoints(
        {0: 9600}, link=None, tcp=addresses["tcp"], rfc2217=addresses["rfc2217"], allow_remote=False
    )
    with pytest.raises(PortError, match="--allow-remote"), endpoints:
        pass
