"""docs/commands.md lists every command with its options."""

import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[2]
PAGE = ROOT / "docs" / "commands.md"


def test_the_page_of_commands_is_what_their_help_says(tmp_path: Path) -> None:
    page = tmp_path / "commands.md"
    subprocess.run(
        [sys.executable, "-m", "tools", "commands", str(page)], check=True, capture_output=True, cwd=ROOT
    )
    assert PAGE.read_text() == page.read_text(), "the help texts have changed: python -m tools commands"
