"""docs/commands.md: every command with its options, from the help texts.

    python -m tools commands [FILE]

It is written by Typer's writer, without its limit of 45 characters for a command's summary in a list, and
with a link to the page about the command.
"""

import re
import sys
from pathlib import Path
from unittest.mock import patch

import typer.cli
from typer.cli import Command

from tools.command_table import command_line

INTRODUCTION = """
No command replaces a finished log, playpen, calibration or table, unless you give `--force`; `run --resume`
does with the log of a run that it repeats. Pictures and pages that no one has changed since they were drawn
are drawn again. A file that appears while a command runs is kept, too: the result gets another name.
`khep-twin --install-completion` lets the shell complete playpens, controllers, calibrations and ports.
"""

PAGES = {
    "run": "experiments.md",
    "rollout": "scale.md",
    "series": "experiments.md#statistics",
    "sweep": "sweep.md",
    "new": "experiments.md",
    "design": "designer.md",
    "serve": "serving.md",
    "shadow": "twin.md",
    "ports": "host.md#ports",
    "drive": "host.md#manual-driving",
    "ros": "ros2.md",
    "view": "logs.md#viewing",
    "report": "report.md",
    "export": "report.md#tables",
    "recover": "logs.md",
    "repeat": "logs.md",
    "branch": "branch.md",
    "sense": "sense.md",
    "fit": "senses.md#calibrating-your-robot",
    "calibrate": "senses.md#calibrating-your-robot",
    "compile": "scale.md#compilation",
    "exec": "khepera4.md#run-a-program-of-the-robot",
    "conform": "protocol.md#checking-a-robot-an-emulator-or-a-recording",
    "playpen": "playpens.md",
    "challenge": "challenges.md",
}
"""Page about each command."""


def main() -> None:
    """Write the page."""
    parser = command_line(__doc__)
    parser.add_argument("file", nargs="?", default="docs/commands.md")
    file = Path(parser.parse_args().file)
    words = ["--name", "khep-twin", "--title", "Commands", "--output", str(file)]
    with (
        patch.object(sys, "argv", ["typer", "khep_twin.cli.app", "utils", "docs", *words]),
        patch.object(Command, "get_short_help_str", _sentence),
    ):
        typer.cli.app(standalone_mode=False)
    head, lists, rest = re.split(
        r"(?<=\n)(?=\*\*Commands\*\*:\n|## )", file.read_text(encoding="utf-8"), maxsplit=2
    )
    head = head.replace("\n**Usage**", f"{INTRODUCTION}\n**Usage**", 1)
    file.write_text(
        head + re.sub(r"^\* `(\w+)`: .*", _linked, lists, flags=re.MULTILINE) + rest, encoding="utf-8"
    )


def _sentence(command: Command, limit: int = 0) -> str:
    """Return the first paragraph of a command's help."""
    return " ".join((command.help or "").partition("\n\n")[0].split())


def _linked(line: re.Match[str]) -> str:
    """Return the line about a command with a link to its page, if any."""
    page = PAGES.get(line[1])
    return line[0] if page is None else f"{line[0]} [{page.partition('#')[0]}]({page})"
