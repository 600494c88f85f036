"""docs/robots.md: its files are those of the Toy, and its commands work where the Toy is installed."""

import math
import re
from pathlib import Path
from types import SimpleNamespace
from typing import Any

from command_line import good
from docs_reader import BLOCK, ROOT, commands

PAGE = (ROOT / "docs" / "robots.md").read_text()
FOLDER = Path(__file__).parent / "toy_robot"


def files_of_page() -> dict[str, str]:
    """Return the files that the page asks to save, by their paths."""
    blocks = ((re.search("<!-- file: (.*?) -->", marks), text) for marks, _, text in BLOCK.findall(PAGE))
    return {mark[1]: text for mark, text in blocks if mark}


def test_the_page_has_the_files_of_the_toy() -> None:
    package = {name.removeprefix("toy_robot/"): text for name, text in files_of_page().items() if "/" in name}
    files = {path.name: path.read_text() for path in FOLDER.iterdir() if path.is_file()}
    assert package == files
    assert sum(text.count("\n") for text in files.values()) <= 310


def test_the_commands_of_the_page_work(installed_toy: Path, tmp_path: Path) -> None:
    for name, text in files_of_page().items():
        if "/" not in name:
            (tmp_path / name).write_text(text)
    lines = [line for _, language, text in BLOCK.findall(PAGE) if language == "sh" for line in commands(text)]
    lines = [line for line in lines if line.startswith("khep-twin")]
    outputs = {line: good(*line.split()[1:], folder=tmp_path) for line in lines}
    assert len(outputs) == 7
    assert "2 passed, 0 failed" in outputs["khep-twin conform khep://toys.toml --model toy --move"]


def test_the_computer_of_the_page_has_its_compass() -> None:
    names: dict[str, Any] = {}
    exec(next(text for _, _, text in BLOCK.findall(PAGE) if "COMPUTER = " in text), names)
    assert names["COMPUTER"].files(3) == {"/etc/toy/number": "3\n"}
    devices = names["COMPUTER"].connect(SimpleNamespace(pose=(0.0, 0.0, -math.pi / 2)))
    assert devices.slaves[0, 0x31].read(2) == (270).to_bytes(2, "little")
