"""A share of fuzz-files: damaged files of each kind never crash, hang or fill the memory."""

from pathlib import Path

import pytest

from checks.fuzz.files import TARGETS, mutate, seeds_of
from checks.fuzz.libfuzzer import run_target

SHARE = {"toml": 500, "mat": 300, "png": 300, "picture": 150, "npz": 300, "snapshot": 60}


@pytest.mark.share(2)
@pytest.mark.parametrize("kind", TARGETS)
def test_a_share_of_the_fuzzing_finds_nothing(kind: str, tmp_path: Path) -> None:
    process = run_target("fuzz-files", kind, str(SHARE[kind]), folder=tmp_path)
    assert process.stdout.startswith(f"{kind}: {SHARE[kind]} inputs from 0")
    assert process.stderr == ""


@pytest.mark.parametrize("kind", TARGETS)
def test_a_number_is_always_the_same_input_and_most_are_damaged(kind: str) -> None:
    seeds = seeds_of(kind)
    inputs = [mutate(seeds, kind, number) for number in range(200)]
    assert inputs == [mutate(seeds, kind, number) for number in range(200)]
    assert sum(data not in seeds for data in inputs) > 150
