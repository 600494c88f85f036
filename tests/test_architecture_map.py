"""docs/architecture.md and CONTRIBUTING.md: each name is in the file that they give for it."""

import ast
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
MAP = ROOT / "docs" / "architecture.md"
PAGES = MAP, ROOT / "CONTRIBUTING.md"

NAMED = re.compile(r"((?:`[^`\n]+`(?:, and |, | and | or ))*`[^`\n]+`)\s+(?:in|of)\s+`([\w./-]+\.(?:py|js))`")
"""Names in a file, such as "`TASKS` and `TERMS` in `khep_twin/envs/tasks.py`"."""

NAME = re.compile(r"#?([A-Za-z_][\w.]*)(?:\(.*\))?")


def pairs(text: str) -> list[tuple[str, str]]:
    """Return the names on a page that are outside its code blocks, each with its file."""
    text = re.sub(r"^```.*?^```", "", text, flags=re.DOTALL | re.MULTILINE)
    return [
        (match[1], path)
        for names, path in NAMED.findall(text)
        for name in re.findall("`([^`]+)`", names)
        if (match := NAME.fullmatch(name)) and "/" not in name
    ]


def definitions(path: Path) -> set[str]:
    """Return the names that a file defines: those of a class also as CLASS.NAME."""
    text = path.read_text()
    if path.suffix == ".js":
        pattern = r"(?:const|let|function|class) (\w+)|^ *(?:async |static )?#?(\w+)(?: =|\()"
        return {name for names in re.findall(pattern, text, re.MULTILINE) for name in names if name}
    tree = ast.parse(text)
    names = set(names_of(tree))
    for node in ast.walk(tree):
        if isinstance(node, ast.ClassDef):
            names |= {f"{node.name}.{name}" for name in names_of(node)}
    return names


def names_of(tree: ast.AST) -> list[str]:
    """Return the functions, classes, constants and attributes that a tree defines."""
    names: list[str] = []
    for node in ast.walk(tree):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef):
            names.append(node.name)
        targets = node.targets if isinstance(node, ast.Assign) else []
        targets = [node.target] if isinstance(node, ast.AnnAssign) else targets
        for target in targets:
            for part in target.elts if isinstance(target, ast.Tuple) else [target]:
                names += [part.id] if isinstance(part, ast.Name) else []
                names += [part.attr] if isinstance(part, ast.Attribute) else []
    return names


def wrong(text: str) -> list[str]:
    """Return the names of a page that are not in their files."""
    return [
        f"{name} in {path}"
        for name, path in pairs(text)
        if not (ROOT / path).is_file() or name not in definitions(ROOT / path)
    ]


def test_the_map_has_many_names_with_their_files() -> None:
    assert len(pairs(MAP.read_text())) >= 40


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_each_name_is_in_its_file(page: Path) -> None:
    assert not wrong(page.read_text())


@pytest.mark.parametrize(
    "text",
    [
        "`TASK` in `khep_twin/envs/tasks.py`",
        "`TASKS` and `TERM` in `khep_twin/envs/tasks.py`",
        "`State.robot` in `khep_twin/envs/tasks.py`",
        "`Sensor` in `khep_twin/envs/tasks.py`",
        "`TASKS` in `khep_twin/tasks.py`",
        "`showPictures` in `khep_twin/assets/web/run.js`",
    ],
)
def test_a_wrong_name_is_seen(text: str) -> None:
    assert len(wrong(text)) == 1


def test_each_path_on_the_map_exists() -> None:
    folders = "khep_twin|tests|checks|studies|tools|docs"
    paths = re.findall(rf"`((?:{folders})/[\w./-]+)`", MAP.read_text())
    assert len(paths) >= 100
    assert not [path for path in paths if not (ROOT / path).exists()]
    files = {path.name for path in (ROOT / "khep_twin").rglob("*.*")}
    assert set(re.findall(r"`(\w+\.(?:py|js))`", MAP.read_text())) - files == {"protocol_NAME.py"}


def test_the_map_has_all_readers_of_obstacles() -> None:
    row = next(row for row in MAP.read_text().splitlines() if row.startswith("| walls and objects"))
    pattern = re.compile(
        r"\b(?:playpen|self)\.obstacles\.(?:items|values)\(|(?:\*\*|_labelled\()playpen\.obstacles\b"
    )
    modules = (ROOT / "khep_twin").rglob("*.py")
    counts = {path.relative_to(ROOT).as_posix(): len(pattern.findall(path.read_text())) for path in modules}
    readers = {path: count for path, count in counts.items() if count}
    assert set(re.findall(r"`(khep_twin/[^`]*)`", row)) == readers.keys()
    assert f"{sum(readers.values())} places" in row
    walls = [path for path in readers if re.search(r"\bplaypen\.walls\b", (ROOT / path).read_text())]
    assert not walls
