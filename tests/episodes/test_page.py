"""docs/scale.md: its programs run."""

import contextlib
import io
import re
from pathlib import Path
from typing import Any

import pytest

from khep_twin.episodes.episode import SlowerWarning

ROOT = Path(__file__).parents[2]
PAGE = ROOT / "docs" / "scale.md"


@pytest.mark.filterwarnings(f"ignore::{SlowerWarning.__module__}.{SlowerWarning.__name__}")
def test_the_programs_of_the_page_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    names: dict[str, Any] = {}
    with contextlib.redirect_stdout(io.StringIO()) as output:
        for program in re.findall(r"```python\n(.*?)```", PAGE.read_text(), re.DOTALL):
            exec(compile(program, "docs/scale.md", "exec"), names)
    assert names["results"].failures == ()
    assert len(output.getvalue().splitlines()) >= 3
    assert names["controller"]([0] * 8, [500] * 8) == (10, 10)
