"""The examples run as they stand."""

import subprocess
import sys
from pathlib import Path

import pytest

EXAMPLES = sorted((Path(__file__).parents[1] / "examples").glob("*.py"))


@pytest.mark.parametrize("example", EXAMPLES, ids=lambda path: path.stem)
def test_an_example_runs_on_a_twin_in_its_own_process(example: Path, tmp_path: Path) -> None:
    subprocess.run([sys.executable, str(example)], check=True, timeout=120, cwd=tmp_path)
