"""docs/commands.md lists every command with its options."""

import subprocess
import sys
from pathlib import Path

PAGE = Path(__file__).parents[2] / "docs" / "commands.md"


def test_the_page_of_commands_is_what_their_help_says(tmp_path: Path) -> None:
    made = tmp_path / "commands.md"
    command = [
        "-m",
        "typer",
        "khep_twin.cli.app",
        "utils",
        "docs",
        "--name",
        "khep-twin",
        "--title",
        "Commands",
    ]
    subprocess.run([sys.executable, *command, "--output", str(made)], check=True, capture_output=True)
    assert PAGE.read_text() == made.read_text(), "the help texts have changed: make commands"
