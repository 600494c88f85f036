"""The page of the Khepera III: its blocks run in order, and its program prints its distances."""

import re
import shutil
import sys
from pathlib import Path

import pytest
from docs_reader import ROOT, Reader

pytestmark = pytest.mark.skipif(
    sys.platform != "linux" or shutil.which("cc") is None, reason="there is no Linux with a C compiler"
)


def test_a_reader_of_the_page_compiles_and_runs_its_program(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("PYTHONPATH", str(ROOT))
    page = (ROOT / "docs" / "khepera3.md").read_text()
    reader = Reader(tmp_path)
    reader.read(page, {"sh", "python"})
    figures = re.search(r"prints (\d+) distances from (\d+) to (\d+) cm", page)
    distances = re.findall(r"^(\d+) cm$", capfd.readouterr().out, re.MULTILINE)
    assert figures is not None
    assert [str(len(distances)), distances[0], distances[-1]] == [*figures.groups()]
    print("\n".join(f"khepera3.md, not run: {block}" for block in reader.left))
