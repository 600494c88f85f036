"""Execution of the tutorial's blocks as by a reader: in order, in one folder.

A block whose first line is `# NAME` is a file. Other Python blocks are typed at a prompt until `exit()`,
blocks of `sh` are typed in a terminal, and a block of `text` is the output of the one before. `/dev/ttyUSB0`
is a served twin.

The numbers of a run depend in their last bits on MuJoCo, numpy and the kind of machine. A comment
in the page names the versions behind its numbers; if they are the same, every number is compared.

    python -m tools tutorial    # regenerates the pictures and numbers of the tutorial and the README
"""

import ast
import contextlib
import io
import os
import re
import runpy
import shlex
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from unittest.mock import patch

from PIL import Image
from typer.testing import CliRunner

from khep_twin.cli.app import app
from khep_twin.host import Khepera
from khep_twin.log.run_description import versions
from tools.command_table import command_line

PAGE = Path(__file__).parents[1] / "docs" / "tutorial.md"
PICTURES = PAGE.parent / "pictures"
MAKEFILE = PAGE.parents[1] / "Makefile"

ROBOT = "/dev/ttyUSB0"
LAB = "~/khepera-lab"
WIDTH = 640
"""Width of the page's pictures [pixels]."""


@dataclass(frozen=True)
class Block:
    """A block of the page."""

    line: int
    language: str
    text: str

    @property
    def file(self) -> str | None:
        """File to save it as."""
        match = re.match(r"# (\S+\.(?:py|toml))\n", self.text)
        return match[1] if match else None


def blocks(page: str) -> list[Block]:
    """Return all blocks of a page; the lines are those of the fences."""
    return [
        Block(page[: match.start()].count("\n") + 1, match[1], match[2])
        for match in re.finditer(r"^```(\w*)\n(.*?)^```$", page, re.DOTALL | re.MULTILINE)
    ]


def pictures(page: str) -> list[str]:
    """Return the names of the tutorial's pictures, without their `tutorial_`."""
    return re.findall(r"pictures/tutorial_(\w+\.png)", page)


def made_with() -> str:
    """Return the page's comment on the versions behind its numbers, for this machine."""
    dependencies = {key: text for key, text in versions().items() if key != "khep_twin"}
    return f"<!-- Numbers made with: {', '.join(f'{key} {text}' for key, text in dependencies.items())}. -->"


def same_numbers() -> bool:
    """Return whether this machine must print exactly the numbers of the page."""
    return made_with() in PAGE.read_text()


def replace_block(page: str, block: Block, output: str) -> str:
    """Return the page with another text in one of its blocks."""
    lines = page.splitlines(keepends=True)
    lines[block.line : block.line + block.text.count("\n")] = output.splitlines(keepends=True)
    return "".join(lines)


def likeness(text: str) -> str:
    """Return an output without its numbers and their columns, which differ between machines."""
    return re.sub(r"\s+", " ", re.sub(r"-?\d+(?:\.\d*)?(?:e-?\d+)?", "#", text)).strip()


@dataclass
class Reader:
    """A reader who types the blocks of the page.

    Attributes:
        folder: Working directory.
        exact: True if the numbers shown have to be the page's.
        output: Output of the last block.
        undrawn: Pictures that rerun's viewer cannot draw here, without Vulkan.
    """

    folder: Path
    exact: bool = False
    output: str = ""
    undrawn: list[str] = field(default_factory=list[str])
    _names: dict[str, Any] = field(default_factory=dict[str, Any])
    _servers: list["subprocess.Popen[bytes]"] = field(default_factory=list["subprocess.Popen[bytes]"])

    def follow(self, block: Block) -> None:
        """Execute a block.

        Raises:
            AssertionError: The block fails, or its output differs from the page.
        """
        if block.file:
            (self.folder / block.file).write_text(block.text)
        elif block.language == "python":
            self.output = self._prompt(block.text)
        elif block.language == "sh":
            self.output = "".join(self._command(line) for line in block.text.splitlines())
        elif block.language == "text":
            is_same = (
                self.output == block.text if self.exact else likeness(self.output) == likeness(block.text)
            )
            assert is_same, f"line {block.line}: shown was\n{self.output}"
        else:
            raise AssertionError(f"line {block.line}: a block of {block.language or 'nothing'}")

    def close(self) -> None:
        """Stop the servers."""
        for server in self._servers:
            server.kill()
            server.wait()

    def _prompt(self, text: str) -> str:
        """Type statements at Python's prompt."""
        if text.endswith("exit()\n"):
            text, next_names = text.removesuffix("exit()\n"), dict[str, Any]()
        else:
            next_names = self._names
        buffer = io.StringIO()
        with contextlib.redirect_stdout(buffer):
            for statement in ast.parse(text).body:
                exec(compile(ast.Interactive([statement]), "tutorial", "single"), self._names)
        self._names = next_names
        return buffer.getvalue()

    def _command(self, line: str) -> str:
        """Type a line in the terminal."""
        program, *words = shlex.split(line.replace(LAB, str(self.folder)))
        if ROBOT in words:
            link = self.folder / "robot-link"
            if not link.is_symlink():
                self._serve(["default", "--link", str(link)])
            words = [str(link) if word == ROBOT else word for word in words]
        if words[:1] == ["serve"]:
            self._serve(words[1:])
            return ""
        if program == "khep-twin":
            result = CliRunner().invoke(app, words, prog_name="khep-twin")
            if "rerun's viewer cannot draw here" in str(result.exception):
                self.undrawn.append(words[-1])
                return f"picture  {words[-1]}\n"
            assert result.exit_code == 0, f"{line}\n{result.output}{result.exception or ''}"
            return result.stdout
        assert program == "python", line
        buffer = io.StringIO()
        saved_argv = sys.argv
        sys.argv = words
        try:
            with contextlib.redirect_stdout(buffer):
                runpy.run_path(words[0], run_name="__main__")
        finally:
            sys.argv = saved_argv
        return buffer.getvalue()

    def _serve(self, words: list[str]) -> None:
        """Serve a twin in another terminal, at a speed that also shortens the waits of its hosts."""
        link = Path(words[words.index("--link") + 1])
        command = [sys.executable, "-m", "khep_twin", "serve", *words, "--speed", "20"]
        self._servers.append(subprocess.Popen(command, cwd=self.folder, stdout=subprocess.DEVNULL))
        deadline = time.monotonic() + 30
        while not link.is_symlink():
            assert self._servers[-1].poll() is None, "it does not serve"
            assert time.monotonic() < deadline, f"{link}: there is no such link"
            time.sleep(0.05)


@contextlib.contextmanager
def reader(folder: Path, exact: bool = False) -> Iterator[Reader]:
    """Yield a reader in an empty folder with the activated environment."""
    path = os.environ["PATH"]
    os.environ["PATH"] = f"{Path(sys.executable).parent}{os.pathsep}{path}"
    # A reader's machine is idle; a busy one that runs the tests may answer later than a robot would.
    longer_timeout = patch.object(Khepera.__init__, "__defaults__", (60.0, 9600))
    with contextlib.chdir(folder), longer_timeout:
        person = Reader(folder, exact)
        try:
            yield person
        finally:
            person.close()
            os.environ["PATH"] = path


def make_run(folder: Path) -> list[str]:
    """Return the words of `make run`, with its files in another folder."""
    recipe = re.search(r"^run:.*\n(?:\t.*\n)*?\t@\$\(TWIN\) (run .*)$", MAKEFILE.read_text(), re.MULTILINE)
    assert recipe, "make run: no such recipe"
    words = shlex.split(recipe[1].replace("$(PLAYPEN)", "obstacles"))
    return [str(folder / Path(word).name) if word.startswith("out/") else word for word in words]


def draw_pictures() -> None:
    """Redraw the page's pictures by its commands, and put their output into its blocks."""
    page = PAGE.read_text()
    with tempfile.TemporaryDirectory() as name, reader(Path(name)) as person:
        for block in blocks(page)[1:]:
            begin = time.monotonic()
            if block.language != "text":
                person.follow(block)
                print(f"line {block.line}, {time.monotonic() - begin:.1f} s")
                continue
            assert person.output.count("\n") == block.text.count("\n"), f"line {block.line}: {person.output}"
            page = replace_block(page, block, person.output)
        for file in pictures(page):
            shrunk(person.folder / file, WIDTH).save(PICTURES / f"tutorial_{file}", optimize=True)
    PAGE.write_text(re.sub(r"<!-- Numbers made with: .*? -->", made_with(), page))


def draw_readme() -> None:
    """Redraw the README's pictures of `make run`."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for words in (
            make_run(folder),
            ["view", str(folder / "run.mcap"), "--png", str(folder / "view.png")],
        ):
            result = CliRunner().invoke(app, words, prog_name="khep-twin")
            assert result.exit_code == 0, f"{words}\n{result.output}{result.exception or ''}"
        (PICTURES / "run.png").write_bytes((folder / "run.png").read_bytes())
        shrunk(folder / "view.png", 1280).save(PICTURES / "view.png", optimize=True)


def shrunk(file: Path, width: int) -> Image.Image:
    """Return a picture of this width, in full colour."""
    picture = Image.open(file).convert("RGB")
    height = round(picture.height * width / picture.width)
    return picture.resize((width, height), Image.Resampling.LANCZOS)


def main() -> None:
    """Regenerate numbers and pictures."""
    command_line(__doc__).parse_args()
    draw_readme()
    draw_pictures()
