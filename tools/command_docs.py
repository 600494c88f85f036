"""docs/commands.md, every command with its options, out of the help texts.

    python -m tools commands [FILE]

Typer's own writer, without its limit of 45 characters to the sentence about a command in a list.
"""

import argparse
import sys
from unittest.mock import patch

import typer.cli
from typer.cli import Command


def _sentence(command: Command, limit: int = 0) -> str:
    """Return the first paragraph of a command's help."""
    return " ".join((command.help or "").partition("\n\n")[0].split())


def main() -> None:
    """Write the page."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("file", nargs="?", default="docs/commands.md")
    words = ["--name", "khep-twin", "--title", "Commands", "--output", parser.parse_args().file]
    with (
        patch.object(sys, "argv", ["typer", "khep_twin.cli.app", "utils", "docs", *words]),
        patch.object(Command, "get_short_help_str", _sentence),
    ):
        typer.cli.main()
