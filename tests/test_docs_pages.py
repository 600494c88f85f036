"""Every block of the pages: programs compile, commands are those of the command line and the Makefile.

Pages that a reader follows have their own tests beside this one, which run their blocks.
"""

import re
import shlex
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path

import pytest
import typer

from khep_twin import playpen
from khep_twin.cli.app import app
from khep_twin.ports.twin import TwinOptions, open_twin
from tools import runs

ROOT = Path(__file__).parents[1]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
TARGETS = set(re.findall(r"^([a-z0-9-]+):.*##", (ROOT / "Makefile").read_text(), re.MULTILINE))

BLOCK = re.compile(r"^```(\w*)[^\n]*\n(.*?)^```$", re.MULTILINE | re.DOTALL)

SEPARATORS = {"|", "&&", "||", ";", "&", ">", "2>", ">>"}


def blocks(language: str) -> Iterator[tuple[Path, str]]:
    for page in PAGES:
        if "reference" not in page.parts:
            for block_language, text in BLOCK.findall(page.read_text(encoding="utf-8")):
                if block_language == language:
                    yield page, text


def commands() -> Iterator[tuple[str, list[str]]]:
    """The words of each command in a block for the shell, and its page."""
    for page, text in blocks("sh"):
        line = ""
        for part in text.replace("\\\n", " ").splitlines():
            line += part
            try:
                words = shlex.split(line, comments=True)
            except ValueError:  # a quotation over several lines
                line += "\n"
                continue
            line = ""
            ends = [-1, *(place for place, word in enumerate(words) if word in SEPARATORS), len(words)]
            for begin, end in pairwise(ends):
                if words[begin + 1 : end]:
                    yield str(page.relative_to(ROOT)), words[begin + 1 : end]


COMMANDS = list(commands())
COMMAND_LINE = typer.main.get_command(app)


@pytest.mark.parametrize(
    ("page", "text"), [*blocks("python")], ids=lambda parameter: getattr(parameter, "stem", "")
)
def test_a_program_compiles(page: Path, text: str) -> None:
    compile(text, page.name, "exec")


def named(name: str) -> list[tuple[str, list[str]]]:
    return [(page, words) for page, words in COMMANDS if Path(words[0]).name == name]


def test_there_are_commands() -> None:
    assert len(named("khep-twin")) > 100
    assert len(named("make")) > 5


@pytest.mark.parametrize(("page", "words"), named("khep-twin"), ids=str)
def test_a_command_has_only_options_that_there_are(page: str, words: list[str]) -> None:
    assert unknown(words) == []


def test_an_unknown_option_is_found() -> None:
    assert unknown(["khep-twin", "serve", "default", "--nothing"]) != []


def unknown(words: list[str]) -> list[str]:
    """Parse the words of a command without running it; return what is left, nothing if all are known."""
    command = COMMAND_LINE
    rest = words[1:]
    context = command.make_context("khep-twin", [], resilient_parsing=True)
    while hasattr(command, "commands") and rest and not rest[0].startswith("-"):
        command = command.commands[rest[0]]
        context = command.make_context(rest.pop(0), [], parent=context, resilient_parsing=True)
    _, unparsed, _ = command.make_parser(context).parse_args(rest)
    return unparsed


@pytest.mark.parametrize(("page", "words"), named("make"), ids=str)
def test_a_target_of_make_is_there(page: str, words: list[str]) -> None:
    assert {word for word in words[1:] if "=" not in word} <= TARGETS


def test_the_program_of_branches_goes_on_from_a_log(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("out").mkdir()
    with open_twin("obstacles", TwinOptions(log="out/run.mcap")) as twin:
        twin.advance_to(13_000_000_000)
    (program,) = (text for page, text in blocks("python") if page.name == "branch.md")
    exec(compile(program, "branch.md", "exec"), {})
    assert capsys.readouterr().out.startswith("12.5 ")


def test_the_playpen_of_the_page_about_them_is_right() -> None:
    (example,) = [text for page, text in blocks("toml") if page.name == "playpens.md"]
    assert playpen.parse(example, "playpens.md").name == "mine"


def test_pages_link_runs_of_the_site_that_are_made() -> None:
    assert set(runs.PAGES.values()) <= runs.RUNS.keys()
    assert all((ROOT / page).read_text(encoding="utf-8").startswith("# ") for page in runs.PAGES)
