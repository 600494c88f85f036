"""docs/commands.md, every command with its options, out of the help texts: `make commands`.

    python tools/command_docs.py FILE

Typer's own writer, without its limit of 45 characters to the sentence about a command in a list.
"""

import sys
from unittest.mock import patch

from typer.cli import Command, main


def _sentence(command: Command, limit: int = 0) -> str:
    """Return the first paragraph of a command's help."""
    return " ".join((command.help or "").partition("\n\n")[0].split())


if __name__ == "__main__":
    words = ["--name", "khep-twin", "--title", "Commands", "--output", sys.argv[1]]
    sys.argv = ["typer", "khep_twin.cli.app", "utils", "docs", *words]
    with patch.object(Command, "get_short_help_str", _sentence):
        main()
