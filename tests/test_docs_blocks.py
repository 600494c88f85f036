"""docs/*.md: the blocks of a page, copied into a folder in order, run without an error.

Runs are shortened here; `make long LONG=docs-blocks` takes them as they are written, runs the long ones, too,
and lists what cannot run in a test.
"""

import ast
import importlib
import re
import shlex
import sys
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest
import typer
from docs_reader import ROOT, Reader, blocks, commands, fewer, shortened
from typer.exceptions import TyperException

from khep_twin.cli.app import app

FOLLOWED = {
    "tutorial.md": "test_tutorial.py",
    "challenges.md": "test_lessons.py",
    "turrets.md": "test_turrets_page.py",
    "robots.md": "robots/test_robots_page.py",
    "khepera3.md": "robots/khepera3/test_khepera3_page.py",
}
"""Pages that another test follows whole."""

PROGRAMS = {
    "branch.md": "test_docs_pages.py",
    "environments.md": "envs/test_environment.py",
    "README.md": "test_readme.py",
    "host.md": "host/test_guide.py",
    "scale.md": "episodes/test_page.py",
    "toolbox.md": "toolbox/test_toolbox_page.py",
}
"""Pages whose Python blocks another test runs, and compares."""

LONG = {
    "branch",
    "datasets",
    "drawing",
    "evolve_train_drive",
    "experiments",
    "logs",
    "report",
    "sense",
    "twin",
}
"""Pages that take long: the suite looks at their commands and imports alone."""

TEXTS = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]

PAGES = [
    pytest.param(page, languages, id=page.stem, marks=pytest.mark.long if page.stem in LONG else ())
    for page in TEXTS
    if page.parent.name != "lessons"
    for languages in [{"sh"} if page.name in PROGRAMS else {"sh", "python"}]
    if page.name not in FOLLOWED and languages & {block.language for block in blocks(page.read_text())}
]


@pytest.mark.parametrize(("page", "languages"), PAGES)
def test_the_blocks_of_a_page_run_in_order(
    page: Path, languages: set[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PYTHONPATH", str(ROOT))
    monkeypatch.setenv("PATH", f"{Path(sys.executable).parent}:/usr/local/bin:/usr/bin:/bin")
    monkeypatch.setenv("MPLBACKEND", "agg")
    monkeypatch.setenv("BROWSER", "true")  # the program: no page opens
    monkeypatch.delenv("DISPLAY", raising=False)
    reader = Reader(tmp_path)
    reader.read(page.read_text(), languages)
    print("\n".join(f"{page.name}, not run: {block}" for block in reader.left))


@pytest.mark.parametrize("page", TEXTS, ids=lambda page: page.stem)
def test_the_commands_of_a_page_have_their_options(page: Path) -> None:
    for block in blocks(page.read_text()):
        for command in commands(block.text) if block.language == "sh" else ():
            program, *words = shlex.split(re.split(r" (?:[|>&]|2>)", command)[0], comments=True)
            if Path(program).name == "khep-twin":
                with suppress(typer.Exit):  # of --help
                    parse(typer.main.get_command(app), "khep-twin", words)


def test_an_option_that_a_command_does_not_have_is_noticed() -> None:
    with pytest.raises(TyperException, match="--no-such"):
        parse(typer.main.get_command(app), "khep-twin", ["run", "--no-such"])


def parse(command: Any, name: str, words: list[str]) -> None:
    """Parse the words of a command, and of the one that they name.

    Raises:
        TyperException: There is no such command or option, or it takes no such value.
    """
    context = command.make_context(name, words)
    if isinstance(command, typer.core.TyperGroup):
        name, subcommand, rest = command.resolve_command(context, [*context._protected_args, *context.args])
        parse(subcommand, str(name), rest)


@pytest.mark.parametrize("page", TEXTS, ids=lambda page: page.stem)
def test_the_imports_of_a_page_are_there(page: Path) -> None:
    for block in blocks(page.read_text()):
        for node in ast.walk(ast.parse(block.text)) if block.language == "python" else ():
            if isinstance(node, ast.ImportFrom) and str(node.module).startswith("khep_twin"):
                module = importlib.import_module(str(node.module))
                assert all(alias.name == "*" or hasattr(module, alias.name) for alias in node.names), (
                    node.module
                )


def test_the_tests_of_the_other_pages_are_there() -> None:
    for page, test in {**FOLLOWED, **PROGRAMS}.items():
        assert page in (ROOT / "tests" / test).read_text(), page


def test_a_command_goes_on_in_the_next_line_and_in_a_quotation() -> None:
    assert [*commands("a \\\n  b\n\nc 'd\ne'\n# nothing\nf # g\n")] == ["a \\\n  b", "c 'd\ne'", "f # g"]


def test_a_block_that_fails_is_reported(tmp_path: Path) -> None:
    with pytest.raises(AssertionError, match="line 3"):
        Reader(tmp_path).read("# Page\n\n```python\n1 / 0\n```\n", {"python"})
    with pytest.raises(AssertionError, match="no-such-page"):
        Reader(tmp_path).read("# Page\n\n```sh\nkhep-twin playpen draw no-such-page\n```\n", {"sh"})


def test_a_block_that_is_not_run_is_listed_with_its_reason(tmp_path: Path) -> None:
    reader = Reader(tmp_path)
    reader.read("<!-- not run: no robot -->\n\n```sh\nfalse\n```\n\n```sh\nmake long\n```\n", {"sh"})
    assert reader.left == ["line 3, a block of sh: no robot", "make long: a target of the Makefile"]


def test_runs_are_shortened_in_the_suite() -> None:
    assert shortened("khep-twin run --seconds 60 --runs 5 --cycles 200") == (
        "khep-twin run --seconds 13 --runs 2 --cycles 20"
    )


def test_programs_that_are_files_are_shortened_in_the_suite() -> None:
    assert fewer("GENERATIONS = 30\nf(GENERATIONS = 30)\n") == "GENERATIONS = 2\nf(GENERATIONS = 30)\n"
