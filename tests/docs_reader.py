"""Reader: runs the blocks of a page in order, in an empty folder, as a user who copies them.

Comments above a block, which a page does not show, tell how to read it:

    <!-- first: COMMAND -->      a command that gives what the page presumes, such as a scan
    <!-- file: NAME -->          a file that the text asks to save; written before the first block runs
    <!-- exits: CODES -->        the exit codes that are no error here, besides 0
    <!-- long: REASON -->        run with KHEP_DOCS=all alone
    <!-- not run: REASON -->     cannot run in a test

Commands that serve go on while the next ones run, until what they take or log to is used again, and end by
SIGINT. `/dev/ttyUSB0` is a served twin. Without KHEP_DOCS=all, runs are shortened by `SHORTER` and `FEWER`.
"""

import os
import re
import shlex
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from unittest.mock import patch

from command_line import khep_twin
from forked import Forked, run_python

ROOT = Path(__file__).parents[1]
ALL = os.environ.get("KHEP_DOCS") == "all"
ROBOT = "/dev/ttyUSB0"
TIMEOUT_S = 120.0

BLOCK = re.compile(r"((?:^<!--[^\n]*-->\n\n?)*)^```(\w*)[^\n]*\n(.*?)^```$", re.MULTILINE | re.DOTALL)
MARK = re.compile(r"<!-- (first|file|exits|long|not run): (.*?) -->")

SHORTER: dict[str, Callable[[int], int]] = {
    "--seconds": lambda seconds: min(seconds, 13),
    "--at": lambda seconds: min(seconds, 4),
    "--cycles": lambda cycles: min(cycles, 20),
    "--runs": lambda runs: min(-(-runs // 4), 3),
    "--pause": lambda pause: 0,
}
"""What a command asks for in the suite in place of what is written."""

FEWER = {"GENERATIONS": 2}
"""Constants at the top of a file's program that are smaller in the suite."""

NOT_RUN = {
    r"^make\b": "a target of the Makefile",
    r"\bpip install\b|\bpipx\b|\bpython3 -m venv\b": "installs packages",
    r"^(sudo|unshare|scp)\b": "needs other rights or machines",
    r"\bjupyter lab\b": "opens a page, and needs JupyterLab",
    r"\bkhep-twin view (?!.*--(save|png|web)\b)|--viewer\b|\bmujoco\.viewer\b": "opens a window",
}
"""Commands that cannot run in a test, and why."""

SERVES = re.compile(r"khep-twin (serve|design|view .*--web|shadow .*--relay|run .*--foxglove)\b")


@dataclass(frozen=True)
class Block:
    """A block of a page, with the marks above it."""

    line: int
    language: str
    text: str
    marks: tuple[tuple[str, str], ...]

    def marked(self, kind: str) -> list[str]:
        """Return the texts of its marks of one kind."""
        return [text for mark, text in self.marks if mark == kind]


def blocks(page: str) -> list[Block]:
    """Return all blocks of a page; the lines are those of the fences."""
    return [
        Block(page[: block.start(2)].count("\n") + 1, block[2], block[3], tuple(MARK.findall(block[1])))
        for block in BLOCK.finditer(page)
    ]


def commands(text: str) -> Iterator[str]:
    """Yield the commands of a block: lines, with those that they go on in."""
    command = ""
    for line in text.splitlines(keepends=True):
        command += line
        try:
            words = shlex.split(command, comments=True)
        except ValueError:  # a quotation over several lines
            continue
        if not command.endswith("\\\n"):
            if words:
                yield command.strip()
            command = ""
    assert not command.strip(), command


def shortened(command: str) -> str:
    """Return a command with less of what takes time."""
    amount = re.compile(rf"({'|'.join(SHORTER)}) (\d+)\b")
    return amount.sub(lambda match: f"{match[1]} {SHORTER[match[1]](int(match[2]))}", command)


def fewer(program: str) -> str:
    """Return a program with less of what takes time."""
    amount = re.compile(rf"^({'|'.join(FEWER)}) = \d+$", re.MULTILINE)
    return amount.sub(lambda match: f"{match[1]} = {FEWER[match[1]]}", program)


@dataclass
class Server:
    """A command that serves, with the links, ports and files that are its own."""

    command: str
    process: "subprocess.Popen[bytes]"
    output: Path
    port_names: set[str]
    logs: set[str]

    def end(self) -> None:
        """End it by SIGINT, as a person does.

        Raises:
            AssertionError: It did not end well.
        """
        self.process.send_signal(signal.SIGINT)
        code = self.process.wait(TIMEOUT_S)
        output_text = self.output.read_text()
        assert code in (0, 130), f"{self.command}: {code}\n{output_text}"
        assert "Traceback" not in output_text, f"{self.command}\n{output_text}"


@dataclass
class Reader:
    """A reader of one page.

    Attributes:
        folder: Working directory.
        left: What was not run, a line each with its reason.
    """

    folder: Path
    left: list[str] = field(default_factory=list[str])
    _servers: list[Server] = field(default_factory=list[Server])

    def read(self, page: str, languages: set[str]) -> None:
        """Run the blocks in these languages.

        Raises:
            AssertionError: A command or a program has failed.
        """
        text = blocks(page)
        if any(block.language == "sh" and re.search(r"\.venv/| examples/", block.text) for block in text):
            self._checkout()
        for block in reversed(text):
            for name in block.marked("file"):
                (self.folder / name).write_text(block.text if ALL else fewer(block.text))
        try:
            with patch.dict(os.environ):
                for block in text:
                    if block.language in languages and not block.marked("file"):
                        self._block(block)
            while self._servers:
                self._servers.pop().end()
        finally:
            for server in self._servers:  # after an error; what they have started ends with them
                server.process.terminate()
                server.process.wait()

    def _checkout(self) -> None:
        """Let the folder look like the repository, with the environment that runs the tests."""
        for entry in ROOT.iterdir():
            if entry.name not in ("out", ".venv", ".git", "benchmarks"):
                (self.folder / entry.name).symlink_to(entry)
        shutil.copytree(ROOT / "benchmarks", self.folder / "benchmarks")  # which keeps its results there
        (self.folder / ".venv").symlink_to(sys.prefix)

    def _block(self, block: Block) -> None:
        reasons = block.marked("not run") + ([] if ALL else block.marked("long"))
        if reasons:
            self.left.append(f"line {block.line}, a block of {block.language}: {reasons[0]}")
            return
        for command in block.marked("first"):
            self._command(command, {0})
        if block.language == "python":
            self._run([sys.executable, "-c", block.text], f"line {block.line}")
            return
        codes = {0, *(int(code) for text in block.marked("exits") for code in re.findall(r"\d+", text))}
        for command in commands(block.text):
            self._command(command, codes)

    def _command(self, command: str, codes: set[int]) -> None:
        command = command if ALL else shortened(command)
        words = shlex.split(command, comments=True)
        for pattern, reason in NOT_RUN.items():
            if re.search(pattern, " ".join(words)):
                self.left.append(f"{command}: {reason}")
                return
        port_names = {*_values(words, "--link"), *({ROBOT, "--foxglove"} & {*words})}
        self._make_room(words, port_names)
        if command.startswith("export "):
            environment = self._run(["sh", "-ec", f"{command}; env -0"], command)
            for name, _, value in (
                assignment.partition("=") for assignment in environment.split("\0") if assignment
            ):
                os.environ[name] = value
            return
        if ROBOT in command:
            link = self.folder / "robot-link"
            if not link.is_symlink():
                self._serve(f"khep-twin serve default --speed 20 --link {link}", {str(link)})
            command = command.replace(ROBOT, str(link))
            words = shlex.split(command, comments=True)
        if SERVES.search(" ".join(words)):
            self._serve(command.removesuffix("&"), port_names)
        elif Path(words[0]).name == "khep-twin" and not {"|", "||", ">", "&"} & {*words}:
            typed = self.folder / ".typed"
            typed.write_text("\n" * 100)
            with typed.open() as keys, patch.object(sys, "stdin", keys):
                process = khep_twin(*words[1:], folder=self.folder)
            drawn = "rerun's viewer cannot draw here" not in process.stderr
            assert process.returncode in codes or not drawn, f"{command}\n{process.stdout}{process.stderr}"
            if not drawn:
                self.left.append(f"{command}: there is no Vulkan here")
        elif re.match(r"(\.venv/bin/)?python \S+\.py\b[^|>&]*$", command):
            self._run([sys.executable, *words[1:]], command, codes)
        else:
            self._run(["sh", "-ec", command], command, codes)

    def _make_room(self, words: list[str], port_names: set[str]) -> None:
        """End the servers whose link or port is taken, or whose log is used."""
        for server in [*self._servers]:
            if port_names & server.port_names or ("--live" not in words and server.logs & {*words}):
                self._servers.remove(server)
                server.end()

    def _serve(self, command: str, port_names: set[str]) -> None:
        """Start a command that serves; return when it has told its first line and made its link."""
        words = shlex.split(command, comments=True)
        output = self.folder / f".served-{time.monotonic_ns()}"
        with output.open("wb") as file:
            process = Forked(
                [sys.executable, "-m", "khep_twin", *words[1:]],
                cwd=self.folder,
                stdin=subprocess.DEVNULL,
                stdout=file,
                stderr=subprocess.STDOUT,
            )
        links, logs = _values(words, "--link"), _values(words, "--log") + _values(words, "-o")
        self._servers.append(Server(command, process, output, port_names, {*logs}))
        deadline = time.monotonic() + TIMEOUT_S
        link_paths = [self.folder / link for link in links if "/" in link]
        while "\n" not in output.read_text() or not all(link.is_symlink() for link in link_paths):
            assert process.poll() is None, f"{command}: ended\n{output.read_text()}"
            assert time.monotonic() < deadline, f"{command}: told nothing\n{output.read_text()}"
            time.sleep(0.05)

    def _run(self, words: list[str], name: str, codes: Collection[int] = (0,)) -> str:
        """Run a program whose reader presses Enter whenever it asks; return what it prints."""
        start = run_python if words[0] == sys.executable else subprocess.run
        pipe = subprocess.PIPE
        process = start(words, cwd=self.folder, input="\n" * 100, stdout=pipe, stderr=pipe, text=True)
        assert process.returncode in codes, f"{name}\n{process.stdout}{process.stderr}"
        return process.stdout


def _values(words: list[str], option: str) -> list[str]:
    return [value for key, value in pairwise(words) if key == option]
