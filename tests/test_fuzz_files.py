"""A share of `make fuzz-files`: damaged playpens, MAT files and PNGs never crash, hang or fill the memory."""

import subprocess
import sys
from pathlib import Path

import pytest
from fuzz_files import CORPUS, TARGETS, mutated

SHARE = {"toml": 5_000, "mat": 2_500, "png": 2_500}


@pytest.mark.parametrize("kind", TARGETS)
def test_a_share_of_the_fuzzing_finds_nothing(kind: str, tmp_path: Path) -> None:
    program = Path(__file__).with_name("fuzz_files.py")
    done = subprocess.run(
        [sys.executable, str(program), kind, str(SHARE[kind])],
        capture_output=True,
        text=True,
        cwd=tmp_path,
        timeout=120,
        check=False,
    )
    assert done.returncode == 0, done.stderr[-2000:]
    assert done.stdout.startswith(f"{kind}: {SHARE[kind]} inputs from 0")


@pytest.mark.parametrize("kind", TARGETS)
def test_a_number_is_always_the_same_input_and_most_are_damaged(kind: str) -> None:
    seeds = [path.read_bytes() for path in sorted(CORPUS.glob(f"*.{kind}"))]
    inputs = [mutated(seeds, kind, number) for number in range(200)]
    assert inputs == [mutated(seeds, kind, number) for number in range(200)]
    assert sum(data not in seeds for data in inputs) > 150
