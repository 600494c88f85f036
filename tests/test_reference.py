"""The reference has every public name with its docstring, in pages that need no network."""

import os
import re
import subprocess
import sys
from html import unescape
from pathlib import Path
from types import FunctionType

import pytest

import khep_twin

ROOT = Path(__file__).parents[1]

pytestmark = pytest.mark.long  # `make docs` makes the pages, too


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The pages; any warning, such as of a type that cannot be found, is an error."""
    folder = tmp_path_factory.mktemp("reference")
    command = [sys.executable, "-W", "error", "-m", "tools", "reference", str(folder)]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    process = subprocess.run(command, capture_output=True, text=True, env=environment, cwd=ROOT, check=False)
    assert process.returncode == 0, process.stderr
    return folder


def visible_text(page: Path) -> str:
    """The text of a page."""
    return unescape(re.sub(r"<[^>]+>", "", page.read_text()))


def test_a_page_has_methods_with_their_units_and_arguments(folder: Path) -> None:
    page = visible_text(folder / "khep_twin" / "host.html")
    assert "Drive the wheels at these speeds [pulses/10 ms = 8 mm/s]" in page
    assert re.search(r"wheel_base:\s+Distance of the wheels", page)


@pytest.mark.parametrize(
    ("module", "name"),
    [
        ("host", "SensorCounts"),
        ("playpen", "Playpen"),
        ("lab/experiment", "Controller"),
        ("lab/experiment", "find_controller"),
        ("lab/experiment", "run_series"),
        ("lab/experiment/run_statistics", "collisions"),
        ("log", "read_log"),
        ("ports", "Serial"),
    ],
)
def test_what_programs_use_has_a_place(folder: Path, module: str, name: str) -> None:
    assert f'id="{name}"' in (folder / "khep_twin" / f"{module}.html").read_text()


def test_the_names_of_the_front_door_come_first(folder: Path) -> None:
    assert "url=./khep_twin.html" in (folder / "index.html").read_text()
    page = (folder / "khep_twin.html").read_text()
    names = [name for name in khep_twin.__all__ if isinstance(getattr(khep_twin, name), type | FunctionType)]
    assert len(names) > 25
    assert not [name for name in names if f'id="{name}"' not in page]


def test_the_pages_need_no_network(folder: Path) -> None:
    for page in folder.rglob("*.html"):
        text = page.read_text()
        assert not re.search(r"<(?:script|img|link)[^>]*(?:src|href)=[\"']?(?:https?:)?//", text), page
        assert not re.search(r"(?:url\(|@import |import\()[\"']?(?:https?:)?//", text), page
