"""PageFollower: follows the recipes of a page literally, in a copy of the tree."""

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]

CREATE = re.compile(r"Create `(?P<file>[^`]+)`")
EDIT = re.compile(
    r"In `(?P<file>[^`]+)`, (?P<side>after|before) the line (`+)(?P<line>.+?)\3, "
    r"add(?::$| (`+)(?P<added>.+)\5\.$)"
)

# pip would write into the environment of whoever runs the suite. This one makes the entry points known alone.
PIP = """
import sys, tomllib
from pathlib import Path

if "-e" in sys.argv:
    folder = Path(sys.argv[sys.argv.index("-e") + 1].partition("[")[0])
    read = tomllib.loads((folder / "pyproject.toml").read_text())
    project, groups = read["project"], read["project"]["entry-points"]
    lines = [f"[{group}]\\n" + "".join(f"{name} = {value}\\n" for name, value in entries.items())
             for group, entries in groups.items()]
    found = Path(f"{project['name'].replace('-', '_')}-0.dist-info")
    found.mkdir(exist_ok=True)
    (found / "METADATA").write_text(f"Name: {project['name']}\\nVersion: 0\\n")
    (found / "entry_points.txt").write_text("".join(lines))
    for package in read["tool"]["setuptools"]["packages"] if folder != Path() else ():
        if not Path(package).exists():
            Path(package).symlink_to(folder / package)
"""

LIST = ["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard"]
CHECKOUT = pytest.mark.skipif(not (ROOT / ".git").exists(), reason="no checkout whose files git could list")


class PageFollower:
    """Follows recipes in a copy of the tree, with the environment that runs the suite.

    Attributes:
        page: Text of the page.
        tree: Copy of the tree.
        typing: Whether commands are run, and their output compared.
        touched: Files that were created or edited.
        shown: Output of the last commands.
    """

    def __init__(self, page: str, tree: Path, *, typing: bool = True) -> None:
        self.page, self.tree, self.typing = page, tree, typing
        self.touched: list[str] = []
        self.output = ""
        for name in subprocess.check_output(LIST, cwd=ROOT, text=True).split("\0")[:-1]:
            if (ROOT / name).is_file():  # one that is deleted, and not committed yet, is not there
                (tree / name).parent.mkdir(parents=True, exist_ok=True)
                shutil.copyfile(ROOT / name, tree / name)
        (tree / "pip.py").write_text(PIP)
        (tree / ".venv").mkdir()
        for entry in Path(sys.prefix).iterdir():
            if entry.suffix != ".stamp":
                (tree / ".venv" / entry.name).symlink_to(entry)
        for stamp in ("made", "run", "dev"):
            (tree / ".venv" / f"{stamp}.stamp").touch()

    def follow(self, recipe: str) -> None:
        """Follow a recipe: the edits of one line, and each block by the line above it."""
        lines = iter(self.page.split(f"\n## {recipe}\n")[1].split("\n## ")[0].splitlines())
        step = ""
        for line in lines:
            if line.startswith("```"):
                block = "".join(f"{block_line}\n" for block_line in iter(lambda: next(lines), "```"))
                self._block(line.strip("`"), step, block)
                step = ""
            elif (edit := EDIT.search(line)) and edit["added"]:
                self._edit(edit, edit["added"] + "\n")
            elif line:
                step = line

    def run(self, command: str) -> str:
        """Run shell commands in the tree; return what they print."""
        outer = {"MAKEFLAGS", "MAKELEVEL", "MFLAGS"}
        env = {key: text for key, text in os.environ.items() if key not in outer and "PYTEST" not in key}
        process = subprocess.run(
            ["sh", "-ec", command],
            cwd=self.tree,
            env={**env, "PYTHONPATH": str(self.tree), "COLUMNS": "80"},
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            timeout=300,
        )
        assert process.returncode == 0, f"{command}\n{process.stdout}"
        return process.stdout

    def _block(self, language: str, step: str, block: str) -> None:
        if language in ("sh", "text"):
            if self.typing and language == "sh":
                self.output = self.run(block)
            elif self.typing:
                assert timeless(self.output) == timeless(block)
        elif edit := EDIT.search(step):
            self._edit(edit, block)
        else:
            create = CREATE.search(step)
            assert create, f"a block below a line that names no file: {step!r}"
            assert not (self.tree / create["file"]).exists()
            (self.tree / create["file"]).write_text(block)
            self.touched.append(create["file"])

    def _edit(self, edit: re.Match[str], added: str) -> None:
        path, (start, cut, _) = self.tree / edit["file"], edit["line"].strip().partition("…")
        lines = path.read_text().splitlines(keepends=True)
        line_numbers = [
            number
            for number, line in enumerate(lines)
            if (line.strip().startswith(start.strip()) if cut else line.strip() == start)
        ]
        assert len(line_numbers) == 1, f"{edit['file']} has {len(line_numbers)} lines {edit['line']!r}"
        if edit["added"]:
            added = re.match(r"\s*", lines[line_numbers[0]])[0] + added
        lines.insert(line_numbers[0] + (edit["side"] == "after"), added)
        path.write_text("".join(lines))
        self.touched.append(edit["file"])


def timeless(text: str) -> str:
    return re.sub(r"in \d+\.\d+s", "in a while", text)
