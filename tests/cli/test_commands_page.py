"""docs/commands.md lists every command with its options."""

import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[2]
PAGE, WRITER = ROOT / "docs" / "commands.md", ROOT / "tools" / "command_docs.py"


def test_the_page_of_commands_is_what_their_help_says(tmp_path: Path) -> None:
    made = tmp_path / "commands.md"
    subprocess.run([sys.executable, str(WRITER), str(made)], check=True, capture_output=True)
    assert PAGE.read_text() == made.read_text(), "the help texts have changed: make commands"
