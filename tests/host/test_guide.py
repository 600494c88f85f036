"""What docs/host.md shows runs as it stands."""

import re
from pathlib import Path

import pytest

GUIDE = (Path(__file__).parents[2] / "docs" / "host.md").read_text()
BLOCKS = re.findall(r"```python\n(.*?)```", GUIDE, re.DOTALL)


@pytest.mark.parametrize("block", BLOCKS, ids=[str(number) for number in range(len(BLOCKS))])
def test_a_block_of_the_guide_runs(block: str) -> None:
    exec(compile(block, "docs/host.md", "exec"), {})


def test_there_are_blocks() -> None:
    assert len(BLOCKS) == 6
